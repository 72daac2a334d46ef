"""A completed model keeps up with the bus: told in plain windows, which take less than 10 ms (`soilbus bench`)."""

from __future__ import annotations

import pytest
from completed_windows import EFFECTS, recorded, times

MOST = 4.0
"""Times a plain window's time: 40 ms where that takes 10."""


@pytest.fixture(scope="module")
def spent(tmp_path_factory):
    return dict(times(recorded(tmp_path_factory.mktemp("drive"))))


@pytest.mark.parametrize("name", EFFECTS)
def test_a_window_with_an_effect_takes_a_few_plain_ones(spent, name):
    assert spent[name].ratio < MOST
