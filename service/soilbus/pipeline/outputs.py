"""One window's result as a JSON line, as a row of a table and as values of the CAN frames that soilbus sends.

    WindowResult -> window_record, json_line        one object per window, SI units, keys in docs/json.md
    window_record -> flat_record                    the same as a row: soil.phi.value, slip.FL
    WindowResult -> hop_frames                      frames sent once per window
    WindowResult, Watch -> forecast_frame           frame sent every TICK

The frames' values are in the units of output.dbc; None is sent as the signal's code for "not available".
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from cantools.database.can import Database

from soilbus.config.model import Config, ConfigError
from soilbus.decision.watch import Watch
from soilbus.pipeline.result import WindowResult
from soilbus.pipeline.states import state_after
from soilbus.terra.soils import UNKNOWN

__all__ = [
    "FAST_FRAMES", "HOP_FRAMES", "check_cycle_times", "column_names", "demand_frame", "flat_record",
    "forecast_frame", "hop_frames", "json_line", "known", "likeliest", "slip_frames", "value_std", "values_std",
    "window_record"
]  # fmt: skip

if TYPE_CHECKING:
    from soilbus.decision.capability import Capability
    from soilbus.estimation.posterior import Estimate

WINDOW_MODULUS = 251
"""The frames' 8-bit window number counts 0..250."""

TICK = 0.1
"""Cycle [s] of the fast frames, on which other devices act."""
FAST_FRAMES = ("WheelSlip", "WheelSlip2", "Traversability", "TorqueDemand", "DemandForecast", "PresentDemand")

LONGEST_TIME = 1e6
"""Time left [s] that stands for no end: above the range of any signal."""

MAX_CLASSES = 3
"""Number of known soils that a window names."""

PARAMETER_FRAMES = {
    "k_c": ("SoilCohesiveModulus", "kN/m^(n+1)", 1e3),
    "k_phi": ("SoilFrictionalModulus", "kN/m^(n+2)", 1e3),
    "n": ("SoilSinkageExponent", "", 1.0),
    "phi": ("SoilFrictionAngle", "deg", math.pi / 180.0),
    "c": ("SoilCohesion", "kPa", 1e3),
    "K": ("SoilShearModulus", "mm", 1e-3),
}
"""Of each parameter by its JSON name: message, unit in the DBC and in reports, and that unit's value in SI."""

REASONS_AS_SENT = {"not_available": "no_value", "error": "sensor_error", "second_sender": "bad_counter"}
"""Names in the value table for reasons of refusal: the signal itself has no value, or a code that older DBCs have."""

HOP_FRAMES = (
    "SoilStrength", "SoilClass", *(message for message, *_ in PARAMETER_FRAMES.values()), "DraftCapability",
    "GradeCapability", "TractionAdvice", "TractionLimits", "WheelSinkage", "WheelSinkage2", "WindowQuality",
)  # fmt: skip
"""Names of the frames that are sent once per window."""


def check_cycle_times(config: Config, database: Database) -> None:
    """Check that frames come at least as often as the DBC promises (GenMsgCycleTime).

    Readers detect a silent sender by it: with a longer cycle each pause would look like the end of soilbus.

    Raises
    ------
    ConfigError
        Where a frame would come less often.
    """
    promised = {m.name: (m.cycle_time or math.inf) / 1e3 for m in database.messages}
    faults = []
    for frames, every in ((FAST_FRAMES, TICK), (HOP_FRAMES, config.estimator.hop)):
        if late := [name for name in frames if promised[name] < every * (1.0 - 1e-9)]:
            faults.append(
                f"output.dbc: {config.output.dbc} promises {', '.join(late)} every {1e3 * promised[late[0]]:g} ms, but"
                f" soilbus sends every {1e3 * every:g} ms: set GenMsgCycleTime in a copy of the DBC that both sides use"
                + (", or a shorter estimator.hop" if frames is HOP_FRAMES else "")
            )
    if faults:
        raise ConfigError(faults)


def json_line(result: WindowResult, config: Config) -> str:
    """Return the result as one line of JSON (keys: docs/json.md), in SI units, null where not known."""
    return json.dumps(window_record(result, config), allow_nan=False)


def window_record(result: WindowResult, config: Config) -> dict[str, Any]:
    """Return the result as nested dicts and lists (keys: docs/json.md), in SI units, None where not known."""
    decision, z_ref, driven = result.traversability, config.estimator.z_ref, result.z_driven
    bearing = {
        "z_ref": z_ref,
        "b_ref": config.estimator.b_ref,
        **value_std(result.bearing),
        "z_driven": None if driven is None else list(driven),
        "extrapolates": None if result.bearing is None or driven is None else not driven[0] <= z_ref <= driven[1],
    }
    posterior = result.posterior
    line = {
        "t": round(result.t, 6),
        "log": result.log,
        "window": result.index,
        "status": str(result.status),
        "state": str(state_after(result)),
        "reason": result.reason,
        "soil": None if posterior is None else values_std(posterior.parameters()),
        "bearing_pressure": bearing,
        "soil_change": None if result.soil_change is None else result.soil_change._asdict(),
        "soil_class": None if result.soil_class is None else likeliest(result.soil_class),
        "slip": result.slip,
        "sinkage": result.sinkage,
        "traversability": {
            "state": str(decision.state),
            "probability": decision.probability,
            "torque_required": decision.torque_required,
            "torque_available": decision.torque_available,
            "max_draft": value_std(decision.max_draft),
            "max_grade": value_std(decision.max_grade),
            "limit": decision.limit,
            "age": result.t - result.basis.end,
            "since_valid": decision.since_valid,
            "contradicted": decision.contradicted,
        },
        "gaps": dict(result.gaps),
        "prediction_error": dict(result.prediction_error),
        "standing": {name: value_std(estimate) for name, estimate in result.standing.items()},
        "noise_factors": dict(result.noise_factors),
        "warning": {
            "state": str(result.watch.warning),
            "time_left": result.watch.time_left,
            "since": result.warnings.since,
            "begun": list(result.warnings.begun),
        },
        "capability": None if decision.capability is None else _capability(decision.capability),
        "chi2": result.chi2,
        "solver": {"termination": result.termination, "evaluations": result.iterations},
        "search_ended": result.search_ended,
        "samples": result.samples,
        "rejected": result.rejected,
    }
    record: dict[str, Any] = known(line)
    return record


def flat_record(record: Mapping[str, Any]) -> dict[str, float | str | int | None]:
    """Return a nested record as one row of a table.

    Parameters
    ----------
    record
        Nested mappings and lists, as `window_record` makes them or a line of `replay --json` holds them.

    Returns
    -------
    dict
        One entry for each number, text or None, in the record's order.  Its name is the path to it: keys joined by
        dots, the places of a list counted from 0.  Empty mappings and lists have no entry.

    Examples
    --------
    >>> flat_record({"t": 10.0, "soil": {"phi": {"value": 0.5, "std": None}}, "z_driven": [0.03, 0.05], "gaps": {}})
    {'t': 10.0, 'soil.phi.value': 0.5, 'soil.phi.std': None, 'z_driven.0': 0.03, 'z_driven.1': 0.05}
    """
    return dict(_leaves("", record))


def _leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, Mapping | list):
        yield path, value
        return
    for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
        yield from _leaves(f"{path}.{key}" if path else str(key), inner)


def column_names(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the columns of a table of flat records: those of all rows, parts of one quantity together.

    A part that is null as a whole in some rows (`soil` of an invalid window) is no column beside its own parts.

    Examples
    --------
    >>> column_names([{"t": 9.0, "soil": None, "chi2": None}, {"t": 10.0, "soil.n.value": 0.7, "chi2": 1.0}])
    ['t', 'soil.n.value', 'chi2']
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    wholes = {".".join(parts[:n]) for parts in (name.split(".") for name in names) for n in range(1, len(parts))}
    keys = list(dict.fromkeys(name.partition(".")[0] for name in names))
    return sorted(set(names) - wholes, key=lambda name: (keys.index(name.partition(".")[0]), names.index(name)))


def _capability(capability: Capability) -> dict[str, Any]:
    """The parts of the capability that `traversability` does not hold."""
    forecast = capability.forecast
    return {
        "max_draft_here": value_std(capability.max_draft_here),
        "max_grade_with_draft": value_std(capability.max_grade_with_draft),
        "set_points": {
            axle: {"efficiency": value_std(point.efficiency), "pull": value_std(point.pull)}
            for axle, point in capability.set_points.items()
        },
        "forecast": None
        if forecast is None
        else {
            "slip": value_std(forecast.slip),
            "torque": value_std(forecast.torque),
            "sinkage": values_std(forecast.sinkage),
        },
        "over_slip": {
            column: getattr(capability.over_slip, column).tolist()
            for column in ("slip", "pull", "pull_std", "torque", "torque_std")
        },
    }


def likeliest(soil_class: Mapping[str, float]) -> dict[str, float]:
    """Return the MAX_CLASSES most likely known soils and `unknown`, likeliest first."""
    known = [name for name in soil_class if name != UNKNOWN][:MAX_CLASSES]
    return {name: p for name, p in soil_class.items() if name in known or name == UNKNOWN}


def value_std(estimate: Estimate | None) -> dict[str, float | None]:
    """Return a value with its standard deviation, for JSON; None where not known."""
    return {"value": None, "std": None} if estimate is None else {"value": estimate.value, "std": estimate.std}


def values_std(estimates: Mapping[str, Estimate]) -> dict[str, dict[str, float | None]]:
    """Return values with their standard deviations, by name, for JSON."""
    return {name: value_std(estimate) for name, estimate in estimates.items()}


def hop_frames(result: WindowResult) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (message, values in the DBC's units) of the frames that are sent once per window."""
    common = {"Window": result.index % WINDOW_MODULUS, "Status": str(result.status)}
    bearing, decision = result.bearing, result.traversability
    yield (
        "SoilStrength",
        common | {"Chi2": result.chi2} | _value_and_std("BearingPressure", "BearingPressureStd", bearing, 1e3),
    )
    yield "SoilClass", common | _soil_class(result.soil_class)
    parameters = {} if result.posterior is None else result.posterior.parameters()
    for name, (message, _, unit) in PARAMETER_FRAMES.items():
        yield message, common | _value_and_std("Value", "Std", parameters.get(name), unit)
    yield "DraftCapability", common | _value_and_std("MaxDraft", "MaxDraftStd", decision.max_draft, 1.0)
    yield "GradeCapability", common | _value_and_std("MaxGrade", "MaxGradeStd", decision.max_grade, 1.0)
    yield "TractionAdvice", common | _advice(decision.capability)
    yield "TractionLimits", common | {"LimitingCause": decision.limit} | _limits(decision.capability)
    for message, values in _by_wheel("WheelSinkage", "SinkageWheel", result.sinkage, 1e-3):
        yield message, common | values
    yield "WindowQuality", {"Window": common["Window"]} | _quality(result)


def _quality(result: WindowResult) -> dict[str, Any]:
    """Chi-square of each channel; the most frequent reason of refusals, and the number of all."""
    rejected = result.rejected
    reason = max(rejected, key=lambda name: rejected[name]) if rejected else "none"
    chi2 = {f"Chi2{channel.capitalize()}": value for channel, value in result.channel_chi2.items()}
    return chi2 | {"RejectedReason": REASONS_AS_SENT.get(reason, reason), "Rejected": sum(rejected.values())}


def _value_and_std(value: str, std: str, estimate: Estimate | None, unit: float) -> dict[str, float | None]:
    if estimate is None:
        return {value: None, std: None}
    return {value: estimate.value / unit, std: estimate.std / unit}


def _soil_class(soil_class: Mapping[str, float] | None) -> dict[str, str | float | None]:
    if soil_class is None:
        return {"Kind": None, "Probability": None, "UnknownProbability": None}
    kind, probability = next(iter(soil_class.items()))
    return {"Kind": kind, "Probability": probability, "UnknownProbability": soil_class[UNKNOWN]}


def _advice(capability: Capability | None) -> dict[str, float | None]:
    points = {} if capability is None else capability.set_points
    values = {}
    for axle, name in (("front", "Front"), ("rear", "Rear")):
        point = points.get(axle)
        for what in ("Efficiency", "Pull"):
            slip = None if point is None else getattr(point, what.lower())
            values[f"SlipFor{what}{name}"] = None if slip is None else slip.value
    return values


def _limits(capability: Capability | None) -> dict[str, float | None]:
    draft, grade = (None, None) if capability is None else (capability.max_draft_here, capability.max_grade_with_draft)
    return _value_and_std("MaxDraft", "MaxDraftStd", draft, 1.0) | _value_and_std("MaxGrade", "MaxGradeStd", grade, 1.0)


def forecast_frame(result: WindowResult | None, watch: Watch) -> tuple[str, dict[str, Any]]:
    """Return (message, values) of forecast and warning; `result` is None where none is valid any more."""
    capability = None if result is None else result.traversability.capability
    forecast = None if capability is None else capability.forecast
    return "DemandForecast", {
        "Slip": None if forecast is None else forecast.slip.value,
        "SlipStd": None if forecast is None else forecast.slip.std,
        "Sinkage": None if forecast is None else forecast.deepest.value * 1e3,
        "TimeLeft": None if watch.time_left is None else min(watch.time_left, LONGEST_TIME),
        "Warning": str(watch.warning),
        "Window": None if result is None else result.index % WINDOW_MODULUS,
        "Status": None if result is None else str(result.status),
    }


def demand_frame(draft: float | None, pitch: float | None) -> tuple[str, dict[str, Any]]:
    """Return (message, values) of the present draft [N] and pitch [rad]; None where not known."""
    return "PresentDemand", {"Draft": draft, "Slope": pitch}


def known(value: Any) -> Any:
    """Return nested dicts and lists for JSON, with None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: known(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [known(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def slip_frames(slip: Mapping[str, float | None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (message, values) of the wheel slips, wheels in the order of the configuration."""
    return _by_wheel("WheelSlip", "SlipWheel", slip, 1.0)


def _by_wheel(
    message: str, signal: str, values: Mapping[str, float | None], unit: float
) -> Iterator[tuple[str, dict[str, Any]]]:
    numbered = [(i, None if v is None else v / unit) for i, v in enumerate(values.values(), start=1)]
    yield message, {f"{signal}{i}": v for i, v in numbered if i <= 4}
    if len(numbered) > 4:
        yield message + "2", {f"{signal}{i}": v for i, v in numbered if i > 4}
