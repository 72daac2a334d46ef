"""From recorded logs, or tables of a test rig, to a diagnosis.

Logs become records (offline/recordings.py), tables become records (offline/tables.py); diagnosis/diagnose.py does the
rest. Which effects may be candidates depends on the source: a table holds slip instead of speeds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soilbus.can.dbc_files import load_databases
from soilbus.config.model import Config
from soilbus.decision.capability import assess
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.diagnosis.diagnose import Diagnosis, NotFitted, diagnose
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.estimation.assembly import possible_effects, prior_of
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.offline.manoeuvre import Plan, what_to_drive
from soilbus.offline.recordings import Recordings, recordings_of
from soilbus.offline.tables import candidates, recordings_of_tables
from soilbus.pipeline.intake import ReportedLimits

__all__ = ["Findings", "diagnose_logs"]


@dataclass(frozen=True, slots=True)
class Findings:
    """Diagnosis with the recordings and the configuration that it was made from.

    `seconds` is the time that it took, without reading. The plan says what to drive next where it is ambiguous; it is
    None where no drive would help.
    """

    diagnosis: Diagnosis
    recordings: Recordings
    config: Config
    seconds: float
    plan: Plan | None = None

    def soils(self) -> list[tuple[str, Posterior, Posterior]]:
        """Return the name, soil before and soil after of the first part of each log."""
        names, found = [record.name for record in self.recordings.records], self.diagnosis
        return [(names[i], found.soil_before(i), found.soil_after(i)) for i in self.recordings.first]

    def largest_drafts(self) -> list[tuple[str, Estimate | None, Estimate | None]]:
        """Return the name, and largest steady draft [N] before and after, of the first part of each log.

        Within the torque limits that the configuration names; None without a vehicle and where none is within limits.
        """
        found, soils = self.diagnosis, self.soils()
        drafts = []
        for i, (name, soil_before, soil_after) in zip(self.recordings.first, soils, strict=True):
            before = largest_draft(found.base, i, soil_before, self.config)
            after = largest_draft(found.completed, i, soil_after, self.config)
            drafts.append((name, before, after))
        return drafts


def largest_draft(fitted: FittedModel, record: int, soil: Posterior, config: Config) -> Estimate | None:
    """Return the largest steady draft [N] on the level under a fitted model, on one recording's soil."""
    problem, latents = fitted.checks[record].problem, fitted.checks[record].latents
    if problem.rig.chassis is None:
        return None
    model = UncertainModel.of(
        problem.model, fitted.effects, fitted.free, fitted.fits[record].mode, len(problem.rig.wheels),
        float(latents.ground_speed.mean()),
    )  # fmt: skip
    limit = ReportedLimits(config, problem.rig).at(0.0)
    settings = config.traversability
    capability, _ = assess(soil, problem.rig, model, None, limit, settings.max_slip, settings.max_sinkage)
    return None if capability is None else capability.max_draft


def diagnose_logs(config: Config, logs: Sequence[Path], say: Callable[[str], None] | None = None) -> Findings:
    """Read logs, or with [table] tables, and diagnose them together; `say` is called with the name of each phase.

    LogError, TooLittle and ConfigError as recordings_of(); NotFitted where the present model cannot be fitted.
    """
    report = say or (lambda _: None)
    if config.table is None:
        recordings = recordings_of(config, load_databases(config), logs, lambda n, _: report(f"reading, {n} frames"))
        catalogue = possible_effects(config)
    else:
        recordings = recordings_of_tables(config, logs)
        catalogue = candidates(config, recordings.records)
    begin = time.perf_counter()
    try:
        diagnosis = diagnose(recordings.records, prior_of(config), catalogue, report)
    except np.linalg.LinAlgError as error:
        raise NotFitted(f"the recordings do not determine the model: {error}") from None
    seconds = time.perf_counter() - begin
    if diagnosis.rivals:
        report("finding what to drive next")
    return Findings(diagnosis, recordings, config, seconds, what_to_drive(diagnosis, config))
