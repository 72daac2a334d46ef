"""A batch as text: one table, a row for each vehicle, then what failed and what it cost."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from soilbus.offline.batch import Batch
from soilbus.report.table import AT_EDGE, table, value_text
from soilbus.words import shown, text_of

MAX_ROWS = 40
"""Vehicles that the table lists; all are in vehicles.parquet."""
MAX_FAULTS = 5
"""Faults that the text lists; all are in errors.parquet."""


def batch_text(batch: Batch, out: Path) -> str:
    """Return the table of a batch and the lines below it."""
    head = ("vehicle", "logs", "failed", "damaged", "hours", "windows", "valid", "pressure, kPa", "refused samples")
    text = table(head, [_row(row) for row in batch.vehicles[:MAX_ROWS]])
    if len(batch.vehicles) > MAX_ROWS:
        text += f"and {len(batch.vehicles) - MAX_ROWS} more vehicles in {shown(out / 'vehicles.parquet')}\n"
    logs, failed = (sum(row[f"logs.{which}"] for row in batch.vehicles) for which in ("all", "failed"))
    text += f"{logs - failed} of {logs} logs done, {batch.windows} windows"
    text += f"; {batch.resumed - batch.failed_before} logs were done before" if batch.resumed else ""
    text += f"; {batch.failed_before} with a fault were not read again (--retry does)" if batch.failed_before else ""
    text += "\n"
    for error in batch.errors[:MAX_FAULTS]:
        kept = f" (the {error['windows']} windows before that are kept)" if error["windows"] else ""
        text += text_of([f"  {error['fault']}{kept}"])
    if len(batch.errors) > MAX_FAULTS:
        text += f"  and {len(batch.errors) - MAX_FAULTS} more in {shown(out / 'errors.parquet')}\n"
    if batch.stale_diagnosis:
        text += "diagnosis.json and effects.parquet of an earlier run are removed; --diagnose writes them again\n"
    return text + (fleet_text(batch.fleet) if batch.fleet else "")


def fleet_text(fleet: Mapping[str, Any]) -> str:
    """Return which vehicles have which fault, and since when, in words."""
    done = f"{fleet['vehicles_diagnosed']} of {len(fleet['vehicles'])} vehicles diagnosed"
    lines = [f"{done}; of the names given, at most {fleet['false_discovery_rate']:.0%} are expected to be false"]
    for vehicle in fleet["vehicles"]:
        for effect in vehicle["effects"]:
            if effect["named"]:
                since, onset = "", effect["onset"]
                if onset and onset["log"] != vehicle["logs"][0]:
                    since = f", since {onset['log']} (probability {onset['probability']:.2f})"
                found = effect["parameters"].items()
                sizes = (f"{name} {value_text(of['value'], of['std'], AT_EDGE, '±')}" for name, of in found)
                lines.append(f"  {vehicle['vehicle']}: {effect['name']} ({', '.join(sizes)}){since}")
        if vehicle["fault"]:
            lines.append(f"  {vehicle['vehicle']}: not diagnosed: {vehicle['fault']}")
    return text_of(lines)


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    pressure = row.get("bearing_pressure.mean")
    refused = sum(value or 0 for name, value in row.items() if name.startswith("rejected."))
    return (
        str(row["vehicle"]), str(row["logs.all"]), str(row["logs.failed"]), str(row["logs.damaged"]),
        f"{(row.get('duration') or 0.0) / 3600.0:.2f}", str(row.get("windows.all") or 0),
        str(row.get("windows.valid") or 0), "-" if pressure is None else f"{pressure / 1e3:.1f}", str(refused),
    )  # fmt: skip
