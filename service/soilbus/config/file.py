"""A configuration from a TOML file with KEY=VALUE overrides, or from nested mappings -> a checked Config."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from soilbus.config.faults import fault_lines, open_lines
from soilbus.config.model import Config, ConfigError
from soilbus.files import read_bounded

__all__ = [
    "MACHINES", "found_configuration", "load_config", "located", "machine", "overridden", "parse_config", "shipped_dbc"
]  # fmt: skip

MAX_FILE_BYTES = 2**20  # of a configuration: a thousand times those of a tractor's
_MAX_SHOWN_CHARACTERS = 60  # of an override that a fault repeats

_PACKAGE = Path(__file__).resolve().parents[1]
MACHINES = Path(__file__).with_name("machines")
"""Where the configurations of our reference machines are."""
CONFIGURATION = "soilbus.toml"  # of a folder, for commands that are given none
DBC_FOLDERS = (_PACKAGE / "dbc", _PACKAGE.parents[1] / "dbc")
"""Where our own DBC files are: in the installed package, in a checkout."""


def load_config(path: Path | str, overrides: Iterable[str] = ()) -> Config:
    """Read a TOML file, apply overrides, check everything.

    Parameters
    ----------
    overrides
        KEY=VALUE with dotted paths.

    Raises
    ------
    ConfigError
        With one line for each fault.
    """
    path = Path(path)
    try:
        raw = tomllib.loads(read_bounded(path, MAX_FILE_BYTES, regular=False).decode("utf-8-sig"))
    except OSError as error:
        raise ConfigError([f"{path}: {error.strerror or error}"]) from None
    except (ValueError, RecursionError) as error:
        raise ConfigError([f"{path}: not TOML: {_why(error)}"]) from None
    return parse_config(overridden(raw, overrides), folder=path.parent, source=str(path))


def machine(name: str) -> Path:
    """Return the configuration of a reference machine: tractor, tractor-2wd, tractor-axles."""
    return MACHINES / f"{name}.toml"


def found_configuration(name: str | None) -> Path:
    """Return the file that a command's --config means; ConfigError where there is none.

    The name is that of a file, or else of a reference machine; None: `soilbus.toml` in the current folder.
    """
    if name is None:
        if not Path(CONFIGURATION).exists():
            makes = f"soilbus init --dbc YOUR.dbc -o {CONFIGURATION} makes one"
            other = "--config tractor is the simulated tractor's"
            raise ConfigError([f"no --config and no {CONFIGURATION} here: {makes}; {other}"])
        return Path(CONFIGURATION)
    path = Path(name)
    if path.exists() or "/" in name or path.suffix:
        return path
    if machine(name).is_file():
        return machine(name)
    known = ", ".join(sorted(file.stem for file in MACHINES.glob("*.toml")))
    raise ConfigError([f"{name}: no such file, and no reference machine ({known})"])


def parse_config(raw: Mapping[str, Any], folder: Path = Path("."), source: str = "configuration") -> Config:
    """Check a configuration given as nested mappings; ConfigError lists every fault."""
    for key, field in Config.model_fields.items():
        if field.exclude and key in raw:
            raise ConfigError([f"{source}: {key}: unknown key"])
    if left := open_lines(raw):
        raise ConfigError(f"{source}: {line}" for line in left)
    try:
        return Config.model_validate({**raw, "folder": folder}, context={"columns": "columns" in raw})
    except ValidationError as error:
        raise ConfigError(f"{source}: {line}" for line in fault_lines(raw, error)) from None


def overridden(raw: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """Change the nested mappings in place by KEY=VALUE overrides, and return them; ConfigError for a wrong one."""
    for text in overrides:
        _override(raw, text)
    return raw


def _override(raw: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError([f"--set {text}: expected KEY=VALUE with a dotted key"])
    try:
        parsed = tomllib.loads(f"x = {value}")["x"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    except (ValueError, RecursionError) as error:
        raise ConfigError([f"--set {text[:_MAX_SHOWN_CHARACTERS]}...: {_why(error)}"]) from None
    here: Any = raw
    for i, part in enumerate(parts[:-1]):
        here = _child(here, part, ".".join(parts[: i + 1]), text)
    if isinstance(here, list):
        raise ConfigError([f"--set {text}: {'.'.join(parts[:-1])} is a list"])
    here[parts[-1]] = parsed


def _why(error: ValueError | RecursionError) -> str:
    """What the parser of TOML has against a text; an integer's digits and the depth it only minds by the way."""
    if isinstance(error, RecursionError):
        return "tables or lists nested too deeply"
    if isinstance(error, (tomllib.TOMLDecodeError, UnicodeDecodeError)):
        return str(error)
    return "a number with too many digits"


def _child(here: Any, part: str, path: str, text: str) -> Any:
    """The table (or the wheel by name or number) that one step of a dotted key leads to."""
    if isinstance(here, list):
        for i, item in enumerate(here):
            if part in (str(i), item.get("name") if isinstance(item, dict) else None):
                return item
        names = [item["name"] for item in here if isinstance(item, dict) and isinstance(item.get("name"), str)]
        raise ConfigError([f"--set {text}: no {path}; there are {', '.join(names)}"])
    if path in ("wheel", "axle", "track") and part not in here:
        raise ConfigError([f"--set {text}: the configuration has no [[{path}]]"])
    child = here.setdefault(part, {})
    if isinstance(child, str):  # "Message.Signal", or the name of a column, grows into its table form
        here[part] = {"column" if path.startswith("table.") else "signal": child}
        child = here[part]
    if not isinstance(child, (dict, list)):
        raise ConfigError([f"--set {text}: {path} is a value, not a table"])
    return child


def shipped_dbc(name: str) -> Path:
    """Return the path of a DBC file that comes with soilbus; FileNotFoundError when there is none of that name."""
    if name and Path(name).name == name:
        for folder in DBC_FOLDERS:
            if (folder / name).is_file():
                return folder / name
    raise FileNotFoundError(f"soilbus ships no {name}")


def located(folder: Path, name: str) -> Path:
    """Return the path of the DBC file that a configuration in this folder names: beside it, or ours."""
    beside = folder / name
    if beside.is_file():
        return beside
    try:
        return shipped_dbc(name)
    except FileNotFoundError:
        return beside
