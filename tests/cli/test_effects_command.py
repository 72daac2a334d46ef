"""`soilbus effects`: all that the catalogue knows, as text and as JSON."""

import json

import pytest

from soilbus.cli.main import main
from soilbus.terra.effects.catalogue import CATALOGUE


def test_the_overview_has_a_row_for_each_effect(capsys):
    assert main(["effects"]) == 0
    rows = capsys.readouterr().out.splitlines()[2:-2]
    assert [row.split()[0] for row in rows] == list(CATALOGUE)
    assert all(len(row) <= 130 for row in rows)


@pytest.mark.parametrize("name", ["hardpan", "draft_offset", "soil_drift"])
def test_one_effect_is_shown_in_full(name, capsys):
    assert main(["effects", name]) == 0
    text = capsys.readouterr().out
    effect = CATALOGUE[name]
    flat = "".join(text.split())
    assert all("".join(part.split()) in flat for part in (effect.physics, effect.tells, effect.source))
    for parameter in effect.parameters:
        assert f"{parameter.low:g} to {parameter.high:g}" in text
        assert parameter.name in text


def test_json_holds_the_whole_catalogue(capsys):
    assert main(["effects", "--json", "-"]) == 0
    effects = json.loads(capsys.readouterr().out)
    assert [effect["name"] for effect in effects] == list(CATALOGUE)
    for effect in effects:
        assert effect["physics"]
        assert effect["shown_by"]
        assert effect["source"]
        assert all(p["range"][0] <= p["absent_at"] <= p["range"][1] for p in effect["parameters"])


def test_an_unknown_effect_is_one_line_with_the_nearest_name(capsys):
    assert main(["effects", "slipsinkage"]) == 2
    assert capsys.readouterr().err == "soilbus: no effect slipsinkage; did you mean slip_sinkage?\n"
