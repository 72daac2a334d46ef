"""What tests.lab.full_bus makes of what it hears, and the load that it offers; on a real bus: tests/bus."""

from __future__ import annotations

import numpy as np
import pytest

from tests.lab.full_bus import Traffic, latencies


def test_latency_is_from_the_last_mapped_frame_of_the_window():
    mapped = 5.0 + np.arange(0.0, 14.0, 0.3)
    end = 5.0 + 10.0 + np.arange(4.0)
    last = [mapped[mapped < e - 0.001][-1] for e in end]  # a frame at the very end is of the next window
    told = np.array([0.01, 0.2, 0.03, 0.04])
    results = np.column_stack([last + told, np.arange(4.0)])
    assert latencies(mapped, results, 10.0, 1.0) == pytest.approx(told)
    assert latencies(mapped, results[[0, 2, 3]], 10.0, 1.0) == pytest.approx([0.01, np.inf, 0.03, 0.04])
    assert latencies(mapped, np.empty((0, 2)), 10.0, 1.0).size == 0


def test_window_numbers_go_round():
    mapped = np.arange(0.0, 270.0, 0.01)
    end = 10.0 + np.arange(255.0)
    results = np.column_stack([end + 0.5, np.arange(255) % 251])
    late = latencies(mapped, results, 10.0, 1.0)
    assert len(late) == 255
    assert late == pytest.approx(0.5, abs=0.011)


def test_a_tenth_of_a_full_bus_is_ours():
    played = Traffic("nowhere", 4.0).played
    bits = 0.1 * 1e6 / (len(played) / 4.0)  # of a frame, if these are a tenth of 1 Mbit/s
    assert [t for t, _ in played] == sorted(t for t, _ in played)
    assert 131.0 < bits < 131.0 * 1.2  # an extended frame of 8 bytes, its least with some stuff bits
