"""Soil along the route as GeoJSON (RFC 7946): one point for each window, in the middle of its data.

Coordinates are WGS84 in degrees, longitude first. Every property has its unit in its name; an unknown value is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from soilbus.config.model import Config, ConfigError
from soilbus.estimation.posterior import Estimate
from soilbus.pipeline.outputs import known
from soilbus.pipeline.result import WindowResult, is_date

DEGREE_DECIMALS = 7
"""Decimals of a degree: the seventh is a centimetre."""


def check_position_is_mapped(config: Config, option: str) -> None:
    """Raise ConfigError where an option needs a position that is not mapped."""
    if config.signals.latitude is None:
        raise ConfigError([f"{option} needs a position: map signals.latitude and signals.longitude"])


def soil_map(results: Iterable[WindowResult]) -> tuple[str, int]:
    """Return a FeatureCollection, one feature a line.

    Returns
    -------
    The text, and the number of windows without a position, which it leaves out.
    """
    every = list(results)
    features = [json.dumps(known(_feature(r)), allow_nan=False) for r in every if r.position is not None]
    body = ",\n".join(features)
    return f'{{"type": "FeatureCollection", "features": [\n{body}\n]}}\n', len(every) - len(features)


def _feature(result: WindowResult) -> dict[str, Any]:
    assert result.position is not None
    latitude, longitude = (round(math.degrees(angle), DEGREE_DECIMALS) for angle in result.position)
    point = {"type": "Point", "coordinates": [longitude, latitude]}
    return {"type": "Feature", "id": result.index, "geometry": point, "properties": _properties(result)}


def _properties(result: WindowResult) -> dict[str, Any]:
    decision, parameters = result.traversability, {} if result.posterior is None else result.posterior.parameters()
    likeliest = max(result.soil_class.items(), key=lambda item: item[1]) if result.soil_class else (None, None)
    return {
        "log": result.log,
        "window": result.index,
        "t": round(result.t, 6),
        "time": _time(result.t),
        "status": str(result.status),
        "reason": result.reason,
        **_value_std("bearing_pressure", "kpa", result.bearing, 1e3),
        **_value_std("phi", "deg", parameters.get("phi"), math.pi / 180.0),
        "soil_class": likeliest[0],
        "soil_class_probability": likeliest[1],
        "state": str(decision.state),
        "probability": decision.probability,
        **_value_std("max_draft", "n", decision.max_draft, 1.0),
        "limit": decision.limit,
    }


def _time(t: float) -> str | None:
    """ISO 8601; None for a time stamp [s] that is no date."""
    return datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds") if is_date(t) else None


def _value_std(name: str, unit: str, estimate: Estimate | None, factor: float) -> dict[str, float | None]:
    value, std = (None, None) if estimate is None else (estimate.value / factor, estimate.std / factor)
    return {f"{name}_{unit}": value, f"{name}_std_{unit}": std}
