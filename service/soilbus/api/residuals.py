"""Measured beside modelled values as tables and plots: what `estimate` and `diagnose` return offers both."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["frame_of", "plot_residuals"]


def frame_of(rows: Any, columns: Any = None) -> Any:
    """A pandas DataFrame of rows; ImportError says how to get pandas."""
    try:
        pandas = import_module("pandas")
    except ModuleNotFoundError:
        raise ImportError("a table needs pandas: pip install pandas") from None
    return pandas.DataFrame(rows, columns=columns)


def plot_residuals(residuals: Any) -> Any:
    """A figure of matplotlib: measured over modelled, and the residual over slip and over load, a row a channel.

    Parameters
    ----------
    residuals
        DataFrame with channel, measured, modelled, residual, slip, load.

    Returns
    -------
    matplotlib.figure.Figure
    """
    try:
        figure_of: Any = import_module("matplotlib.figure").Figure
    except ModuleNotFoundError:
        raise ImportError("a plot needs the extra soilbus[plots]") from None
    channels = list(dict.fromkeys(residuals["channel"]))
    figure = figure_of(figsize=(10.0, 3.0 * len(channels)), layout="constrained")
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
