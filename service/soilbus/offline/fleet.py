"""Logs of a fleet -> which vehicles have which fault: read, diagnosed vehicle by vehicle, then judged together.

logs of a vehicle -> records -> diagnosis/fleet.py -> findings of a vehicle
findings of a type -> diagnosis/vehicle_type.py -> effects of the type -> each vehicle once more, beside them
findings of all -> diagnosis.json, effects.parquet
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from soilbus.diagnosis.diagnose import NotFitted
from soilbus.diagnosis.evidence import OwnParameters
from soilbus.diagnosis.fleet import FALSE_DISCOVERY_RATE, Onset, by_name, diagnose_vehicle, named
from soilbus.diagnosis.records import Record, TooLittle
from soilbus.diagnosis.vehicle_type import Factor, SharedEffect, own_probabilities, records_with, shared_effects
from soilbus.estimation.assembly import possible_effects, prior_of
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.offline.parts import Job, Setup, check_version, local_log, unpacked
from soilbus.offline.recordings import recordings_of
from soilbus.offline.replay import LogError
from soilbus.pipeline.outputs import values_std
from soilbus.terra.effects.effect import Effect
from soilbus.words import one_line

Given = Mapping[str, Mapping[str, Sequence[float]]]
"""Effects of a type by name: value and std of each parameter by its name."""

MAX_LOGS = 12
"""Logs of a vehicle that are diagnosed together, evenly over its dates: the time grows with their number."""
LONGEST = 600.0
"""Time [s] of each log that is diagnosed, from its beginning; a diagnosis of some minutes finds what it can find."""


def chosen(jobs: Sequence[Job]) -> list[Job]:
    """At most MAX_LOGS of a vehicle's logs in the order of their dates: the first, the last, and evenly between."""
    if len(jobs) <= MAX_LOGS:
        return list(jobs)
    return [jobs[i] for i in np.linspace(0, len(jobs) - 1, MAX_LOGS).round().astype(int)]


def findings_of(jobs: Sequence[Job], version: str, given: Given) -> dict[str, Any]:
    """What the logs of one vehicle show together; what cannot be diagnosed is said in `fault`.

    Parameters
    ----------
    jobs
        Logs of one vehicle with one configuration, in the order of their dates.
    version
        Of the soilbus that asks for it.
    given
        Effects of the vehicle's type, that it has.

    Raises
    ------
    OtherVersion
        This soilbus is of another version.
    """
    check_version(version)
    config, database = unpacked(jobs[0].setup.content)
    record = no_findings(jobs[0].vehicle, "no log of it can be diagnosed")
    if database is None:
        return record | {"fault": "tables of a test rig are no vehicle"}
    records: list[Record] = []
    for job in jobs:
        try:
            with local_log(job) as path:
                read = recordings_of(config, database, [path], longest=LONGEST, partial=True).records
        except (LogError, TooLittle, OSError) as error:
            record["left_out"].append({"log": job.log, "fault": one_line(error, 200)})
            continue
        records += read
        record["logs"] += [job.log] * len(read)
    if not records:
        return record
    catalogue = possible_effects(config)
    for effect in catalogue:
        if effect.name in given:
            records = records_with(records, effect, _free(effect, len(config.wheel), given[effect.name]))
    try:
        found = diagnose_vehicle(records, prior_of(config), catalogue)
    except (NotFitted, np.linalg.LinAlgError) as error:
        return record | {"fault": one_line(error, 200)}
    diagnosis = found.diagnosis
    record |= {
        "fault": None,
        "verdict": str(diagnosis.verdict),
        "gap": {"before": diagnosis.gap_before.value, "after": diagnosis.gap_after.value},
    }
    values = diagnosis.completed.parameters()
    record["places"] = found.places
    record["parameters"] = {name: values_std(values.get(name, {})) for name in by_name(found.places)}
    record["onsets"] = {name: _onset(onset, record["logs"]) for name, onset in found.onsets.items()}
    record["factors"] = {name: _plain(factor) for name, factor in found.factors.items()}
    return record


def _free(effect: Effect, n_wheels: int, values: Mapping[str, Sequence[float]]) -> list[Free]:
    """An effect's parameters with these values and std as prior."""
    return [replace(f, value=values[f.name][0], std=values[f.name][1]) for f in parameters_of(effect, n_wheels)]


def _plain(factor: Factor) -> dict[str, Any]:
    return {
        "falls": dict(factor.falls),
        "excess": factor.excess,
        "parameters": [f.name for f in factor.own.free],
        "information": factor.own.information.tolist(),
        "information_vector": factor.own.information_vector.tolist(),
    }


def _factor(effect: Effect, n_wheels: int, plain: Mapping[str, Any]) -> Factor:
    """The factor of which this is the plain content."""
    by_parameter = {f.name: f for f in parameters_of(effect, n_wheels)}
    free = tuple(by_parameter[name] for name in plain["parameters"])
    P = len(free)
    own = OwnParameters(
        np.array(plain["information"], float).reshape(P, P), np.array(plain["information_vector"], float), free
    )
    return Factor(plain["falls"], plain["excess"], own)


def findings_of_type(
    setup: Setup, vehicles: int, diagnosed: Callable[[Sequence[Given]], list[dict[str, Any]]]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The effects that the vehicles of one configuration share, and the findings of each beside them.

    Parameters
    ----------
    setup
        Configuration of these vehicles.
    vehicles
        Their number.
    diagnosed
        Diagnoses all of them, each beside the effects given for it.
    """
    config, _ = unpacked(setup.content)
    effects, n_wheels = {effect.name: effect for effect in possible_effects(config)}, len(config.wheel)
    findings: list[dict[str, Any]] = []

    def factors_beside(shared: tuple[SharedEffect, ...]) -> list[dict[str, Factor]]:
        given = [
            {one.effect.name: {f.name: (f.value, f.std) for f in one.given[v]} for one in shared}
            for v in range(vehicles)
        ]
        findings[:] = diagnosed(given)
        return [
            {name: _factor(effects[name], n_wheels, plain) for name, plain in each["factors"].items()}
            for each in findings
        ]

    shared = shared_effects(effects, n_wheels, factors_beside)
    own = own_probabilities([each["places"] for each in findings], len(effects))
    for each, places in zip(findings, own, strict=True):
        each["effects"] = [
            {
                "name": name,
                "scope": "log" if effects[name].of_record else "vehicle",
                "probability": p,
                "parameters": each["parameters"][name],
                "onset": each["onsets"].get(name),
            }
            for name, p in by_name(places).items()
        ]
    of_type = {
        "configuration": setup.name,
        "vehicles": [each["vehicle"] for each in findings],
        "effects": [
            {
                "name": one.effect.name,
                "scope": "type",
                "probability": one.probability,
                "parameters": values_std(_with_wheels(one.parameters, [wheel.name for wheel in config.wheel])),
                "agreeing": [findings[v]["vehicle"] for v in one.vehicles],
            }
            for one in shared
        ],
    }
    public = [{k: v for k, v in each.items() if k not in INTERNAL} for each in findings]
    return of_type, [each | {"configuration": setup.name} for each in public]


INTERNAL = ("places", "parameters", "onsets", "factors")
"""Of a vehicle's findings, what only the judgement of its type needs."""


def _with_wheels(values: Mapping[str, Any], wheels: Sequence[str]) -> dict[str, Any]:
    """Parameters of a wheel, named by its number, with its name."""
    names = {name: name.rpartition(".") for name in values}
    return {f"{n[0]}_{wheels[int(n[2])]}" if n[0] else name: values[name] for name, n in names.items()}


def _onset(onset: Onset, logs: Sequence[str]) -> dict[str, Any]:
    """The first log with an effect, and the size in each log alone."""
    by_log = zip(logs, onset.probabilities, onset.sizes, strict=True)
    return {
        "log": logs[onset.first],
        "probability": onset.probabilities[onset.first],
        "never": onset.never,
        "by_log": [{"log": log, "probability": p, "parameters": values_std(s or {})} for log, p, s in by_log],
    }


def no_findings(vehicle: str, fault: str) -> dict[str, Any]:
    """Findings of a vehicle that cannot be diagnosed, and why."""
    nothing: dict[str, Any] = {"places": [], "parameters": {}, "onsets": {}, "factors": {}}
    return {"vehicle": vehicle, "logs": [], "left_out": [], "verdict": None, "fault": fault} | nothing


def judged(types: Sequence[dict[str, Any]], findings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The fleet's diagnosis.

    Parameters
    ----------
    types, findings
        Of each type, and of each vehicle, as findings_of_type() gives them.

    Returns
    -------
    Both, `named` with each effect, and for each effect the share of vehicles that are expected to have it of their own.
    """
    effects = [effect for each in (*types, *findings) for effect in each["effects"]]
    for effect, given in zip(effects, named([effect["probability"] for effect in effects]), strict=True):
        effect["named"] = given
    diagnosed = sum(each["verdict"] is not None for each in findings)
    expected, names = Counter[str](), Counter[str]()
    for each in findings:
        for effect in each["effects"]:
            expected[effect["name"]] += effect["probability"]
            names[effect["name"]] += effect["named"]
    return {
        "false_discovery_rate": FALSE_DISCOVERY_RATE,
        "vehicles_diagnosed": diagnosed,
        "effects": [
            {
                "name": name,
                "vehicles_named": names[name],
                "expected_share": expected[name] / diagnosed,
            }
            for name in sorted(expected)
        ],
        "types": list(types),
        "vehicles": list(findings),
    }


def effect_rows(fleet: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of effects.parquet: one for each parameter of each effect of a type, a vehicle or a log."""
    rows = []
    for each in (*fleet["types"], *fleet["vehicles"]):
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
