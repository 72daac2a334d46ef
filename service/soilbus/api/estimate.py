"""From the rows of a single-wheel test rig to a soil: the estimator of the service on data in memory.

columns -> rows of one soil bed (offline/tables.py) -> posterior (estimation) -> SoilEstimate
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from soilbus.api.residuals import frame_of, plot_residuals
from soilbus.api.wheel import wheel_forces
from soilbus.arrays import Array
from soilbus.config.file import load_config, parse_config
from soilbus.config.model import Config
from soilbus.diagnosis.diagnose import NotFitted
from soilbus.estimation.assembly import model_of
from soilbus.estimation.posterior import PARAMETERS, Estimate, Posterior
from soilbus.offline.columns import TableError
from soilbus.offline.tables import Run, replay_runs, runs_of_columns
from soilbus.pipeline.outputs import PARAMETER_FRAMES
from soilbus.terra.vehicle import slip_ratio
from soilbus.terra.wheel import Soil
from soilbus.words import did_you_mean

__all__ = ["SingleWheelRig", "SoilEstimate", "estimate"]

SOURCE = "data"
"""What messages call the columns."""
ROLES = ("wheel_load", "slip", "drawbar_pull", "torque", "sinkage", "t", "run")
"""Columns that a rig's table can have."""
CHANNELS = {"wheel_load": "load", "slip": "slip", "drawbar_pull": "draft", "torque": "torque", "sinkage": "sinkage"}
"""Section of [noise] for each of them."""
LEAST_CORRELATION = 0.5
"""Correlations below it are not printed; an offset of half a std in one parameter moves the other by a quarter."""


@dataclass(frozen=True)
class SingleWheelRig:
    """A test rig with one wheel; lengths in m.

    Attributes
    ----------
    noise
        Standard deviation of each column in SI, or a mapping as in [noise] of a configuration, whose defaults hold for
        others.
    soil
        Prior (value, std) of soil parameters in SI, std = 0 holds one; by default that of a configuration.
    tyre, shear_law
        "rigid" or "flexible"; "exponential" (Janosi & Hanamoto) or "rational".
    """

    radius: float
    width: float
    noise: Mapping[str, float | Mapping[str, float]] = field(default_factory=dict)
    soil: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    tyre: str = "rigid"
    shear_law: str = "exponential"

    def configuration(self, columns: Iterable[str]) -> Config:
        """Return the configuration of this rig for a table with columns named by their roles.

        TableError where a column is missing or misspelt, ConfigError where a value cannot be used.
        """
        names = list(columns)
        absent = [role for role in ROLES if role not in names]
        for name in (name for name in names if name not in ROLES):
            if meant := did_you_mean(name, absent):
                raise TableError(f"{SOURCE}: no column of a rig is named {name}{meant}")
        if needed := [role for role in ("wheel_load", "slip") if role in absent]:
            raise TableError(f"{SOURCE}: no column {' and '.join(needed)}; it has {', '.join(names) or 'none'}")
        if unknown := [name for name in self.noise if name not in CHANNELS]:
            raise TableError(f"noise of {unknown[0]}{did_you_mean(unknown[0], CHANNELS)}; known: {', '.join(CHANNELS)}")
        raw = {
            "wheel": [{"name": "wheel", "radius": self.radius, "width": self.width, "tyre": self.tyre}],
            "table": {role: role for role in ROLES if role in names},
            "noise": {CHANNELS[n]: sd if isinstance(sd, Mapping) else {"absolute": sd} for n, sd in self.noise.items()},
            "soil": {name: {"value": value, "std": std} for name, (value, std) in self.soil.items()},
            "model": {"shear_law": self.shear_law},
        }
        return parse_config(raw, source="rig")


@dataclass(frozen=True, repr=False)
class SoilEstimate:
    """The soil that rows of a test rig determine; prints itself as a report. Values are SI.

    `posterior` is log-normal, of all six parameters; `prior` value and std of each beforehand; `bearing_pressure`
    (k_c/b_ref + k_phi) z_ref^n [Pa], what data determine best, at a depth z_ref under a plate b_ref wide [m]. `status`
    and `reason` are as of a window of `soilbus replay`; `chi2` is reduced: 1 where model and noise describe the data.
    `left_out` are rows by reason; `readings` the rows of `residuals`.
    """

    posterior: Posterior
    prior: Mapping[str, tuple[float, float]]
    bearing_pressure: Estimate
    z_ref: float
    b_ref: float
    status: str
    reason: str
    chi2: float | None
    rows: int
    left_out: Mapping[str, int]
    readings: Sequence[Mapping[str, Any]] = ()

    @property
    def residuals(self) -> Any:
        """pandas DataFrame: channel, slip, load, measured, modelled and residual of each row, SI."""
        return frame_of(self.readings)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: value, std and prior of each parameter, SI."""
        found = self.posterior.parameters()
        rows = [(name, e.value, e.std, *self.prior[name]) for name, e in found.items()]
        return frame_of(rows, ("parameter", "value", "std", "prior", "prior_std")).set_index("parameter")

    def plot(self) -> Any:
        """Return a figure of matplotlib: measured over modelled, and residuals over slip and load."""
        return plot_residuals(self.residuals)

    @property
    def soil(self) -> Soil:
        """The values as a soil, for `wheel_forces`."""
        return self.posterior.soil

    @property
    def values(self) -> dict[str, float]:
        """Value of each parameter, SI."""
        return {name: e.value for name, e in self.posterior.parameters().items()}

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of each parameter, SI; 0 of a held one."""
        return {name: e.std for name, e in self.posterior.parameters().items()}

    @property
    def correlation(self) -> Array:
        """Correlation (6, 6) of the parameters' logarithms; nan in rows of held ones."""
        covariance = self.posterior.log_covariance
        sd = np.sqrt(np.diag(covariance))
        with np.errstate(invalid="ignore"):
            return np.asarray(covariance / np.outer(sd, sd))

    def __repr__(self) -> str:
        left_out = ", ".join(f"{reason} {n}" for reason, n in self.left_out.items()) or "none"
        pressure = _quantity(self.bearing_pressure, 1e3)
        return "\n".join([
            "[[Fit]]",
            f"    rows used          = {self.rows} (left out: {left_out})",
            f"    reduced chi-square = {'-' if self.chi2 is None else format(self.chi2, '.3g')}",
            f"    status             = {self.status}" + (f" ({self.reason})" if self.reason != "none" else ""),
            "[[Soil]]",
            *(f"    {line}" for line in self._parameter_lines()),
            f"[[Bearing pressure]] (at {1e3 * self.z_ref:g} mm under a plate {self.b_ref:g} m wide)",
            f"    {pressure} kPa",
            f"[[Correlations]] (of logarithms; below {LEAST_CORRELATION:g} not shown)",
            *(f"    {line}" for line in self._correlation_lines()),
        ])  # fmt: skip

    def _parameter_lines(self) -> Iterator[str]:
        for name, found in self.posterior.parameters().items():
            _, unit, size = PARAMETER_FRAMES[name]
            before = _plus_minus(Estimate(*self.prior[name]), size)
            yield f"{name + ':':<7}{_quantity(found, size):<26} {unit:<12} (prior {before})"

    def _correlation_lines(self) -> Iterator[str]:
        table = self.correlation
        pairs = [(float(table[i, j]), i, j) for i, j in combinations(range(len(PARAMETERS)), 2)]
        strong = [pair for pair in pairs if abs(pair[0]) >= LEAST_CORRELATION]  # nan is not
        for r, i, j in sorted(strong, key=lambda pair: -abs(pair[0])):
            yield f"C({PARAMETERS[i]}, {PARAMETERS[j]}) = {r:+.2f}"


def estimate(data: Any, rig: SingleWheelRig | Config | Path | str, *, run: str | None = None) -> SoilEstimate:
    """Estimate the soil in which a single wheel was tested.

    Parameters
    ----------
    data
        Columns of equal length by name (mapping or pandas DataFrame), a steady state a row: of a SingleWheelRig
        wheel_load [N] and slip [1] with at least one of drawbar_pull [N], torque [N m] and sinkage [m], and optionally
        t [s] and run. nan and None are missing.
    rig
        The rig; or a configuration with a [table] that maps the columns, or the path of one.
    run
        Soil bed to estimate, where the data hold several.

    Raises
    ------
    TableError, ConfigError, NotFitted
        Columns or rows, or the soil bed, cannot be used; the rig's values cannot; no soil describes the rows.

    Examples
    --------
    >>> import soilbus
    >>> load, slip = [800.0] * 8 + [1500.0] * 8, [0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6] * 2
    >>> true = soilbus.wheel_forces("loam", load, slip, radius=0.3, width=0.2)
    >>> columns = {"wheel_load": load, "slip": slip, "drawbar_pull": true.drawbar_pull, "torque": true.torque}
    >>> rig = soilbus.SingleWheelRig(0.3, 0.2, noise={"drawbar_pull": 8.0, "torque": 3.0})
    >>> found = soilbus.estimate(columns, rig)
    >>> abs(found.values["phi"] - soilbus.soil_named("loam").phi) < 2.0 * found.std["phi"]
    True
    """
    columns = {str(name): np.asarray(data[name]).tolist() for name in data}
    lengths = {len(cells) for cells in columns.values() if isinstance(cells, list)}
    if len(lengths) > 1 or not all(isinstance(cells, list) for cells in columns.values()):
        raise TableError(f"{SOURCE}: its columns are not of one length")
    given = rig.configuration(columns) if isinstance(rig, SingleWheelRig) else rig
    config = given if isinstance(given, Config) else load_config(given)
    found = _of_bed(runs_of_columns(config, columns, SOURCE), run)
    (result,) = replay_runs(config, [found])
    bearing = result.bearing
    if result.posterior is None or bearing is None or bearing.std > bearing.value:
        raise NotFitted(f"no soil describes the {len(found.window.t)} rows ({result.reason})")
    settings = config.estimator
    return SoilEstimate(
        posterior=result.posterior,
        prior={name: (p.value, p.std) for name, p in config.soil_prior.items()},
        bearing_pressure=bearing,
        z_ref=settings.z_ref,
        b_ref=settings.b_ref,
        status=str(result.status),
        reason=result.reason,
        chi2=result.chi2,
        rows=len(found.window.t),
        left_out=found.rejected,
        readings=_readings(config, found, result.posterior.soil),
    )


def _readings(config: Config, found: Run, soil: Soil) -> list[dict[str, Any]]:
    """Each channel's rows beside the model's values; the wheel runs with the configured effects."""
    window, wheel, model = found.window, config.wheel[0], model_of(config)
    load, slip = window.load[:, 0], slip_ratio(wheel.radius, window.speed[:, 0], window.ground_speed)
    given = {f"{e.name}.{name}": value for e in config.model.effects for name, value in (e.model_extra or {}).items()}
    effects = {name: value["value"] if isinstance(value, Mapping) else value for name, value in given.items()}
    of = wheel_forces(soil, load, slip, radius=wheel.radius, width=wheel.width, model=model, effects=effects or None)
    both = {"drawbar_pull": (window.draft, of.drawbar_pull), "torque": (window.torque[:, 0], of.torque)}
    both["sinkage"] = window.sinkage[:, 0], of.sinkage
    return [
        {"channel": channel, "slip": s, "load": w, "measured": y, "modelled": m, "residual": y - m}
        for channel, (measured, values) in both.items()
        for w, s, y, m in zip(load, slip, measured, values, strict=True)
        if np.isfinite(y)
    ]


def _of_bed(runs: Sequence[Run], bed: str | None) -> Run:
    """The run of one soil bed, or the only one."""
    beds = {run.name.removeprefix(f"{SOURCE}, "): run for run in runs}
    if bed is None and len(beds) > 1:
        raise TableError(f"{SOURCE}: rows of {len(beds)} soil beds: say which by run: {', '.join(beds)}")
    if bed is not None and SOURCE in beds:
        raise TableError(f"{SOURCE}: no column says which rows are of the soil bed {bed}")
    wanted = next(iter(beds)) if bed is None else str(bed)
    if wanted not in beds:
        raise TableError(f"{SOURCE}: no soil bed {wanted}{did_you_mean(wanted, beds)}; it has {', '.join(beds)}")
    if not len(beds[wanted].window.t):
        raise TableError(f"{SOURCE}: no usable row of the soil bed {wanted} ({', '.join(beds[wanted].rejected)})")
    return beds[wanted]


def _quantity(found: Estimate, unit: float) -> str:
    """Value and std, and the std in per cent."""
    if found.std == 0.0:
        return f"{_plus_minus(found, unit)} (held)"
    share = 100.0 * found.std / found.value
    return f"{_plus_minus(found, unit)} ({share:.{int(share < 10.0)}f} %)"


def _plus_minus(found: Estimate, unit: float) -> str:
    """Value and std with two digits of the std."""
    value, std = found.value / unit, found.std / unit
    decimals = max(1 - math.floor(math.log10(std)), 0) if std else 0
    return f"{value:.{decimals}f} +/- {std:.{decimals}f}" if std else f"{value:.4g}"
