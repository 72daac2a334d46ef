"""Figures of the paper against a second wheel formula, figures that we know of the paper, and its own claims."""

import numpy as np
import pytest

import soilbus
from other_wheel import Contact, carrying, forces

SOIL = {"wet clay": soilbus.soil_named("xi_wet_clay"), "sandy loam": soilbus.soil_named("xi_sandy_loam")}
RADIUS, WIDTH, SLIP, SINKAGE = 0.5, 0.3, 0.2, 0.05
ANGLE = np.arccos(1.0 - SINKAGE / RADIUS)
FORCES = ("load", "drawbar_pull", "torque")


def at_the_sinkage(soil: soilbus.Soil) -> dict[str, float]:
    found = forces(soil, Contact(), [ANGLE], [SLIP], RADIUS, WIDTH)
    return dict(zip(FORCES, (float(f[0]) for f in found), strict=True))


@pytest.fixture(scope="module")
def sensitivity():
    return soilbus.paper.figure("sensitivity").to_frame()


@pytest.mark.parametrize("name", SOIL)
@pytest.mark.parametrize("parameter", soilbus.Soil._fields)
def test_forces_change_with_a_parameter_as_by_another_formula(sensitivity, name, parameter):
    soil = SOIL[name]
    own = sensitivity[(sensitivity["soil"] == name) & (sensitivity["parameter"] == parameter)]
    true = at_the_sinkage(soil)
    for share, points in own.groupby("share of the parameter"):
        changed = at_the_sinkage(soil._replace(**{parameter: share * getattr(soil, parameter)}))
        for _, point in points.iterrows():
            wanted = changed[point["force"]] / true[point["force"]]
            assert point["share of the force"] == pytest.approx(wanted, rel=2e-3, abs=2e-3)


@pytest.mark.parametrize("force", FORCES)
def test_slopes_of_the_sensitivity_are_finite_differences(sensitivity, force):
    soil, step = SOIL["wet clay"], 1e-4
    own = sensitivity[(sensitivity["soil"] == "wet clay") & (sensitivity["force"] == force)]
    for parameter, line in own.groupby("parameter"):
        x, y = line["share of the parameter"].to_numpy(), line["share of the force"].to_numpy()
        near = np.abs(x - 1.0) < 0.11
        slope = np.polynomial.Polynomial.fit(x[near] - 1.0, y[near], 4).deriv()(0.0)
        value = getattr(soil, parameter)
        up, down = (at_the_sinkage(soil._replace(**{parameter: f * value}))[force] for f in (1.0 + step, 1.0 - step))
        by_differences = (up - down) / (2.0 * step * at_the_sinkage(soil)[force])
        assert slope == pytest.approx(by_differences, rel=5e-3, abs=5e-3), parameter


def test_cohesion_moves_the_pull_on_wet_clay_which_the_paper_denies(sensitivity):
    of_c = sensitivity[(sensitivity["parameter"] == "c") & (sensitivity["soil"] == "wet clay")]
    least = of_c[of_c["share of the parameter"] == 0.5].set_index("force")["share of the force"]
    assert least["drawbar_pull"] < 0.5
    assert least["load"] > 0.9


@pytest.mark.parametrize(("law", "rational"), [("exponential", False), ("rational", True)])
def test_the_required_torque_is_that_of_another_formula(law, rational):
    lines = soilbus.paper.figure("torque").to_frame()
    lines = lines[lines["shear law"] == law]
    assert lines["soil"].nunique() > 15
    contact = Contact(rational=rational)
    for name in ("xi_wet_clay", "lete_sand", "rubicon_sandy_loam_43"):
        soil, own = soilbus.soil_named(name), lines[lines["soil"] == name].iloc[::6]
        load, slip = own["load [N]"].to_numpy(), np.full(len(own), SLIP)
        angle = carrying(soil, contact, load, slip, RADIUS, WIDTH)
        torque = forces(soil, contact, angle, slip, RADIUS, WIDTH)[2]
        np.testing.assert_allclose(own["torque [N.m]"], torque, rtol=2e-3)


def test_shear_stresses_add_up_to_the_torques_that_the_notes_give():
    lines = soilbus.paper.figure("shear").to_frame()
    lines = lines[lines["soil"] == "wet clay"]
    ends = {}
    for law, wanted in (("exponential", 278.0), ("rational", 219.0)):  # shared/paper/notes.md, fig. 2
        own = lines[lines["shear law"] == law]
        angle, stress = np.radians(own["angle [deg]"]), 1e3 * own["shear stress [kPa]"]
        assert RADIUS**2 * WIDTH * np.trapezoid(stress, angle) == pytest.approx(wanted, abs=0.6)
        ends[law] = stress.iloc[0]
    j = RADIUS * (ANGLE - (1.0 - SLIP) * np.sin(ANGLE)) / SOIL["wet clay"].K
    assert ends["rational"] / ends["exponential"] == pytest.approx(j / (1.0 + j) / (1.0 - np.exp(-j)), rel=1e-9)


def test_the_iteration_starts_as_printed_and_converges_as_the_paper_says():
    lines = soilbus.paper.figure("convergence").to_frame()
    start = lines[(lines["step"] == 0) & lines["run"].str.contains("20 %")]["over truth"]
    np.testing.assert_allclose(start, 0.8, atol=5e-4)
    off = (lines.set_index(["run", "parameter", "step"])["over truth"] - 1.0).abs().unstack("step")
    assert (off[6] < 0.02).all()  # section 5: six iterations, 2 %
    assert (off[8] < 1e-6).all()
    assert (off[3] > off[8]).all()


def test_each_figure_is_drawn_with_all_its_lines():
    for name, panels, lines in (("sensitivity", 6, 6), ("torque", 2, 21), ("shear", 2, 2), ("convergence", 3, 4)):
        axes = soilbus.paper.figure(name).plot().axes
        assert [len(axis.get_lines()) for axis in axes] == [lines] * panels


def test_a_figure_or_a_sinkage_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="no figure is named shera; did you mean shear"):
        soilbus.paper.figure("shera")
    for name in ("sensitivity", "shear", "convergence"):
        with pytest.raises(ValueError, match=r"sinkage"):
            soilbus.paper.figure(name, sinkage=0.6)
