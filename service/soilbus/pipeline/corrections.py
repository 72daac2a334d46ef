"""What the last window corrects of the readings after it: torque limits that are not reached, and the draft.

    limit = min(reported limit, ceiling)    ceiling: 0 of an idle wheel, else the torque at which its motor saturated
    draft = reading, corrected by the fitted effects of its sensor

Decision and watch of the window have them, and the live loop between two windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.window import Rig, Window
from soilbus.terra.effects.effect import Active, Surroundings, true_draft


@dataclass(frozen=True, slots=True)
class Corrections:
    """Corrections of one window.

    torque_ceiling: of each wheel [N m], inf where none is known, empty before the first window; effects: those of the
    model with their fitted values.
    """

    torque_ceiling: tuple[float, ...] = ()
    effects: Sequence[Active] = ()

    def torque_limit(self, reported: Array) -> Array:
        """Return the greatest available torque (W,) [N m] by the reported limits (W,); nan where not known."""
        limit = np.fmin(reported, self.torque_ceiling) if self.torque_ceiling else reported
        return np.where(np.isfinite(limit), limit, np.nan)

    def corrected(self, window: Window, rig: Rig) -> Window:
        """Return the window with its draft corrected."""
        if not any(active.effect.draft for active in self.effects) or not len(window.t):
            return window
        t = (window.t - window.t[0])[:, None]
        measured = Surroundings(
            t=t,
            distance=np.zeros_like(t),
            load=window.load,
            ground_speed=window.ground_speed[:, None],
            wheel_speed=window.speed,
            rear=~rig.front,
            draft=window.draft[:, None],
            acceleration=window.acceleration[:, None],
            mass=0.0 if rig.chassis is None else rig.chassis.mass,
            duration=float(t[-1, 0]),
        )
        return replace(window, draft=true_draft(self.effects, window.draft, measured))


NO_CORRECTIONS = Corrections()
"""The corrections before the first window: none."""
