"""The stored state: bit for bit what was known, or one line on why not."""

import copy
import functools
import itertools
import json
import math
import operator
import os
import re
import signal
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from soilbus.can.dbc_files import load_databases
from soilbus.can.mapping import channels_of
from soilbus.daemon import state_store as store
from soilbus.daemon.state_store import (
    Owner,
    State,
    StateError,
    dumped,
    gaussian_of,
    loaded,
    read,
    stored_gaussian,
    write_whole,
)
from soilbus.estimation.gaussian import Gaussian
from soilbus.simulator.reference import REAR_DRIVE, TRACTOR, reference_configuration


def owner_of(settings: list[str] | None = None, database=None, path=TRACTOR) -> Owner:
    config = reference_configuration(settings or [], path)
    database = database or load_databases(config)
    return Owner.of(config, channels_of(config, database), database)


OWNER = owner_of()
N = len(OWNER.std)


def belief_with(seed: int) -> Gaussian:
    """One that an estimator might have had."""
    rng = np.random.default_rng(seed)
    root = 0.1 * rng.standard_normal((N, N + 2)) * OWNER.std[:, None]
    off = 0.5 * OWNER.std * rng.standard_normal(N)
    return Gaussian(OWNER.median[:6] * np.exp(off[:6]), off[6:], root @ root.T)


def state_with(gaussian: Gaussian | None, **changed) -> State:
    stored = None if gaussian is None else stored_gaussian(gaussian, 1.7e9, OWNER)
    return State(
        **{"at": 1.7e9, "starts": 3, "gaussian": stored, "totals": {"windows": 5, "failed.internal": 2}} | changed
    )


CONTENT = dumped(state_with(belief_with(1)), OWNER)


def sealed(change) -> bytes:
    """The file with its content changed by somebody who knows how to seal it."""
    raw = json.loads(CONTENT)
    change(raw["state"])
    raw["checksum"] = store.digest(raw["state"])
    return json.dumps(raw).encode()


@settings(max_examples=30)
@given(st.integers(0, 2**31))
def test_what_comes_back_is_bit_for_bit_what_was_stored(seed):
    gaussian = belief_with(seed)
    state = loaded(dumped(state_with(gaussian), OWNER), OWNER)
    assert state == state_with(gaussian)
    back = gaussian_of(state.gaussian, OWNER)
    for part in ("soil", "gains", "covariance"):
        assert np.array_equal(getattr(back, part), getattr(gaussian, part))


@given(st.integers(0, len(CONTENT) - 1), st.integers(0, 255), st.booleans())
def test_one_wrong_byte_or_a_cut_is_noticed(place, byte, cut):
    spoilt = CONTENT[:place] if cut else CONTENT[:place] + bytes([byte]) + CONTENT[place + 1 :]
    try:
        found = loaded(spoilt, OWNER)
    except StateError:
        return
    assert found == loaded(CONTENT, OWNER)  # a space, or the same byte


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda x: st.lists(x) | st.dictionaries(st.text(max_size=5), x),
    max_leaves=8,
)


@given(st.binary(max_size=200) | JSON.map(lambda x: json.dumps(x).encode()))
def test_no_bytes_are_a_traceback(content):
    with pytest.raises(StateError):
        loaded(content, OWNER)


def places(value, path=()):
    """The way to everything in a JSON value."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, member in items:
        yield from places(member, (*path, key))


PLACES = list(places(json.loads(CONTENT)["state"]))[1:]
STRANGE = [None, True, 0, -1, 1e308, -1e308, 5e-324, -0.0, math.nan, math.inf, 2**63, 10**400, "", "1", [], {}, [[]]]


@pytest.mark.filterwarnings("error")
@given(st.lists(st.tuples(st.sampled_from(PLACES), st.sampled_from(STRANGE) | JSON), min_size=1, max_size=3))
def test_nothing_that_is_sealed_well_is_a_traceback(edits):
    def edit(state):
        for (*way, last), value in edits:
            with suppress(KeyError, IndexError, TypeError):  # another edit has taken it away
                functools.reduce(operator.getitem, way, state)[last] = value

    try:
        state = loaded(sealed(edit), OWNER)
    except StateError:
        return
    assert loaded(dumped(state, OWNER), OWNER) == state


def _scaled(state, row, factor):
    for i in range(N):
        state["gaussian"]["covariance"][row][i] *= factor


def _covariance(state, i, j, value):
    state["gaussian"]["covariance"][i][j] = value


def _indefinite(state):
    c = state["gaussian"]["covariance"]
    c[7][8] = c[8][7] = 1.1 * (c[7][7] * c[8][8]) ** 0.5


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b'{"at": ' + b"9" * 5000 + b"}", "not JSON"),
        (b'"soilbus state"', "not a state of soilbus"),
        (b'{"format": "openpilot", "version": 2}', "not a state of soilbus"),
        (CONTENT.replace(b'"version": 2', b'"version": 1'), "version 1, this is 2"),
        (CONTENT.replace(b'"starts": 3', b'"starts": 4'), "wrong checksum"),
        (CONTENT.replace(OWNER.key.encode(), b"0" * 64), "another configuration"),
        (sealed(lambda s: s.update(more=1)), "more"),
        (sealed(lambda s: s.pop("totals")), "totals"),
        (sealed(lambda s: s.update(starts=0)), "starts"),
        (sealed(lambda s: s.update(at=float("nan"))), "at"),
        (sealed(lambda s: s["totals"].update(windows=-1)), "windows"),
        (sealed(lambda s: s["gaussian"]["soil"].pop("phi")), "other parameters"),
        (sealed(lambda s: s["gaussian"]["gains"].update({"torque.XX": 0.0})), "other parameters"),
        (sealed(lambda s: s["gaussian"]["covariance"][3].pop()), "another shape"),
        (sealed(lambda s: s["gaussian"]["soil"].update(phi=1.5)), "physical bounds"),
        (sealed(lambda s: s["gaussian"]["soil"].update(k_phi=1e30)), "physical bounds"),
        (sealed(lambda s: s["gaussian"]["gains"].update({"torque.FL": 0.5})), "physical bounds"),
        (sealed(lambda s: s["gaussian"]["gains"].update({"torque.FL": -0.5})), "physical bounds"),
        (sealed(lambda s: s["gaussian"]["gains"].update({"torque.FL": float("inf")})), "torque.FL"),
        (sealed(lambda s: _covariance(s, 2, 2, 0.0)), "positive definite"),
        (sealed(lambda s: _covariance(s, 2, 2, 1e300)), "out of bounds"),
        (sealed(lambda s: _scaled(s, 9, 1.5)), "not symmetric"),
        (sealed(_indefinite), "positive definite"),
    ],
)  # fmt: skip
def test_each_fault_is_told_in_one_line(content, why):
    with pytest.raises(StateError, match=re.escape(why)) as caught:
        loaded(content, OWNER)
    assert "\n" not in str(caught.value)


def test_what_is_held_and_what_effects_have_is_stored_too():
    effect = 'model.effects=[{name="slip_sinkage", softening={value=0.3, std=0.1}}]'
    owner = owner_of([effect, "soil.k_c.value=0.0", "soil.k_c.std=0.0"])
    held = owner.std == 0.0
    assert np.flatnonzero(held)[0] == 0
    assert len(owner.gains) > len(OWNER.gains)
    std = np.where(held, 0.0, 0.1 * owner.std)
    gains = np.where(np.arange(len(owner.gains)) >= len(OWNER.gains), -3.0, 0.0) * owner.std[6:]  # pulls of parameters
    gaussian = Gaussian(owner.median[:6], gains, np.diag(std**2))
    state = State(at=0.0, starts=1, gaussian=stored_gaussian(gaussian, 0.0, owner), totals={})
    assert np.array_equal(gaussian_of(loaded(dumped(state, owner), owner).gaussian, owner).gains, gains)
    other = Gaussian(gaussian.soil + np.eye(6)[0], gaussian.gains, gaussian.covariance)
    with pytest.raises(StateError, match="physical"):
        stored_gaussian(other, 0.0, owner)


@pytest.mark.parametrize(
    ("setting", "path"),
    [
        ("wheel.FL.radius=0.51", TRACTOR), ("vehicle.mass=2301.0", TRACTOR), ("noise.draft.gain=0.006", TRACTOR),
        ("soil.c.value=2100.0", TRACTOR), ("estimator.window=9.0", TRACTOR), ("model.shear_law=rational", TRACTOR),
        ("wheel.FL.gear_ratio=25.0", TRACTOR), ("axle.rear.differential=limited", REAR_DRIVE),
        ("axle.rear.torque_bias=0.2", REAR_DRIVE),
    ],
)  # fmt: skip
def test_what_a_belief_depends_on_is_in_the_key(setting, path):
    assert owner_of([setting], path=path).key != owner_of(path=path).key


def test_the_wiring_is_in_the_key_down_to_the_bit_and_the_page():
    config = reference_configuration()
    database = copy.deepcopy(load_databases(config))
    channel = channels_of(config, database)[0]
    signal = database.get_message_by_name(channel.message).get_signal_by_name(channel.signal)
    keys = {OWNER.key, owner_of(database=database).key}
    assert len(keys) == 1
    signal.conversion.offset += 1.0
    keys.add(owner_of(database=database).key)
    signal.multiplexer_signal = "State"
    for signal.multiplexer_ids in ([1], [2]):
        keys.add(owner_of(database=database).key)
    assert len(keys) == 4


@pytest.mark.parametrize("setting", ["bus.channel=can7", "traversability.margin=0.2", "output.dbc=soilbus.dbc"])
def test_what_a_belief_does_not_depend_on_is_not(setting):
    assert owner_of([setting]).key == OWNER.key


def test_what_is_no_file_is_refused_and_nothing_is_nothing(tmp_path: Path):
    path = tmp_path / "state.json"
    assert read(path, OWNER) is None
    path.write_bytes(CONTENT)
    assert read(path, OWNER) == loaded(CONTENT, OWNER)
    (tmp_path / "link").symlink_to(path)
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "large").write_bytes(CONTENT + b" " * store.MAX_FILE_BYTES)
    for name in ("link", "fifo", "large", ".", "state.json/x"):
        with pytest.raises(StateError):
            read(tmp_path / name, OWNER)


def test_only_the_owner_may_read_it(tmp_path: Path):
    write_whole(tmp_path / "state.json", CONTENT)
    assert (tmp_path / "state.json").stat().st_mode & 0o777 == 0o600


def test_nothing_is_written_through_a_link(tmp_path: Path):
    """Somebody who may write in the folder leaves a link to a file of ours under the new file's name."""
    path, other = tmp_path / "state.json", tmp_path / "other"
    write_whole(path, CONTENT)
    other.write_bytes(b"not to be touched")
    (tmp_path / "state.json.new").symlink_to(other)
    with pytest.raises(OSError, match="symbolic link"):
        write_whole(path, b"new")
    assert other.read_bytes() == b"not to be touched"
    assert path.read_bytes() == CONTENT
    write_whole(path, b"new")  # the link is gone
    assert path.read_bytes() == b"new"
    assert not path.is_symlink()


def test_it_is_on_the_disk_before_it_has_the_name_and_the_name_is_too(tmp_path: Path, monkeypatch):
    calls = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: calls.append(os.readlink(f"/proc/self/fd/{fd}")) or fsync(fd))
    monkeypatch.setattr(os, "replace", lambda a, b: calls.append("renamed") or replace(a, b))
    write_whole(tmp_path / "state.json", CONTENT)
    assert calls == [str(tmp_path / "state.json.new"), "renamed", str(tmp_path)]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file_and_no_other(step, tmp_path: Path, monkeypatch):
    path = tmp_path / "state.json"
    write_whole(path, CONTENT)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, b"new")
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["state.json"]
    assert read(path, OWNER) == loaded(CONTENT, OWNER)


def killed_while_writing(path: Path, content: bytes, step: str, call: int, done: bool) -> None:
    """A process is killed as it writes the file: at that call of a function of os, before or after it does its work."""
    child = os.fork()
    if child == 0:
        real, calls = getattr(os, step), itertools.count(1)

        def deadly(*args):
            last = next(calls) == call
            if last and not done:
                os.kill(os.getpid(), signal.SIGKILL)
            real(*args)
            if last:
                os.kill(os.getpid(), signal.SIGKILL)

        setattr(os, step, deadly)
        try:
            write_whole(path, content)
        finally:
            os._exit(1)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL


@pytest.mark.parametrize(
    ("step", "call", "done", "new"),
    [
        ("fsync", 1, False, False),
        ("fsync", 1, True, False),
        ("replace", 1, False, False),
        ("replace", 1, True, True),
        ("fsync", 2, False, True),
        ("fsync", 2, True, True),
    ],
)
def test_a_kill_at_any_step_leaves_the_old_file_or_the_new(step, call, done, new, tmp_path: Path):
    path = tmp_path / "state.json"
    before, after = dumped(state_with(None, starts=1), OWNER), dumped(state_with(belief_with(2), starts=2), OWNER)
    write_whole(path, before)
    killed_while_writing(path, after, step, call, done)
    beside = path.with_name("state.json.new")
    assert path.read_bytes() == (after if new else before)
    assert beside.exists() is not new
    beside.write_bytes(after[: len(after) // 2])  # as a power cut leaves what was never synced
    assert read(path, OWNER) == loaded(after if new else before, OWNER)
    write_whole(path, CONTENT)
    assert [p.name for p in tmp_path.iterdir()] == ["state.json"]
    assert path.read_bytes() == CONTENT


def test_a_pipe_in_the_place_of_the_new_file_halts_nobody(tmp_path: Path):
    path = tmp_path / "state.json"
    os.mkfifo(tmp_path / "state.json.new")
    with pytest.raises(OSError, match="No such device"):
        write_whole(path, CONTENT)
    write_whole(path, CONTENT)
    assert path.read_bytes() == CONTENT
