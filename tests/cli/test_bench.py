"""`soilbus bench`: every figure beside its target, the same problem for ours and the peer, faults in one line."""

import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import soilbus.trials.bench as bench
from soilbus.cli.main import main
from soilbus.estimation.posterior import PARAMETERS
from soilbus.trials.bench import growth, on_log, paper, window
from soilbus.trials.bench.figure import Figure, in_turn

TARGETS = {
    "decode_speedup": ">= 20",
    "replay_realtime_factor": ">= 150",
    "replay_one_core_factor": ">= 100",
    "paper_solve_speedup": ">= 300",
    "window_solve_speedup": ">= 5",
    "window_ms": "<= 10",
    "service_window_ms": "<= 10",
    "wheels_exponent": "<= 1.1",
    "samples_exponent": "<= 1.1",
}


@pytest.fixture
def small(monkeypatch):
    """The bench of a short recording, each time taken once."""
    monkeypatch.setattr(bench, "RECORDING_TIME", 13.0)
    monkeypatch.setattr(paper, "SOLVES", 20)
    for module in (paper, on_log, window, growth):
        monkeypatch.setattr(module, "ROUNDS", 1)
    monkeypatch.setattr(window, "SOILS", ("loam",))
    monkeypatch.setattr(window, "EXACT_AND_ROUGH", window.EXACT_AND_ROUGH[:1])
    monkeypatch.setattr(growth, "WINDOW_LENGTHS", (4.0, 8.0))


def test_every_figure_is_in_the_json_and_beside_its_target_in_the_table(small, tmp_path, capsys):
    out = tmp_path / "bench.json"
    assert main(["bench", "--json", str(out)]) == 0
    results = json.loads(out.read_text())
    assert set(results) == set(TARGETS) | {"details", "machine"}
    lines = capsys.readouterr().out.splitlines()
    for name, aim in TARGETS.items():
        detail = results["details"][name]
        assert results[name] == detail["value"]
        assert np.isfinite(detail["value"])
        limit = float(aim.split()[1])
        assert detail["met"] == (detail["value"] <= limit if aim[0] == "<" else detail["value"] >= limit)
        (line,) = (line for line in lines if line.startswith(name + " "))
        assert aim in line
        assert ("missed" in line) == (not detail["met"])
    assert results["details"]["window_ms"]["what"].startswith("median of 3 windows")
    assert results["window_ms"] < results["service_window_ms"]
    assert sum(line.split()[0] in ("2", "4") for line in lines if line) == 2  # a line for each number of wheels


def test_json_to_stdout_is_nothing_but_json(monkeypatch, capsys):
    measured = {"tried": Figure(3.0, 2.0, "theirs 3 s, ours 1 s", "a try")}
    monkeypatch.setattr(bench, "RECORDING_TIME", 1.0)
    monkeypatch.setattr(bench, "MEASUREMENTS", (lambda _: measured,))
    assert main(["bench", "--json", "-"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert results["tried"] == 3.0
    assert results["details"]["tried"]["met"] is True


def test_all_is_measured_with_as_many_threads_as_the_unit_gives_the_service(monkeypatch):
    unit = (Path(__file__).parents[2] / "systemd/soilbus@.service").read_text()
    assert f"OPENBLAS_NUM_THREADS={bench.THREADS} OMP_NUM_THREADS={bench.THREADS}" in unit
    seen = []

    def measure(_):
        seen.extend(pool["num_threads"] for pool in threadpool_info())
        return {}

    monkeypatch.setattr(bench, "RECORDING_TIME", 1.0)
    monkeypatch.setattr(bench, "MEASUREMENTS", (measure,))
    with threadpool_limits(2):
        bench.run_bench()
    assert set(seen) == {bench.THREADS}


@pytest.mark.parametrize(
    ("value", "at_most", "aim", "met"),
    [(5.0, False, ">= 5", True), (4.9, False, ">= 5 missed", False), (5.1, True, "<= 5 missed", False)],
)
def test_a_missed_target_says_so(value, at_most, aim, met):
    figure = Figure(value, 5.0, "", "", at_most=at_most)
    assert (figure.aim, figure.met) == (aim, met)


@pytest.mark.parametrize(
    ("name", "known"), list(zip(window.SOILS, itertools.cycle(window.EXACT_AND_ROUGH), strict=False))
)  # fmt: skip
def test_least_squares_has_the_same_problem_and_our_fit_its_optimum(name, known):
    """The peer's residuals are written out on their own; here with scipy's exact end instead of a quick one."""
    problem = window.window_of(name, *known)
    exact, rough = known
    assert [*np.array(["k_c", "k_phi", "n", "phi", "c", "K"])[problem.prior.free]] == [
        x for x in ("k_c", "k_phi", "n", "phi", "c", "K") if x != exact
    ]
    assert problem.prior.median[PARAMETERS.index(rough)] == pytest.approx(
        1.25 * window.soil_named(name)._asdict()[rough]
    )
    ours = window.fit_window(*problem)
    peer = window.by_finite_differences(*problem)
    assert window.distance(problem, ours, peer) < 0.1  # in posterior sd, to which descents end


def test_different_ends_are_no_figure(small, monkeypatch, capsys):
    monkeypatch.setattr(bench, "MEASUREMENTS", (lambda _: {"w": window.window_solve_speedup()},))
    monkeypatch.setattr(window, "MAX_DISTANCE_SD", 1e-9)
    assert main(["bench"]) == 1
    printed, err = capsys.readouterr()
    assert printed == ""
    assert err.count("\n") == 1
    assert "standard deviations apart" in err


def test_unlike_solutions_of_the_papers_problem_are_no_figure(monkeypatch):
    monkeypatch.setattr(paper, "MAX_RELATIVE_DIFFERENCE", 1e-12)
    with pytest.raises(AssertionError, match="apart"):
        paper.paper_solve_speedup()


def test_without_the_extra_one_line_says_what_to_install(small, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "threadpoolctl", None)
    assert main(["bench"]) == 1
    printed, err = capsys.readouterr()
    assert printed == ""
    assert err.count("\n") == 1
    assert "soilbus[peers]" in err


def test_an_unwritable_place_is_told_before_the_long_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "run_bench", lambda: pytest.fail("measured for nothing"))
    assert main(["bench", "--json", str(tmp_path / "no/such/bench.json")]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_windows_grow_as_they_are_said_to():
    for wheels in growth.WHEELS:
        for (problem, _), length in zip(growth.problems(wheels), growth.WINDOW_LENGTHS, strict=True):
            assert (problem.n, problem.n_wheels) == (10 * length, wheels)
            assert problem.n_rows == problem.n * (2 * wheels + 1)  # torque and sinkage of each wheel, one balance


def test_times_are_taken_in_turn_and_the_least_counts():
    order: list[str] = []
    spin = {"quick": 1, "slow": 200_000}

    def work(name: str):
        def run() -> None:
            order.append(name)
            sum(range(spin[name]))

        return run

    quick, slow = in_turn([work("quick"), work("slow")], 3)
    assert order == ["quick", "slow"] * 3
    assert quick < slow
