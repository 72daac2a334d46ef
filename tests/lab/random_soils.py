"""Capability of a posterior by plain Monte Carlo: random soils in place of its sigma points."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from soilbus.decision import capability as assessment
from soilbus.decision.capability import Capability, Demand, assess
from soilbus.decision.wheels import WheelTable, wheel_table
from soilbus.estimation.assembly import model_of, rig_of
from soilbus.estimation.posterior import Posterior
from soilbus.simulator.reference import reference_configuration

CONFIG = reference_configuration()
RIG, MODEL = rig_of(CONFIG), model_of(CONFIG)
MAX_SLIP, MAX_SINKAGE = 0.6, 0.25
SURE = 2e-3
"""Std over value below which a quantity is as good as known."""
RARE = 4.0
"""Skewness from which a std is made by a few draws of a thousand."""
SIGMAS = 2.5


class Moments(NamedTuple):
    """Mean and std of draws, the std's own relative standard error, skewness, and how many draws there are."""

    value: float
    std: float
    error: float
    skewness: float
    n: int


class RandomSoils:
    """Random soils of a posterior, the mode first; interface of SigmaPoints."""

    n = 10_000

    def __init__(self, soils: np.ndarray) -> None:
        self.soils = soils
        self.share = soils

    @classmethod
    def of(cls, posterior: Posterior, shifts: np.ndarray) -> RandomSoils:
        assert not len(shifts)
        rng = np.random.default_rng(7)
        logs = rng.multivariate_normal(np.zeros(6), posterior.log_covariance, cls.n // 2, method="eigh")
        logs = np.stack([logs, -logs], axis=1).reshape(-1, 6)
        return cls(np.asarray(posterior.soil) * np.exp(np.concatenate([np.zeros((1, 6)), logs])))

    def drawn(self, samples: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
        return samples


def moments(*samples: np.ndarray | None) -> list[Moments | None]:
    """In the place of draws.estimates."""
    return [None if each is None else _moments(each) for each in samples]


def _moments(samples: np.ndarray) -> Moments | None:
    draws = samples[1:]
    draws = draws[np.isfinite(draws)]
    if not np.isfinite(samples[0]) or 2 * len(draws) <= len(samples) - 1:
        return None
    mean, std = float(draws.mean()), float(draws.std())
    z = (draws - mean) / (std or 1.0)
    error = np.sqrt(max((z**4).mean() - 1.0, 0.0) / len(z)) / 2.0
    return Moments(mean, std, float(error), float((z**3).mean()), len(z))


@contextmanager
def by_draws(n: int = RandomSoils.n) -> Iterator[None]:
    """`assess` by plain Monte Carlo; the wheels' tables are kept within the context, so it is of one posterior."""
    tables: dict[tuple[float, ...], WheelTable] = {}

    def table(soils: Any, rig: Any, model: Any, slip: np.ndarray, *_: Any, **__: Any) -> WheelTable:
        key = tuple(slip.tolist())
        if key not in tables:
            tables[key] = wheel_table(soils, rig, model, slip)
        return tables[key]

    with (
        mock.patch.object(RandomSoils, "n", n),
        mock.patch.object(assessment, "SigmaPoints", RandomSoils),
        mock.patch.object(assessment, "estimates", moments),
        mock.patch.object(assessment, "wheel_table", table),
    ):
        yield


def assessed(posterior: Posterior, torque_limit: float, demand: Demand | None) -> Capability:
    """Of the reference tractor, whose motors all have this limit [N m]."""
    able, _ = assess(posterior, RIG, MODEL, demand, np.full(4, torque_limit), MAX_SLIP, MAX_SINKAGE)
    assert able is not None
    return able


def figures(able: Capability) -> dict[str, Any]:
    """Every scalar of a capability by name, an Estimate or Moments."""
    found = {
        "max_draft": able.max_draft,
        "max_grade": able.max_grade,
        "max_grade_with_draft": able.max_grade_with_draft,
        "max_pull": able.max_pull,
        **{f"efficiency {axle}": point.efficiency for axle, point in able.set_points.items()},
        **{f"most pull {axle}": point.pull for axle, point in able.set_points.items()},
    }
    if (forecast := able.forecast) is not None:
        found |= {"slip": forecast.slip, "torque": forecast.torque}
        found |= {f"sinkage {wheel}": forecast.sinkage[wheel] for wheel in ("FL", "RL")}
    return {name: e for name, e in found.items() if e is not None}


class Compared(NamedTuple):
    """One quantity beside its draws; rare: made by few of them; wrong: beyond 2 % or 10 % and the draws' own noise."""

    name: str
    found: Moments
    drawn: Moments
    rare: bool
    wrong: bool

    def __str__(self) -> str:
        value, std, of_draws = self.found.value, self.found.std, self.drawn
        return (
            f"{self.name:21s} {value:10.4g} +- {std:9.3g}, draws {of_draws.value:10.4g} +- {of_draws.std:9.3g}"
            f" ({std / of_draws.std - 1.0:+.0%}, noise {of_draws.error:.1%}, skewness {of_draws.skewness:+.1f})"
        )


def compared(found: Capability, drawn: Capability) -> list[Compared]:
    """All uncertain quantities that an assessment and that by draws both have."""
    ours, theirs = figures(found), figures(drawn)
    return [
        _compared(name, ours[name], theirs[name])
        for name in ours
        if name in theirs and max(ours[name].std, theirs[name].std) > SURE * abs(theirs[name].value)
    ]


def _compared(name: str, found: Moments, drawn: Moments) -> Compared:
    mean_noise = SIGMAS * drawn.std / np.sqrt(drawn.n)
    mean_off = abs(found.value - drawn.value) > 0.02 * abs(drawn.value) + mean_noise
    std_off = abs(found.std / drawn.std - 1.0) > 0.10 + SIGMAS * drawn.error if drawn.std else True
    return Compared(name, found, drawn, abs(drawn.skewness) > RARE, bool(mean_off or std_off))
