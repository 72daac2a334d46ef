"""The page's table of JSON keys is the table of the keys that a line has."""

import json
import re
from pathlib import Path

from soilbus.decision.traversability import Status, Traversability
from soilbus.pipeline.outputs import json_line
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.reference import reference_configuration

DOCS = Path(__file__).resolve().parents[2] / "service" / "docs"
NOTHING = WindowResult(1.0, 0, Status.INVALID, "no_convergence", None, None, {}, {}, Traversability(), None, 0, {})


def test_the_readme_names_every_key_of_a_line():
    table = re.search(
        r"^\| key \| meaning \|\n.*\n((?:\|.*\n)+)", (DOCS / "json.md").read_text(encoding="utf-8"), re.M
    )[1]
    named = [key for row in table.splitlines() for key in re.findall(r"`(\w+)`", row.split("|")[1])]
    assert sorted(named) == sorted(json.loads(json_line(NOTHING, reference_configuration())))


def test_the_readme_gives_the_drift_of_the_soil_that_is_in_force():
    (said,) = re.findall(
        r"`estimator\.soil_drift`, ([\d.]+) in the time of one window", (DOCS / "method.md").read_text(encoding="utf-8")
    )
    assert float(said) == reference_configuration().estimator.soil_drift
