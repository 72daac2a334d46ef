"""`soilbus paper` as a reader sees it."""

from __future__ import annotations

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
    assert "at least 559 %" in holds
    other = "\n".join(section(output, "Other data"))
    assert re.search(r"A4 as printed, in the solver only +none +none +none", other)
    assert re.search(r"exact integrals, rational shear +13\.980, 108\.40, 0\.3645", other)
    noise = "\n".join(section(output, "Noise"))
    assert re.search(r"wet clay +0\.1 % +559 ", noise)
    assert len(re.findall(r"^(?:wet clay|sandy loam) ", noise, re.MULTILINE)) == 4
    widths = "\n".join(section(output, "k_c and k_phi"))
    assert re.search(r"paper's Table 6 +635\.52 +596\.18 +35\.41 +19 +517\.5 +3\.6", widths)


def test_every_correction_shows_its_effect(output):
    text = "\n".join(section(output, "Corrected in the paper"))
    flat = re.sub(r"\s+", " ", text)
    for number in (
        "DP = -22.3 N instead of +79.6 N (integrals: +77.4 N)",  # eq. 27
        "T = 340 N m instead of",  # eq. 14
        "0.67 against 0.87 of the strength",  # fig. 2
        "T = 219 N m against W = 1633 N, DP = +192 N, T = 278 N m",
        "j/(j+K) <= 0.67",  # section 2.4
        "635.522 against 644.9 is 1.45 %",
        "k_c = 35.41 instead of 43.68",
        "phi = 14.000, K_L = 596.37, n = 0.8500",  # table 7
    ):
        assert number in flat
    assert text.count("effect:") == text.count("printed:") == text.count("must be:") == 12


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
        "Convergence holds", "are not the method's", "The accuracy does not hold", "(conclusion 3) does not hold",
        "Real time holds",
    ):  # fmt: skip
        assert verdict in said
    slow = [run._replace(seconds=1e-9) for run in RUNS]
    for name, value in (
        ("K_L_bound", lambda *_: 1e-4), ("RUNS", slow),
        ("MAX_SOLUTION_ERROR", 0.0), ("EXACT", SIMPSON),
    ):  # fmt: skip
        monkeypatch.setattr(paper_report, name, value)
    said = " ".join(paper_report.what_holds(0.05))
    for verdict in (
        "Convergence does not hold", "The accuracy holds", "(conclusion 3) holds",
        "Real time does not hold",
    ):  # fmt: skip
        assert verdict in said
