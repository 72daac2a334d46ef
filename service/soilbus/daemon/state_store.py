"""The state file: one JSON file that is whole or absent, and that is used only after checks.

    |value - prior median| <= 8 prior sd    and    posterior sd <= 8 prior sd        for each parameter

The file is written beside the old one, flushed to the disk, then renamed, so a power cut leaves the old file or the
new one. A file that is read counts only if it has this format and version, belongs to this configuration, has the
checksum that it states, and holds a Gaussian within the bounds above.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cantools.database.can import Database
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, NonNegativeInt, PositiveInt, ValidationError

from soilbus.arrays import Array
from soilbus.can.channels import Channel
from soilbus.config.model import Config
from soilbus.estimation.assembly import effects_and_parameters_of, model_of, prior_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.parametrization import MAX_PHI
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.tracker import gain_errors, new_soil_prior
from soilbus.words import one_line

FORMAT, VERSION = "soilbus state", 2
MAX_FILE_BYTES = 1 << 20
"""Size [bytes] beyond which a file is not a state of ours."""
STORED_RANGE_SD = 8.0
"""Greatest distance of a stored mean from the prior's median, and greatest stored sd, in prior standard deviations."""
SECTIONS = {"vehicle", "axle", "wheel", "track", "signals", "noise", "soil", "estimator", "model"}
"""Sections of the configuration that a posterior depends on."""
_PHI = PARAMETERS.index("phi")


class StateError(Exception):
    """Error of a stored state that cannot be used; one line says why."""


class OtherOwner(StateError):
    """Error of a sound state of another vehicle or configuration."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class StoredGaussian(_Model):
    """A Gaussian and its time [s, Unix]: soil in SI, relative gains, covariance of log soil and gains."""

    at: NonNegativeFloat
    soil: dict[str, NonNegativeFloat]
    gains: dict[str, float]
    covariance: list[list[float]]


class State(_Model):
    """State to be stored: time [s, Unix], number of starts, the Gaussian, counters since the first start."""

    at: NonNegativeFloat
    starts: PositiveInt
    gaussian: StoredGaussian | None
    totals: dict[Annotated[str, Field(max_length=80)], NonNegativeInt] = Field(max_length=1000)


class _File(_Model):
    """The envelope; `checksum` is the SHA-256 of the state's canonical JSON."""

    format: str
    version: int
    key: str
    checksum: str
    state: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Owner:
    """Owner of a state: a digest of all that a posterior depends on, and the bounds of such a posterior.

    Median and std are of the soil parameters (6,) and the gain errors (G,), whose names are `gains`; sd 0 means held.
    """

    key: str
    gains: tuple[str, ...]
    median: Array
    std: Array

    @classmethod
    def of(cls, config: Config, channels: Iterable[Channel], database: Database) -> Owner:
        """Return the owner for a configuration and the signals that its channels come from."""
        prior = prior_of(config)
        names, gain_std = gain_errors(rig_of(config), model_of(config), effects_and_parameters_of(config)[1])
        return cls(
            digest([config.model_dump(mode="json", include=SECTIONS), [_wiring(c, database) for c in channels]]),
            tuple(names),
            np.concatenate([prior.median, np.zeros(len(names))]),
            np.concatenate([new_soil_prior(prior).log_std, gain_std]),
        )


def stored_gaussian(gaussian: Gaussian, at: float, owner: Owner) -> StoredGaussian:
    """Return a Gaussian in the form in which it is stored; StateError where it could not be read back."""
    _check(gaussian, owner)
    return StoredGaussian(
        at=at,
        soil=dict(zip(PARAMETERS, gaussian.soil.tolist(), strict=True)),
        gains=dict(zip(owner.gains, gaussian.gains.tolist(), strict=True)),
        covariance=gaussian.covariance.tolist(),
    )


def gaussian_of(stored: StoredGaussian, owner: Owner) -> Gaussian:
    """Return the Gaussian that was stored; StateError where this vehicle's estimator cannot have had it."""
    if tuple(stored.soil) != PARAMETERS or tuple(stored.gains) != owner.gains:
        raise StateError("the Gaussian is of other parameters")
    rows = stored.covariance
    if len(rows) != len(owner.std) or any(len(row) != len(owner.std) for row in rows):
        raise StateError("the Gaussian's covariance has another shape")
    gaussian = Gaussian(np.array(list(stored.soil.values())), np.array(list(stored.gains.values())), np.array(rows))
    _check(gaussian, owner)
    return gaussian


def _check(gaussian: Gaussian, owner: Owner) -> None:
    """Raises StateError unless the Gaussian is finite, physical, and has a proper covariance."""
    if not all(np.isfinite(part).all() for part in (gaussian.soil, gaussian.gains, gaussian.covariance)):
        raise StateError("the Gaussian is not finite")
    n_soil = len(PARAMETERS)
    free, median = owner.std[:n_soil] > 0.0, owner.median[:n_soil]
    physical = (gaussian.soil[free] > 0.0).all() and gaussian.soil[_PHI] <= max(MAX_PHI, median[_PHI])
    if physical:
        off = np.concatenate([np.log(gaussian.soil[free]) - np.log(median[free]), gaussian.gains])
        std = np.concatenate([owner.std[:n_soil][free], owner.std[n_soil:]])
        physical = (np.abs(off) <= STORED_RANGE_SD * std).all() and np.allclose(gaussian.soil[~free], median[~free])
    if not physical:
        raise StateError("the Gaussian is out of physical bounds")
    _check_covariance(gaussian.covariance, owner.std)


def _check_covariance(covariance: Array, std: Array) -> None:
    """Raises StateError unless it (N, N) is symmetric and positive definite, and zero for what is held (std (N,) 0)."""
    held, variance = std == 0.0, np.diag(covariance)
    if covariance[held].any() or covariance[:, held].any() or not (variance[~held] > 0.0).all():
        raise StateError("the Gaussian's covariance is not positive definite")
    if (variance > (STORED_RANGE_SD * std) ** 2).any():
        raise StateError("the Gaussian's covariance is out of bounds")
    scale = np.sqrt(variance[~held])
    with np.errstate(over="ignore"):
        correlation = covariance[np.ix_(~held, ~held)] / np.outer(scale, scale)
    if not np.allclose(correlation, correlation.T, rtol=0.0, atol=1e-9):
        raise StateError("the Gaussian's covariance is not symmetric")
    try:
        if not (np.abs(correlation) < 1.0 + 1e-9).all():
            raise np.linalg.LinAlgError
        np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        raise StateError("the Gaussian's covariance is not positive definite") from None


def dumped(state: State, owner: Owner) -> bytes:
    """Return the content of a state's file."""
    content = state.model_dump()
    envelope = {"format": FORMAT, "version": VERSION, "key": owner.key, "checksum": digest(content), "state": content}
    return (json.dumps(envelope, allow_nan=False) + "\n").encode()


def loaded(content: bytes, owner: Owner) -> State:
    """Return the state of this vehicle in a file's content; StateError says in one line why it cannot be used."""
    try:
        raw = json.loads(content)
    except (ValueError, RecursionError):
        raise StateError("it is damaged: not JSON") from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise StateError("it is not a state of soilbus")
    if raw.get("version") != VERSION:
        raise StateError(f"it is of version {str(raw.get('version'))[:20]}, this is {VERSION}")
    try:
        file = _File.model_validate(raw)
        if file.checksum != digest(file.state):
            raise StateError("it is damaged: wrong checksum")
        if file.key != owner.key:
            raise OtherOwner("it belongs to another configuration")
        state = State.model_validate(file.state)
    except (ValidationError, ValueError, RecursionError, OverflowError) as error:
        raise StateError(f"it is damaged: {_damage(error)}") from None
    if state.gaussian is not None:
        gaussian_of(state.gaussian, owner)
    return state


def read(path: Path, owner: Owner) -> State | None:
    """Return the state in a file; None where there is no file, StateError where it cannot be used."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW)
        with open(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise StateError("it is no file")
            content = file.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StateError(error.strerror or str(error)) from None
    if len(content) > MAX_FILE_BYTES:
        raise StateError("it is too large to be a state of soilbus")
    return loaded(content, owner)


def write_whole(path: Path, content: bytes) -> None:
    """Replace the file on the disk; OSError where that fails, and the old one stays."""
    beside = path.with_name(path.name + ".new")
    try:
        with open(beside, "wb", opener=_private) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError:
        with suppress(OSError):
            beside.unlink()
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600)  # a pipe in its place halts nobody


def digest(content: Any) -> str:
    """Return the SHA-256 of the canonical JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _wiring(channel: Channel, database: Database) -> list[Any]:
    """Where a channel's values come from, down to the bit."""
    message = database.get_message_by_name(channel.message)
    signals = [message.get_signal_by_name(s) for s in (channel.signal, channel.valid_signal) if s is not None]
    return [
        channel.name, channel.factor, channel.offset, channel.low, channel.high, list(channel.valid_values),
        message.frame_id, message.is_extended_frame, message.length,
        *([s.start, s.length, s.byte_order, s.is_signed, s.is_float, float(s.scale), float(s.offset)] for s in signals),
        *([s.multiplexer_signal, s.multiplexer_ids] for s in signals if s.multiplexer_signal is not None),
    ]  # fmt: skip


def _damage(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"[:200]
    return one_line(error, 200)
