"""What one run knew of the sensors, for the next run: the soil may be another by then, the sensors are the same."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.completed import CompletedProblem
from soilbus.estimation.effect_parameters import Free
from soilbus.estimation.gauss_newton import fit_window
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.residuals import WindowProblem
from soilbus.estimation.window import BinStore, Rig
from soilbus.terra.wheel import WheelModel

Array = NDArray[np.float64]

PERSISTENCE = 86400.0
"""Time [s] in which a gain error forgets all but 1/e of what it was: amplifiers drift, tyres wear."""
_SOIL = len(PARAMETERS)


def recalled(belief: Belief, soil: SoilPrior, gain_std: Array, elapsed: float) -> Belief:
    """What is left of a belief after a pause of so many seconds: gains (G,), each drawn back to its prior.

    Of the soil nothing is left but its prior: where the vehicle stands now nobody has
    measured, and a window that tells little would agree with any soil.  Gain errors wander
    about zero with the prior's std as their stationary one (Uhlenbeck & Ornstein 1930,
    Phys. Rev. 36, 823), so that a long pause leaves the prior.
    """
    kept = math.exp(-elapsed / PERSISTENCE) * (gain_std > 0.0)
    covariance = np.zeros_like(belief.covariance)
    covariance[:_SOIL, :_SOIL] = np.diag(soil.log_std**2)
    of_gains = kept[:, None] * belief.covariance[_SOIL:, _SOIL:] * kept
    covariance[_SOIL:, _SOIL:] = of_gains + np.diag((1.0 - kept**2) * gain_std**2)
    return Belief(soil.median, kept * belief.gains, covariance)


def is_borne_out(problem: WindowProblem, soil: SoilPrior, known: Belief) -> bool:
    """Whether a window's data are at least as likely with what is known of the gains as with their prior alone.

    A sensor that was exchanged or calibrated meanwhile has another error than it had.
    """
    anew = fit_window(problem, soil, Belief.of(soil, problem.gain_std))
    fit = fit_window(problem, soil, known)
    if fit is None or not fit.converged:
        return False
    return anew is None or not anew.converged or fit.evidence <= anew.evidence


def gain_errors(rig: Rig, model: WheelModel, free: Sequence[Free]) -> tuple[list[str], Array]:
    """Names and prior std (G,) of the gain errors that every window of a vehicle has, its effects' parameters last."""
    problem = CompletedProblem(BinStore(rig, 1.0, 0.0).window(0.0, 1.0), rig, model, 0.0, free=free)
    return problem.gain_names, problem.gain_std
