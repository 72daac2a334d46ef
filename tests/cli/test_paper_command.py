"""`soilbus paper` as a reader sees it."""

import io
import re
from contextlib import redirect_stdout

import pytest

from soilbus.cli.main import main
from soilbus.trials import paper_report
from soilbus.trials.paper import SIMPSON
from soilbus.trials.paper_tables import RUNS


@pytest.fixture(scope="module")
def output() -> str:
    out = io.StringIO()
    with redirect_stdout(out):
        assert main(["paper"]) == 0
    return out.getvalue()


def section(output: str, title: str) -> list[str]:
    """Lines under a ruled title."""
    lines = output.splitlines()
    (at,) = (i for i, line in enumerate(lines[:-1]) if line.startswith(title) and set(lines[i + 1]) == {"="})
    body = lines[at + 2 :]
    end = next((i for i, line in enumerate(body) if set(line) == {"="}), len(body) + 1)
    return body[: end - 1]


@pytest.mark.parametrize("number", [3, 4, 6, 7])
def test_every_printed_figure_stands_beside_ours(output, number):
    rows = [re.split(r"  +", line.strip()) for line in section(output, f"Table {number}:")[2:] if line]
    expected = [
        [name, run.on, f"{run.start[i]:g}", f"{run.result[i]:g}", f"{run.errors[i]:g}", f"{run.seconds:g}"]
        for i, name in enumerate(("phi [deg]", "K_L", "n"))
        for run in RUNS
        if run.table == number
    ]
    assert [[*row[:5], row[9]] for row in rows] == expected
    for row in rows:
        assert float(row[7]) < 1e-7  # our error in per cent
        assert 4 <= int(row[8]) <= 8
        assert float(row[10]) < 0.1 * float(row[9])


def test_sections_and_their_numbers(output):
    assert all(len(line) <= 130 for line in output.splitlines())
    assert "Traceback" not in output
    assert "nan" not in output
    holds = re.sub(r"\s+", " ", " ".join(section(output, "What holds")))
    assert "8 of the 8" in holds
    assert "K_L = 108 instead of 645" in holds
    widths = "\n".join(section(output, "k_c and k_phi"))
    assert re.search(r"paper's Table 6 +635\.52 +596\.18 +35\.41 +19 +517\.5 +3\.6", widths)


@pytest.mark.parametrize("wrong", [["--sinkage", "1"], ["--sinkage", "deep"], ["--sinkage", "nan"]])
def test_wrong_usage_is_one_line(wrong, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["paper", *wrong])
    assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"soilbus paper: error: argument {wrong[0]}: {wrong[1]}")


def test_the_verdicts_follow_from_the_figures(output, monkeypatch):
    """Where the figures are others, so are the verdicts."""
    said = re.sub(r"\s+", " ", " ".join(section(output, "What holds")))
    for verdict in (
        "Convergence holds", "are not the method's", "The accuracy does not hold",
        "Real time holds",
    ):  # fmt: skip
        assert verdict in said
    slow = [run._replace(seconds=1e-9) for run in RUNS]
    for name, value in (
        ("RUNS", slow),
        ("MAX_SOLUTION_ERROR", 0.0), ("EXACT", SIMPSON),
    ):  # fmt: skip
        monkeypatch.setattr(paper_report, name, value)
    said = " ".join(paper_report.what_holds(0.05))
    for verdict in (
        "Convergence does not hold", "The accuracy holds",
        "Real time does not hold",
    ):  # fmt: skip
        assert verdict in said
