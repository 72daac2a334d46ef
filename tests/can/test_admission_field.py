"""Which samples of the field recordings count, and what the others are refused for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from field_data import FIELD, field_config, field_database, frames_of, needs_field
from soilbus.can.admission import Admission
from soilbus.can.channels import Decoded, Reason
from soilbus.can.dbc_files import load_databases
from soilbus.can.mapping import channels_of


def play(log: str, a: Admission) -> Decoded:
    for frame in frames_of(FIELD / log):
        a.feed(*frame)
    return a.take()


@needs_field
def test_clay_refuses_what_the_recording_marks_and_nothing_else() -> None:
    config = field_config()
    data = load_databases(config)
    a = Admission(channels_of(config, data), data)
    out = play("clay.log.gz", a)
    lost = {(name, str(reason)): len(t) for (name, reason), t in out.refused.items()}
    assert lost == {("draft", "not_available"): 43, ("ground_speed", "not_available"): 24}
    assert (len(out.columns["draft"].t), len(out.columns["ground_speed"].t)) == (5946, 2964)
    assert a.counts.unknown == 0
    assert not a.counts.refused
    assert a.counts.received == a.counts.admitted


@needs_field
def test_hop_by_hop_gives_the_same_samples_as_at_once() -> None:
    config = field_config()
    data = load_databases(config)
    at_once = play("clay.log.gz", Admission(channels_of(config, data), data))
    a, parts, edge = Admission(channels_of(config, data), data), [], -math.inf
    for frame in frames_of(FIELD / "clay.log.gz"):
        edge = frame[0] + 1.0 if edge == -math.inf else edge
        if frame[0] >= edge + 0.1:
            parts.append(a.take(edge))
            edge += 1.0
        a.feed(*frame)
    parts.append(a.take())
    for name, column in at_once.columns.items():
        assert np.array_equal(np.concatenate([p.columns[name].t for p in parts]), column.t)
        assert np.array_equal(np.concatenate([p.columns[name].value for p in parts]), column.value)


@needs_field
def test_field_values_equal_cantools() -> None:
    config, data = field_config(), field_database()
    out = play("loam.log.gz", Admission(channels_of(config, data), data))
    torque, load = out.columns["torque.RR"], out.columns["load.RR"]
    peers = [data.decode_message(i, d) for _, i, _, d in frames_of(FIELD / "loam.log.gz") if i in (0x18FF2213, 1312)]
    assert torque.value.tolist() == [24.0 * p["ShaftTorque"] for p in peers if "ShaftTorque" in p]
    assert load.value.tolist() == [float(p["RR"]) for p in peers if "RR" in p]


@needs_field
@pytest.mark.parametrize("log", ["deere-5055e-start.log.gz", "deere-5055e-in-gear.log.gz"])
def test_standing_deere_has_no_ground_speed(log: str) -> None:
    """Priority 3 and source 0x47 where the DBC says 6 and 0x97: the group counts."""
    config = field_config()
    data = load_databases(config)
    a = Admission([c for c in channels_of(config, data) if c.quantity == "ground_speed"], data)
    out = play(log, a)
    assert len(out.columns["ground_speed"].t) == 0
    assert set(out.refused) == {("ground_speed", Reason.NOT_AVAILABLE)}
    frames = sum(i == 0x0CFE4947 for _, i, _, _ in frames_of(FIELD / log))
    assert len(out.refused["ground_speed", Reason.NOT_AVAILABLE]) == frames > 200
    assert a.counts.unknown > 10000
