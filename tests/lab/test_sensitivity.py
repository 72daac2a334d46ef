"""The page on tuning values has a row for each, and each says what it is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from soilbus.decision.options import WatchOptions
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.estimation.options import EstimatorOptions
from soilbus.sensors.options import ConsistencyOptions, ReceptionOptions
from tests.lab.sensitivity import Field, fields_of, with_field

PAGE = Path(__file__).resolve().parents[2] / "service" / "docs" / "sensitivity.md"
OPTIONS = (EstimatorOptions(), DiagnosisOptions(), WatchOptions(), ReceptionOptions(), ConsistencyOptions())
FIELDS = [(options, field) for options in OPTIONS for field in fields_of(options)]


def test_the_page_has_every_value_and_no_other():
    rows = re.findall(r"^\| `(.+?)` \| (\S+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == [(".".join(field.path), f"{field.value:g}") for _, field in FIELDS]


def test_one_value_alone_is_changed():
    for options, field in FIELDS:
        changed = with_field(options, field.path, 7.0 * field.value)
        others = {f.path: f.value for f in fields_of(options) if f.path != field.path}
        assert {f.path: f.value for f in fields_of(changed)} == others | {field.path: 7.0 * field.value}


@pytest.mark.parametrize(("value", "factor", "expected"), [(0.5, 0.7, 0.35), (2, 0.7, 1), (2, 1.3, 3), (24, 1.3, 31)])
def test_a_count_changes_by_one_at_least(value, factor, expected):
    assert Field(("x",), value, "").varied(factor) == pytest.approx(expected)
