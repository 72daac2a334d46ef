"""The figures of the Monte Carlo against windows made up to have them, and the command."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

import tests.lab.monte_carlo as of_room
from soilbus.config.file import load_config, machine
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import SOILS
from soilbus.trials import draws
from soilbus.trials.draws import prior_about
from tests.lab.monte_carlo import (
    ROUGHLY_KNOWN,
    Trial,
    as_json,
    main,
    monte_carlo,
    monte_carlo_report,
    summary,
    tasks_of,
    trials,
)

CONFIG = reference_configuration(ROUGHLY_KNOWN)


def made_up(n, spread=1.0, shift=0.0, held=(), seed=0):
    """Windows whose errors are normal with `spread` times the bound, and `shift` of it off; std is the bound."""
    rng = np.random.default_rng(seed)
    windows = []
    for _ in range(n):
        bound = rng.uniform(0.01, 0.3, 7)
        bound[list(held)] = 0.0
        error = bound * (shift + spread * rng.standard_normal(7))
        windows.append(Trial(error, bound, bound, 1.0, True, 0.01))
    return windows


def test_soils_around_a_named_one_are_drawn_until_the_tractor_gets_on(monkeypatch):
    def stuck_at_first(config, scenario, seed):
        driven.append(scenario.soils[0].parameters())
        if len(driven) % 4 == 1 and None not in driven:
            raise SimulationError("nothing moves")
        return SimpleNamespace(bogged_at=1.0 if len(driven) % 2 else None)

    driven = []
    monkeypatch.setattr(draws, "simulate", stuck_at_first)
    held = reference_configuration([*ROUGHLY_KNOWN, "soil.K.std=0"])
    found = [of_room.driven(task)[1] for task in tasks_of(held, "wet_clay", 2.0, 200, 5, around=0.2)]
    assert found == driven[1::2]
    logs = np.log(np.array(found) / np.asarray(SOILS["wet_clay"]))
    assert logs[:, :5].std(axis=0) == pytest.approx(np.full(5, 0.2), rel=0.2)
    assert np.abs(logs[:, :5].mean(axis=0)).max() < 0.06
    assert not logs[:, 5].any()
    assert [of_room.driven(task)[1] for task in tasks_of(held, "wet_clay", 2.0, 3, 5, around=0.2)] == found[:3]
    driven.append(None)  # the next one gets on
    (named,) = tasks_of(held, "wet_clay", 2.0, 1, 5)
    assert of_room.driven(named)[1] == SOILS["wet_clay"]
    with pytest.raises(SimulationError, match="stuck on wet_clay"):
        of_room.driven(named)


def lost(converged=False, chi2=np.nan):
    nothing = np.full(7, np.nan)
    return Trial(nothing, nothing, nothing, chi2, converged, 0.02)


def test_figures_of_windows_that_have_them():
    n = 20_000
    cell = summary("loam", 2.0, True, made_up(n, spread=1.3, shift=0.4, held=(0, 4)))
    assert cell.quantities == ("k_phi", "n", "phi", "K", "bearing_pressure")
    assert cell.rms == pytest.approx(np.full(5, np.hypot(1.3, 0.4)), rel=0.02)
    assert cell.bias == pytest.approx(np.full(5, 0.4), abs=0.03)
    # P(|0.4 + 1.3 z| < 1.96) = Phi(1.2) - Phi(-1.815)
    assert cell.coverage == pytest.approx(np.full(5, 0.8849 - 0.0348), abs=0.008)
    assert cell.bound == pytest.approx(np.full(5, np.sqrt((0.3**3 - 0.01**3) / 3.0 / 0.29)), rel=0.02)
    assert (cell.chi2, cell.windows, cell.failed, cell.not_converged) == (1.0, n, 0, 0)


def test_lost_windows_are_counted_and_left_out():
    good = made_up(50)
    cell = summary("loam", 2.0, False, [*good, lost(), lost(), lost(chi2=3.0)])
    alone = summary("loam", 2.0, False, good)
    assert (cell.windows, cell.failed, cell.not_converged) == (53, 2, 1)
    assert cell.chi2 == 1.0
    for figure in ("rms", "bias", "coverage", "bound"):
        assert getattr(cell, figure) == pytest.approx(getattr(alone, figure))


def test_a_cell_without_one_good_window_is_said_not_raised():
    cell = summary("loam", 2.0, False, [lost(), lost()])
    assert cell.failed == 2
    text = monte_carlo_report([cell, summary("loam", 2.0, True, made_up(9))])
    assert "simulated with the estimator's own wheel-soil model, noise and priors" in text
    assert "nan" in text
    assert json.loads(json.dumps(as_json(cell), allow_nan=False))["chi2"] is None


def with_rms(rms, n):
    """Windows with just this error over the bound, of which 5 % lie outside their intervals."""
    outside, inside = 2.5, np.sqrt((rms**2 - 0.05 * 2.5**2) / 0.95)
    shares = np.where(np.arange(n) % 20 == 0, outside, inside)
    return [Trial(np.full(7, 0.1 * share), np.full(7, 0.1), np.full(7, 0.1), 1.0, True, 0.01) for share in shares]


@pytest.mark.parametrize(("rms", "n", "mark"), [(1.10, 40, ""), (1.20, 40, "~"), (1.10, 4000, ""), (1.20, 4000, "*")])
def test_marks_tell_chance_from_a_miss(rms, n, mark):
    row = monte_carlo_report([summary("loam", 2.0, True, with_rms(rms, n))]).splitlines()[2]
    assert row.count(f"{rms:.2f}{mark} 95.0 ") == 7
    assert row.count("~") + row.count("*") == 7 * len(mark)


def test_a_prior_misses_by_as_much_as_it_says():
    prior = prior_of(CONFIG)
    held = SoilPrior(prior.median, np.where(np.arange(6) == 4, 0.0, prior.log_std))
    soil, rng = SOILS["wet_clay"], np.random.default_rng(1)
    drawn = [prior_about(held, soil, rng) for _ in range(4000)]
    assert all((p.log_std == held.log_std).all() for p in drawn)
    miss = np.log(np.array([p.median for p in drawn]) / np.asarray(soil))
    assert miss.std(axis=0) == pytest.approx(held.log_std, rel=0.05)
    assert np.abs(miss.mean(axis=0)).max() < 0.08
    assert not miss[:, 4].any()
    phi = PARAMETERS.index("phi")
    steep = [prior_about(prior, soil._replace(phi=1.1), rng).median[phi] for _ in range(200)]
    assert max(steep) < 1.3  # well short of a right angle, where the model ends


def test_drives_are_independent_and_the_same_whatever_else_is_asked_for():
    few, many = tasks_of(CONFIG, "loam", 10.0, 3, 5), tasks_of(CONFIG, "loam", 10.0, 8, 5)
    assert [t.seed for t in few] == [t.seed for t in many[:3]]
    others = [tasks_of(CONFIG, s, d, 8, n) for s, d, n in (("loam", 2.0, 5), ("wet_clay", 10.0, 5), ("loam", 10.0, 6))]
    seeds = [t.seed for tasks in (many, *others) for t in tasks]
    assert len(set(seeds)) == len(seeds)
    assert few[0].config.estimator.window == 10.0


def test_the_same_window_twice_and_without_sinkage_less_is_known():
    (task,) = tasks_of(CONFIG, "wet_clay", 2.0, 1, 3)
    (fitted, without), (again, _) = trials(task), trials(task)
    assert fitted.error == pytest.approx(again.error, rel=1e-12)
    assert (fitted.bound < without.bound).all()
    assert fitted.bound[:6] == pytest.approx(np.minimum(fitted.bound[:6], prior_of(CONFIG).log_std))


def test_where_the_tractor_cannot_drive():
    with pytest.raises(KeyError):
        list(monte_carlo(CONFIG, 1, 1, soils=["custard"]))
    with pytest.raises(SimulationError):
        list(monte_carlo(CONFIG, 1, 1, soils=["snow_us"]))


def test_the_command(tmp_path, capsys):
    out = tmp_path / "out.json"
    assert main(["--windows", "1", "--seed", "4", "--set", "soil.k_c.std=0", "--json", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    cells = json.loads(out.read_text())
    assert len(cells) == 18
    assert {(c["soil"], c["duration"], c["sinkage"]) for c in cells} == {
        (soil, duration, sinkage)
        for soil in ("loam", "wet_clay", "dry_sand") for duration in (2.0, 10.0, 60.0) for sinkage in (True, False)
    }  # fmt: skip
    assert list(cells[0]["quantities"]) == ["k_phi", "n", "phi", "c", "K", "bearing_pressure"]
    assert sum(line.startswith(("loam", "wet_clay", "dry_sand")) for line in lines) == 18
    # Longer windows tell more, sensors for sinkage too.
    bound = {(c["soil"], c["duration"], c["sinkage"]): c["quantities"]["bearing_pressure"]["bound"] for c in cells}
    for soil in ("loam", "wet_clay", "dry_sand"):
        assert bound[soil, 60.0, True] < bound[soil, 10.0, True] < bound[soil, 2.0, True]
        assert all(bound[soil, d, True] < bound[soil, d, False] for d in (2.0, 10.0, 60.0))


@pytest.mark.parametrize("name", ["tractor-2wd", "tractor-axles"])
def test_windows_of_machines_with_motors_of_axles_have_a_bound(name):
    (cell,) = monte_carlo(load_config(machine(name)), 2, 1, soils=("loam",), durations=(10.0,))
    assert not cell.sinkage, "a machine without sensors of sinkage has one row, and not a second one of its figures"
    assert cell.failed == cell.not_converged == 0
    assert np.all((cell.bound > 0.0) & (cell.bound < 2.0))
    assert np.all(cell.rms < 4.0)
