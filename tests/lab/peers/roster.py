"""The methods that are compared, and what each is given."""

from __future__ import annotations

from dataclasses import dataclass

from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import Posterior
from soilbus.trials.bench.window import by_finite_differences
from tests.lab.peers import kalman, linear, newton_raphson
from tests.lab.peers.windows import B_REF, Z_REF, Answer, Case, Method

OURS = "soilbus"


@dataclass(frozen=True)
class Entry:
    """A method as one line of the table; `exact` names the parameters that it is given exactly.

    `note` is for the reader; empty where `exact` says it all.
    """

    name: str
    method: Method
    exact: tuple[str, ...] = ()
    note: str = ""

    @property
    def given(self) -> str:
        """What the method is given beside the readings."""
        return self.note or (", ".join(self.exact) + " exactly" if self.exact else "")


def ours(case: Case) -> Answer | None:
    """Parameters given exactly are held; c and K have the assumed values as prior, the rest the configuration's."""
    fit = fit_window(case.problem, case.prior)
    return None if fit is None or not fit.converged else _answer(fit.posterior)


def least_squares(case: Case) -> Answer | None:
    """scipy's on our residuals and priors with finite differences; None where it does not converge."""
    try:
        posterior = by_finite_differences(case.problem, case.prior)
    except ValueError:  # a residual that is not finite
        return None
    return None if posterior is None else _answer(posterior)


def _answer(posterior: Posterior) -> Answer:
    free = {name: e for name, e in posterior.parameters().items() if e.std > 0.0}
    return free | {"bearing": posterior.bearing_pressure(Z_REF, B_REF)}


def roster() -> list[Entry]:
    """Ours and the peers: peers that hold parameters fixed twice, given them exactly and to a quarter.

    Ours stands once for each set that a peer is given exactly.
    """
    rest = ("k_c", "k_phi", "c", "K")
    ours_too = [Entry(OURS, ours, exact) for exact in (("K",), ("c", "n"), rest)]
    return [
        Entry(OURS, ours, note="c, K to 25 %"),
        *ours_too,
        Entry("scipy least_squares", least_squares, note="c, K to 25 %"),
        Entry("linear (Iagnemma, Kang)", linear.estimate, ("K",)),
        Entry("linear (Iagnemma, Kang)", linear.estimate, note="K to 25 %"),
        Entry("Newton-Raphson (Hutangkabodee)", newton_raphson.estimate, ("c", "n")),
        Entry("Newton-Raphson (Hutangkabodee)", newton_raphson.estimate, note="c, n to 25 %"),
        Entry("Kalman filter (Li)", kalman.estimate, rest),
        Entry("Kalman filter (Li)", kalman.estimate, note=", ".join(rest) + " to 25 %"),
    ]


NEEDS = """\
All get the same windows: torque, load, speed and sinkage of four wheels, ground speed, draft, pitch, acceleration.
What each assumes:
  soilbus, least_squares  the sensors' noise and gain errors; a broad prior of every parameter that it is not given
  linear                  triangular stresses; sinkage exact
  Newton-Raphson          Bekker's law with n given, sinkage and slip exact; a modulus for each tyre width
  Kalman filter           all but phi and n given; the sensors' noise, no gain errors
"""
