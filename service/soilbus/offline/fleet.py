"""Find which vehicles of a fleet have which fault, by their logs.

logs of a vehicle -> records -> diagnosis/fleet.py -> findings of this vehicle
findings of all vehicles -> diagnosis.json, effects.parquet
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from soilbus.diagnosis.diagnose import NotFitted
from soilbus.diagnosis.fleet import FALSE_DISCOVERY_RATE, Onset, diagnose_vehicle, named
from soilbus.diagnosis.records import Record, TooLittle
from soilbus.estimation.assembly import possible_effects, prior_of
from soilbus.offline.parts import Job, local_log, unpacked
from soilbus.offline.recordings import recordings_of
from soilbus.offline.replay import LogError
from soilbus.pipeline.outputs import values_std
from soilbus.words import one_line

MAX_LOGS = 12
"""Logs of a vehicle that are diagnosed together, evenly over its dates: the time grows with their number."""
LONGEST = 600.0
"""Time [s] of each log that is diagnosed, from its beginning; a diagnosis of some minutes finds what it can find."""


def chosen(jobs: Sequence[Job]) -> list[Job]:
    """Return at most MAX_LOGS of a vehicle's logs, spread evenly over their dates."""
    if len(jobs) <= MAX_LOGS:
        return list(jobs)
    return [jobs[i] for i in np.linspace(0, len(jobs) - 1, MAX_LOGS).round().astype(int)]


def findings_of(jobs: Sequence[Job]) -> dict[str, Any]:
    """Diagnose the logs of one vehicle, in the order of their dates; `fault` says what cannot be diagnosed."""
    config, database = unpacked(jobs[0].setup.content)
    record = no_findings(jobs[0].vehicle, "no log of it can be diagnosed")
    if database is None:
        return record | {"fault": "tables of a test rig are no vehicle"}
    records: list[Record] = []
    for job in jobs:
        try:
            with local_log(job.log) as path:
                read = recordings_of(config, database, [path], longest=LONGEST, partial=True).records
        except (LogError, TooLittle, OSError) as error:
            record["left_out"].append({"log": job.log, "fault": one_line(error, 200)})
            continue
        records += read
        record["logs"] += [job.log] * len(read)
    if not records:
        return record
    catalogue = possible_effects(config)
    try:
        found = diagnose_vehicle(records, prior_of(config), catalogue)
    except (NotFitted, np.linalg.LinAlgError) as error:
        return record | {"fault": one_line(error, 200)}
    diagnosis = found.diagnosis
    gap = {"before": diagnosis.gap_before.value, "after": diagnosis.gap_after.value}
    record |= {"fault": None, "verdict": str(diagnosis.verdict), "gap": gap}
    values = diagnosis.completed.parameters()
    scope = {effect.name: "log" if effect.of_record else "vehicle" for effect in catalogue}
    record["effects"] = [
        {
            "name": name,
            "scope": scope[name],
            "probability": probability,
            "parameters": values_std(values.get(name, {})),
            "onset": _onset(found.onsets.get(name), record["logs"]),
        }
        for name, probability in found.probabilities.items()
    ]
    return record


def _onset(onset: Onset | None, logs: Sequence[str]) -> dict[str, Any] | None:
    """The first log with an effect, and the size in each log alone."""
    if onset is None:
        return None
    by_log = zip(logs, onset.probabilities, onset.sizes, strict=True)
    return {
        "log": logs[onset.first],
        "probability": onset.probabilities[onset.first],
        "never": onset.never,
        "by_log": [{"log": log, "probability": p, "parameters": values_std(s or {})} for log, p, s in by_log],
    }


def no_findings(vehicle: str, fault: str) -> dict[str, Any]:
    """Return the findings of a vehicle that cannot be diagnosed, and why."""
    return {"vehicle": vehicle, "logs": [], "left_out": [], "verdict": None, "fault": fault, "effects": []}


def judged(findings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the fleet's diagnosis from the findings of each vehicle with its configuration.

    It has these, `named` with each effect, and for each effect the share of vehicles that are expected to have it.
    """
    effects = [effect for each in findings for effect in each["effects"]]
    for effect, given in zip(effects, named([effect["probability"] for effect in effects]), strict=True):
        effect["named"] = given
    diagnosed = sum(each["verdict"] is not None for each in findings)
    expected, names = Counter[str](), Counter[str]()
    for each in findings:
        for effect in each["effects"]:
            expected[effect["name"]] += effect["probability"]
            names[effect["name"]] += effect["named"]
    shares = [
        {"name": name, "vehicles_named": names[name], "expected_share": expected[name] / diagnosed}
        for name in sorted(expected)
    ]
    head = {"false_discovery_rate": FALSE_DISCOVERY_RATE, "vehicles_diagnosed": diagnosed}
    return {**head, "effects": shares, "vehicles": list(findings)}


def effect_rows(fleet: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of effects.parquet: one for each parameter of each effect of a vehicle or a log."""
    rows = []
    for each in fleet["vehicles"]:
        for effect in each["effects"]:
            onset = effect.get("onset")
            row = {
                "configuration": each["configuration"],
                "vehicle": each.get("vehicle"),
                "effect": effect["name"],
                "scope": effect["scope"],
                "probability": effect["probability"],
                "named": effect["named"],
                "since": onset["log"] if onset else None,
            }
            parameters = effect["parameters"] or {None: {"value": None, "std": None}}
            rows += [row | {"parameter": name, **values} for name, values in parameters.items()]
    return rows
