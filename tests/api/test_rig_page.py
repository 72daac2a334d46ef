"""The page of test-rig tables: its files, commands and Python run as written and print what it says."""

import doctest
import re
import shlex
import shutil
from pathlib import Path

import pytest

from soilbus.cli.main import main
from soilbus.config.model import Table
from soilbus.terra.soils import SOILS

DOCS = Path(__file__).resolve().parents[2] / "service/docs"
PAGE = (DOCS / "test-rig.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", PAGE, re.DOTALL)


def test_the_page_shows_the_files_as_they_are():
    texts = dict(BLOCKS)
    assert texts["toml"] == (DOCS / "notebooks/rig.toml").read_text(encoding="utf-8")
    assert (DOCS / "notebooks/rig.csv").read_text(encoding="utf-8").startswith(texts["csv"])


def test_every_key_of_table_has_its_row():
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == [
        "wheel_load", "slip", "drawbar_pull", "torque", "sinkage", "t", "run", "where",
    ]  # fmt: skip
    assert set(re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE)) == set(Table.model_fields)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig")
    for name in ("rig.toml", "rig.csv"):
        shutil.copy(DOCS / "notebooks" / name, path)
    return path


def test_commands_and_python_print_what_the_page_says(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    shells = [(text, BLOCKS[i + 1]) for i, (kind, text) in enumerate(BLOCKS) if kind == "sh"]
    assert len(shells) == 3
    for command, (kind, expected) in shells:
        assert kind == "text"
        program, *arguments = shlex.split(command)
        assert program == "soilbus"
        assert main(arguments) == 0
        printed = capsys.readouterr().out
        wanted = expected.replace("\n\n", "\n<BLANKLINE>\n")
        assert doctest.OutputChecker().check_output(wanted, printed, doctest.ELLIPSIS), printed
    exec(dict(BLOCKS)["python"], {})
    printed = capsys.readouterr().out
    assert "status             = valid" in printed
    low, high = (SOILS["dry_sand"].bearing_pressure(0.02, 0.3) / 1e3 * factor for factor in (0.9, 1.1))
    assert low < float(re.search(r"([\d.]+) \+/- [\d.]+ \([\d.]+ %\) kPa\n", printed)[1]) < high
    assert printed.count("rig.csv, ") == 2
