"""What was received as one object for JSON: the keys of `replay --json` where the quantity is the same, SI units.

The reading rules of dbc/README.md hold: what is stale, refused, not available or an error is None.
"""

from __future__ import annotations

from typing import Any

from soilbus.pipeline.outputs import PARAMETER_FRAMES, known
from soilbus.report.dashboard import Dashboard
from soilbus.report.received_frames import BUS_COUNTS


def received_record(dashboard: Dashboard, t: float | None) -> dict[str, Any]:
    """Return what the received frames say as nested dicts (keys: docs/json.md).

    t: time [s] of the newest frame; None before the first.
    """
    received, wheels = dashboard.known, dashboard.wheels()
    number, value = received.number, received.value

    def both(message: str, name: str, std: str = "", unit: float = 1.0) -> dict[str, float | None]:
        values = number(message, name), number(message, std or f"{name}Std")
        return {key: _times(x, unit) for key, x in zip(("value", "std"), values, strict=True)}

    def set_point(of: str) -> dict[str, float | None]:
        return {"value": number("TractionAdvice", f"SlipFor{of}"), "std": None}

    verdict, kind = value("Traversability", "State"), value("SoilClass", "Kind")
    likely, unknown = (number("SoilClass", name) for name in ("Probability", "UnknownProbability"))
    record: dict[str, Any] = {
        "t": t,
        "window": _whole(number("WindowQuality", "Window")),
        "status": value("SoilStrength", "Status"),
        "state": value("SoilbusStatus", "State"),
        "reason": value("SoilbusStatus", "Reason"),
        "soil": {name: both(message, "Value", "Std", unit) for name, (message, _, unit) in PARAMETER_FRAMES.items()},
        "bearing_pressure": both("SoilStrength", "BearingPressure", unit=1e3),
        "soil_class": None if kind is None else {str(kind): likely, "unknown": unknown},
        "slip": {dashboard.vehicle.name(i): dashboard.wheel_slip(i) for i in wheels},
        "sinkage": {dashboard.vehicle.name(i): _times(dashboard.wheel_sinkage(i), 1e-3) for i in wheels},
        "traversability": {
            "state": verdict if verdict in ("go", "caution", "no_go") else "unknown",
            "probability": number("Traversability", "Probability"),
            "torque_required": number("TorqueDemand", "TorqueRequired"),
            "torque_available": number("TorqueDemand", "TorqueAvailable"),
            "max_draft": both("DraftCapability", "MaxDraft"),
            "max_grade": both("GradeCapability", "MaxGrade"),
            "limit": value("Traversability", "LimitingCause"),
            "age": number("Traversability", "Age"),
            "since_valid": number("Traversability", "SinceValid"),
        },
        "capability": {
            "max_draft_here": both("TractionLimits", "MaxDraft"),
            "max_grade_with_draft": both("TractionLimits", "MaxGrade"),
            "set_points": {
                axle.lower(): {"efficiency": set_point(f"Efficiency{axle}"), "pull": set_point(f"Pull{axle}")}
                for axle in ("Front", "Rear")
            },
            "forecast": {"slip": both("DemandForecast", "Slip")},
        },
        "warning": {
            "state": value("DemandForecast", "Warning") or "unknown",
            "time_left": number("DemandForecast", "TimeLeft"),
        },
        "demand": {"draft": number("PresentDemand", "Draft"), "slope": number("PresentDemand", "Slope")},
        "chi2": number("SoilStrength", "Chi2"),
        "bus": {key: _whole(number("BusHealth", signal)) for signal, key in BUS_COUNTS.items()},
        "bad_frames": received.bad_frames,
        "second_sender": received.has_second_sender,
        "fault": dashboard.fault or None,
        "text": ". ".join(dashboard.sentences()) + ".",
    }
    return dict(known(record))


def gist(record: dict[str, Any]) -> tuple[Any, ...]:
    """Return the window and the states of a record, whose change is worth a line."""
    of_window = (record[key] for key in ("window", "status", "state", "reason", "fault", "second_sender"))
    return (*of_window, record["traversability"]["state"], record["warning"]["state"])


def _whole(value: float | None) -> int | None:
    return None if value is None else round(value)


def _times(value: float | None, unit: float) -> float | None:
    return None if value is None else value * unit
