"""Measured beside modelled values as tables and plots: what `estimate` and `diagnose` return offers both."""

from __future__ import annotations

from importlib import import_module
from io import BytesIO
from typing import Any

__all__ = ["blank_figure", "frame_of", "plot_residuals", "with_pandas"]


def with_pandas() -> Any:
    """Return the module pandas; ImportError says how to get it."""
    try:
        return import_module("pandas")
    except ModuleNotFoundError:
        raise ImportError("a table needs pandas: pip install pandas") from None


def frame_of(rows: Any, columns: Any = None) -> Any:
    """Return a pandas DataFrame of rows."""
    return with_pandas().DataFrame(rows, columns=columns)


def blank_figure(width: float, height: float) -> Any:
    """Return a figure of matplotlib [inch] without axes, which a notebook shows; ImportError without matplotlib."""
    try:
        figure: Any = import_module("matplotlib.figure").Figure(figsize=(width, height), layout="constrained")
    except ModuleNotFoundError:
        raise ImportError("a plot needs the extra soilbus[plots]") from None

    def png() -> bytes:
        out = BytesIO()
        figure.savefig(out, format="png")
        return out.getvalue()

    figure._repr_png_ = png  # for notebooks that have not imported pyplot
    return figure


def plot_residuals(residuals: Any) -> Any:
    """Return a figure of matplotlib: measured over modelled, and residuals over slip and load, by channel."""
    channels = list(dict.fromkeys(residuals["channel"]))
    figure = blank_figure(10.0, 3.0 * len(channels))
    for row, channel in zip(figure.subplots(len(channels), 3, squeeze=False), channels, strict=True):
        own = residuals[residuals["channel"] == channel]
        row[0].plot(own["modelled"], own["measured"], ".")
        row[0].axline((float(own["modelled"].mean()),) * 2, slope=1.0, color="black", lw=1.0)
        row[0].set(xlabel=f"{channel} modelled", ylabel=f"{channel} measured")
        for axis, over, unit in ((row[1], "slip", ""), (row[2], "load", " [N]")):
            axis.plot(own[over], own["residual"], ".")
            axis.axhline(0.0, color="black", lw=1.0)
            axis.set(xlabel=over + unit, ylabel=f"{channel} measured - modelled")
    return figure
