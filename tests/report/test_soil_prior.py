"""`soilbus check` tells which known soils the prior leaves out."""

import re

import pytest
from scipy.stats import lognorm

from soilbus.cli.main import main
from soilbus.report.configuration import prior_text
from soilbus.simulator.reference import TRACTOR, reference_configuration
from soilbus.terra.soils import KINDS, SOILS


def row(text: str, name: str) -> list[str]:
    (line,) = (line for line in text.splitlines() if re.match(rf" *{name}\b", line))
    return re.split(r" {2,}", line.strip())


def test_stiff_clays_are_named_as_outside_of_the_default(capsys):
    assert main(["check", "--config", str(TRACTOR)]) == 0
    _, assumed = capsys.readouterr().out.split("assumed of the soil")
    cells = row(assumed.split("Settings")[0], "c")
    assert "heavy_clay_25 (69)" in cells[-1]
    assert "lean_clay_22 (69)" in cells[-1]


def test_intervals_are_those_of_the_log_normal_and_the_count_is_right():
    text = prior_text(reference_configuration(["soil.c.value=5000", "soil.c.std=10000"]))
    spread = lognorm(s=(2.0 * 0.80471896) ** 0.5, scale=5.0)  # log(1 + 2^2) = 1.609
    name, median, low, high, unit, outside = row(text, "c")
    assert (name, float(median), unit) == ("c", 5.0, "kPa")
    assert [float(low), float(high)] == pytest.approx(spread.ppf([0.025, 0.975]), rel=5e-3)
    beyond = {kind for kind in KINDS if not 0.025 < spread.cdf(SOILS[kind].c / 1e3) < 0.975}
    assert set(re.findall(r"\w+(?= \()", outside)) == beyond


def test_a_held_parameter_is_called_held():
    assert row(prior_text(reference_configuration(["soil.K.std=0"])), "K") == ["K", "20", "held", "mm"]
