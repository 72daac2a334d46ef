"""Recordings: simulated, replayed to a table of windows, diagnosed.

A configuration may be the path of one; logs are a file, a pandas DataFrame, or several of them.

>>> from tempfile import TemporaryDirectory
>>> import soilbus
>>> from soilbus.simulator.reference import TRACTOR
>>> with TemporaryDirectory() as folder:
...     log = f"{folder}/drive.log"
...     drive = soilbus.simulate(log, TRACTOR, duration=40.0, effects={"slip_sinkage": 0.5})
...     windows, samples = soilbus.replay(log, TRACTOR), soilbus.signals(log, TRACTOR)
...     found = soilbus.diagnose(log, TRACTOR)
>>> drive.truth["ground_speed"].shape, samples.attrs["units"]["draft"], windows["status"].iloc[-1]
((2000,), 'N', 'valid')
>>> found
an effect is missing, and the data tell which: slip_sinkage (gap 2.06 -> 0.95)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from soilbus.api.residuals import frame_of, plot_residuals, with_pandas
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.can.mapping import si_unit
from soilbus.config.edit import with_effects_text
from soilbus.config.file import found_configuration, load_config
from soilbus.config.model import Config
from soilbus.diagnosis.model_out import effect_tables
from soilbus.estimation.assembly import with_effects
from soilbus.files import write_text
from soilbus.offline.diagnose import Findings, diagnose_logs
from soilbus.offline.replay import fed
from soilbus.offline.replay import replay as replay_logs
from soilbus.offline.tables import replay_tables
from soilbus.pipeline.intake import Intake
from soilbus.pipeline.outputs import column_names, flat_record, window_record
from soilbus.pipeline.pipeline import Pipeline
from soilbus.report.findings import findings_record, findings_text
from soilbus.report.statement import statement
from soilbus.simulator.frames import frames
from soilbus.simulator.play import scenario_over
from soilbus.simulator.recording import Recording
from soilbus.simulator.recording import simulate as simulate_drive
from soilbus.simulator.reference import TRACTOR

__all__ = ["Diagnosis", "diagnose", "replay", "signals", "simulate"]

PathLike = Path | str
Logs = Any


def replay(log: Logs, config: Config | PathLike) -> Any:
    """Return the service's own windows over recorded logs, or over tables of a test rig.

    Returns
    -------
    pandas.DataFrame or list of dict
        A row for each window in SI units, columns as in docs/json.md with dots between the keys: `soil.phi.value`. A
        list of rows, None where not known, where pandas is not installed.

    Raises
    ------
    LogError, ConfigError
        A log or table cannot be read to its end; the configuration cannot be used.
    """
    used = _config(config)
    with _paths(log) as paths:
        is_table = used.table is not None
        found = replay_tables(used, paths) if is_table else replay_logs(Pipeline(used, load_databases(used)), paths)
        rows = [flat_record(window_record(result, used)) for result in found]
    return rows if find_spec("pandas") is None else frame_of(rows, column_names(rows))


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """What the model misses in recordings, with the path of the configuration; prints itself as one sentence."""

    findings: Findings
    path: Path | None = None

    @property
    def verdict(self) -> str:
        """`none`, `named`, `ambiguous` or `unknown`."""
        return str(self.findings.diagnosis.verdict)

    @property
    def effects(self) -> dict[str, float]:
        """Probability of each effect found, by its name in the catalogue."""
        return {added.effect.name: added.probability for added in self.findings.diagnosis.additions}

    @property
    def gap(self) -> tuple[float, float]:
        """Reduced chi-square of held-out data before and after the effects were added; 1 is noise."""
        return self.findings.diagnosis.gap_before.value, self.findings.diagnosis.gap_after.value

    def __repr__(self) -> str:
        names = f": {', '.join(self.effects)}" if self.effects else ""
        before, after = self.gap
        return f"{statement(self.findings.diagnosis)}{names} (gap {before:.2f} -> {after:.2f})"

    @property
    def residuals(self) -> Any:
        """pandas DataFrame: held-out readings of each channel beside the completed model, with slip and load, SI."""
        parts = [
            frame_of({
                "channel": series.channel, "wheel": series.wheel, "slip": series.slip, "load": series.load,
                "measured": series.measured, "modelled": series.modelled,
                "residual": series.measured - series.modelled,
            })
            for series in self.findings.diagnosis.completed.held_out_series()
        ]  # fmt: skip
        return with_pandas().concat(parts, ignore_index=True)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: probability, value and std of each parameter of the effects found."""
        parts = [(of, name, found) for of in self.to_dict()["effects"] for name, found in of["parameters"].items()]
        rows = [(of["name"], name, found["value"], found["std"], of["probability"]) for of, name, found in parts]
        return frame_of(rows, ("effect", "parameter", "value", "std", "probability"))

    def plot(self) -> Any:
        """Return a figure of matplotlib: measured over modelled, and residuals over slip and load."""
        return plot_residuals(self.residuals)

    def to_dict(self) -> dict[str, Any]:
        """Return the object that `soilbus diagnose --json` writes (docs/json.md)."""
        return findings_record(self.findings)

    def report(self) -> str:
        """Return the text that `soilbus diagnose` prints."""
        return findings_text(self.findings)

    def write_model(self, out: PathLike) -> None:
        """Write the configuration with the effects found added, as `soilbus diagnose --model-out` does.

        ValueError where it was not read from a file.
        """
        if self.path is None:
            raise ValueError("diagnose() was given a configuration without its file: give the path of the TOML file")
        out = Path(out)
        effects, notes = effect_tables(self.findings.diagnosis.completed)
        write_text(out, with_effects_text(self.path, [], effects, out.parent, notes))


def diagnose(logs: Logs, config: Config | PathLike) -> Diagnosis:
    """Find what the model misses in logs, or in tables of a test rig, and name it.

    Logs are diagnosed together: each has its own soil, sensors and effects are the same in all.

    Raises
    ------
    LogError, TooLittle, NotFitted, ConfigError
        A log cannot be read or holds too little; the present model cannot be fitted; the configuration cannot be used.
    """
    path = None if isinstance(config, Config) else found_configuration(str(config))
    with _paths(logs) as paths:
        return Diagnosis(diagnose_logs(_config(config), paths), path)


def signals(log: Logs, config: Config | PathLike) -> Any:
    """Return the decoded and admitted samples of every mapped signal of one recording.

    Returns
    -------
    pandas.DataFrame
        A column for each channel, its SI unit behind its name: `torque.FL [N.m]`; `attrs["units"]` has them, too.
        The index is the time [s]; nan where a channel has no sample then. Of two samples at one time the first.

    Raises
    ------
    LogError, ConfigError, ValueError
        As `replay`; several logs, or a configuration of a test rig, whose tables hold no signals over time.
    """
    used = _config(config)
    if used.table is not None:
        raise ValueError("a test rig's table holds no signals over time: read it with pandas")
    intake = Intake(used, load_databases(used))
    with _paths(log) as paths:
        if len(paths) != 1:
            raise ValueError(f"{len(paths)} logs: give one, and put the tables together with pandas.concat")
        for _ in fed(intake, paths[0]):
            pass
    pandas = with_pandas()
    units = {channel.name: si_unit(channel) for channel in intake.channels}
    found = {
        f"{name} [{units[name]}]" if units[name] else name: pandas.Series(column.value, column.t)
        for name, column in intake.admission.take().columns.items()
    }
    frame = pandas.concat({name: one[~one.index.duplicated()] for name, one in found.items()}, axis=1).sort_index()
    frame.index.name, frame.attrs["units"] = "t [s]", units
    return frame


def simulate(
    log: PathLike | None = None,
    config: Config | PathLike = TRACTOR,
    *,
    soil: str | Sequence[str] = "loam",
    duration: float = 60.0,
    effects: Mapping[str, float] | None = None,
    seed: int = 1,
) -> Recording:
    """Drive a vehicle of the simulator and record its bus.

    Parameters
    ----------
    log
        File that gets the frames; its name's end picks the format. None for none.
    soil, duration
        Known soils by name, each for an equal part of the time [s].
    effects
        Effects that are there and that the service does not know of: {"slip_sinkage": 0.4, "hardpan.depth": 0.05}.
    seed
        Picks slips, loads, noise and gain errors.

    Returns
    -------
    Recording
        True values (`truth`) and the sensors' samples (`channels`) by name, SI.

    Raises
    ------
    SimulationError, KeyError, ConfigError, OSError, ValueError
        The vehicle cannot drive there; no such soil; no such effect; the log cannot be written, or has no known format.
    """
    used = with_effects(_config(config), [f"{name}={value}" for name, value in (effects or {}).items()])
    recording = simulate_drive(used, scenario_over([soil] if isinstance(soil, str) else soil, duration), seed)
    if log is not None:
        write_log(frames(recording, used), Path(log))
    return recording


def _config(config: Config | PathLike) -> Config:
    return config if isinstance(config, Config) else load_config(found_configuration(str(config)))


@contextmanager
def _paths(logs: Logs) -> Iterator[list[Path]]:
    """Paths of the files; of tables in memory those of copies that last as long as the context."""
    given = [logs] if isinstance(logs, (str, Path)) or hasattr(logs, "to_csv") else list(logs)
    with TemporaryDirectory(prefix="soilbus-") as folder:
        paths = []
        for number, log in enumerate(given, 1):
            if hasattr(log, "to_csv"):
                paths.append(Path(folder, f"DataFrame{number}.csv"))
                log.to_csv(paths[-1], index=log.index.name is not None)
            else:
                paths.append(Path(log))
        yield paths
