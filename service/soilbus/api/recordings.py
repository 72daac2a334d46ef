"""Recordings: replayed to a table of windows, diagnosed, simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.config.edit import with_effects_text
from soilbus.config.file import found_configuration, load_config
from soilbus.config.model import Config
from soilbus.diagnosis.model_out import effect_tables
from soilbus.estimation.assembly import with_effects
from soilbus.files import whole_file
from soilbus.offline.diagnose import Findings, diagnose_logs
from soilbus.offline.replay import replay as replay_logs
from soilbus.offline.tables import replay_tables
from soilbus.pipeline.outputs import column_names, flat_record, window_record
from soilbus.pipeline.pipeline import Pipeline
from soilbus.report.findings import findings_record, findings_text
from soilbus.report.statement import statement
from soilbus.simulator.frames import frames
from soilbus.simulator.play import scenario_over
from soilbus.simulator.recording import Recording
from soilbus.simulator.recording import simulate as simulate_drive
from soilbus.simulator.reference import TRACTOR

__all__ = ["Diagnosis", "diagnose", "replay", "simulate"]

PathLike = Path | str


def replay(log: PathLike | Sequence[PathLike], config: Config | PathLike) -> Any:
    """The service's own windows over recorded logs, or over tables of a test rig.

    Parameters
    ----------
    log
        File or files: every log that `soilbus replay` reads, or CSV and Parquet where the configuration has [table].
    config
        Configuration, or the path of one.

    Returns
    -------
    pandas.DataFrame or list of dict
        A row for each window in SI units, columns as in docs/json.md with dots between the keys: `t`, `status`,
        `soil.phi.value`, `bearing_pressure.std`, `slip.FL`. A list of rows, None where not known, where pandas is not
        installed.

    Raises
    ------
    LogError
        A log or table cannot be read, or not to its end.
    ConfigError
        The configuration cannot be used.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import soilbus
    >>> from soilbus.simulator.reference import TRACTOR
    >>> with TemporaryDirectory() as folder:
    ...     _ = soilbus.simulate(f"{folder}/drive.log", TRACTOR, soil="loam", duration=12.0)
    ...     windows = soilbus.replay(f"{folder}/drive.log", TRACTOR)
    >>> windows["status"].tolist()
    ['valid', 'valid']
    >>> last = windows.iloc[-1]
    >>> bool(abs(last["soil.phi.value"] - soilbus.soil_named("loam").phi) < 2.0 * last["soil.phi.std"])
    True
    """
    used, paths = _config(config), _paths(log)
    if used.table is not None:
        results = list(replay_tables(used, paths))
    else:
        results = list(replay_logs(Pipeline(used, load_databases(used)), paths))
    rows = [flat_record(window_record(result, used)) for result in results]
    if find_spec("pandas") is None:
        return rows
    return import_module("pandas").DataFrame(rows, columns=column_names(rows))


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """What the model misses in recordings; prints itself as one sentence.

    Attributes
    ----------
    findings
        The diagnosis with the recordings it was made from.
    path
        Of the configuration; None where it came without.
    """

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

    def to_dict(self) -> dict[str, Any]:
        """The object that `soilbus diagnose --json` writes (docs/json.md)."""
        return findings_record(self.findings)

    def report(self) -> str:
        """The text that `soilbus diagnose` prints."""
        return findings_text(self.findings)

    def write_model(self, out: PathLike) -> None:
        """Write the configuration with the effects found added, as `soilbus diagnose --model-out` does.

        Raises
        ------
        ValueError
            The diagnosis was made with a configuration that is not from a file.
        OSError
            `out` cannot be written.
        """
        if self.path is None:
            raise ValueError("diagnose() was given a configuration without its file: give the path of the TOML file")
        out = Path(out)
        effects, notes = effect_tables(self.findings.diagnosis.completed)
        text = with_effects_text(self.path, [], effects, out.parent, notes)
        with whole_file(out) as file:
            file.write(text)


def diagnose(logs: PathLike | Sequence[PathLike], config: Config | PathLike) -> Diagnosis:
    """Find what the model misses in logs, or in tables of a test rig, and name it.

    Parameters
    ----------
    logs
        File or files, diagnosed together: each has its own soil, sensors and effects are the same in all.
    config
        Configuration, or the path of one.

    Returns
    -------
    Diagnosis

    Raises
    ------
    LogError, TooLittle
        A log or table cannot be read, or holds too little.
    NotFitted
        The present model cannot be fitted.
    ConfigError
        The configuration cannot be used.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import soilbus
    >>> from soilbus.simulator.reference import TRACTOR
    >>> with TemporaryDirectory() as folder:
    ...     _ = soilbus.simulate(f"{folder}/drive.log", TRACTOR, duration=40.0, effects={"slip_sinkage": 0.5})
    ...     found = soilbus.diagnose(f"{folder}/drive.log", TRACTOR)
    >>> found.verdict, list(found.effects)
    ('named', ['slip_sinkage'])
    >>> found
    an effect is missing, and the data tell which: slip_sinkage (gap 1.47 -> 1.02)
    """
    path = None if isinstance(config, Config) else found_configuration(str(config))
    return Diagnosis(diagnose_logs(_config(config), _paths(logs)), path)


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
    config
        The vehicle, or the path of its configuration; by default the reference tractor.
    soil
        Name of a known soil, or of several, each for an equal part of the time.
    duration
        [s].
    effects
        Values of effects that are there and that the service does not know of: {"slip_sinkage": 0.4,
        "hardpan.depth": 0.05}; a name alone is the effect's first parameter.
    seed
        Picks slips, loads, noise and gain errors; the same seed gives the same recording.

    Returns
    -------
    Recording
        True values (`truth`) and the sensors' samples (`channels`) by name, SI.

    Raises
    ------
    SimulationError
        The vehicle cannot drive there.
    KeyError
        No such soil.
    ConfigError
        The configuration cannot be used, or no effect is so named.
    OSError, ValueError
        The log cannot be written, or its format is unknown.

    Examples
    --------
    >>> import soilbus
    >>> drive = soilbus.simulate(soil="wet_clay", duration=5.0)
    >>> drive.truth["ground_speed"].shape
    (250,)
    """
    used = with_effects(_config(config), [f"{name}={value}" for name, value in (effects or {}).items()])
    recording = simulate_drive(used, scenario_over([soil] if isinstance(soil, str) else soil, duration), seed)
    if log is not None:
        write_log(frames(recording, used), Path(log))
    return recording


def _config(config: Config | PathLike) -> Config:
    return config if isinstance(config, Config) else load_config(found_configuration(str(config)))


def _paths(files: PathLike | Sequence[PathLike]) -> list[Path]:
    return [Path(files)] if isinstance(files, (str, Path)) else [Path(file) for file in files]
