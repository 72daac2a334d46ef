"""The methods that are compared, and what each is given."""

from __future__ import annotations

from dataclasses import dataclass

from tests.lab.peers import finite_differences, kalman, linear, newton_raphson, ours
from tests.lab.peers.windows import Method

__all__ = [
    "NEEDS",
    "OURS",
    "Entry",
    "roster",
]

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


def roster() -> list[Entry]:
    """Ours and the peers: peers that hold parameters fixed twice, given them exactly and to a quarter.

    Ours stands once for each set that a peer is given exactly.
    """
    rest = ("k_c", "k_phi", "c", "K")
    ours_too = [Entry(OURS, ours.estimate, exact) for exact in (("K",), ("c", "n"), rest)]
    return [
        Entry(OURS, ours.estimate, note="c, K to 25 %"),
        *ours_too,
        Entry("scipy least_squares", finite_differences.estimate, note="c, K to 25 %"),
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
