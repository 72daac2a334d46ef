"""From wheels to the vehicle: slip, load transfer, draft balance.

Sign conventions: forward is positive; pitch is positive nose up; draft is positive when
it holds the vehicle back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

__all__ = ["GRAVITY", "Chassis", "axle_loads", "pull_required", "slip_ratio", "wheel_loads", "wheel_shares"]

GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""


@dataclass(frozen=True, slots=True)
class Chassis:
    """Mass [kg] and lengths [m] of a vehicle, wheelbase from its first to its last axle; heights above the ground.

    on_one_axle: its tracks, or the wheels of a single axle, carry all of it, wherever the load acts.
    """

    mass: float
    wheelbase: float
    cg_ahead_of_rear_axle: float
    cg_height: float
    hitch_height: float
    on_one_axle: bool = False

    @property
    def in_reverse(self) -> Chassis:
        """Chassis for a reversed drive with forces and slopes turned forward (`window.forward`)."""
        return replace(self, cg_height=-self.cg_height, hitch_height=-self.hitch_height)


def slip_ratio(radius: Any, wheel_speed: Any, ground_speed: Any) -> Any:
    """Return the slip 1 - V/(r omega) (eq. 13 of Xi et al. 2024); nan where the wheel does not turn forward.

    Parameters
    ----------
    radius, wheel_speed, ground_speed
        r [m], omega [rad/s] and V [m/s], of shapes that broadcast.

    Examples
    --------
    >>> round(float(slip_ratio(radius=0.5, wheel_speed=4.0, ground_speed=1.6)), 3)
    0.2
    """
    rim = np.asarray(radius * wheel_speed, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rim > 0.0, 1.0 - ground_speed / rim, np.nan)


def pull_required(chassis: Chassis, draft: Any, pitch: Any, acceleration: Any) -> Any:
    """Return the drawbar pull [N] that all wheels together must give: draft + m (g sin(pitch) + dv/dt).

    Parameters
    ----------
    chassis
        Its mass counts.
    draft, pitch, acceleration
        [N], [rad] and along the ground [m/s^2], of shapes that broadcast.

    Examples
    --------
    >>> tractor = Chassis(mass=2000.0, wheelbase=2.0, cg_ahead_of_rear_axle=0.9, cg_height=0.7, hitch_height=0.5)
    >>> round(float(pull_required(tractor, draft=3000.0, pitch=0.05, acceleration=0.0)))
    3980
    """
    return draft + chassis.mass * (GRAVITY * np.sin(pitch) + acceleration)


def axle_loads(chassis: Chassis, draft: Any, pitch: Any, acceleration: Any) -> tuple[Any, Any]:
    """Return the load [N] on the front and on the rear axle, from moments about the rear contact.

    An axle between them counts on both, by how near it is: a load W at x ahead of the rear axle is W x / wheelbase on
    the front axle and the rest on the rear one (`wheel_shares`).
    """
    weight = chassis.mass * GRAVITY
    along = weight * np.sin(pitch) + chassis.mass * acceleration
    across = weight * np.cos(pitch)
    if chassis.on_one_axle:
        front = across + 0.0 * (along + draft)
        return front, 0.0 * front
    moment = across * chassis.cg_ahead_of_rear_axle - along * chassis.cg_height - draft * chassis.hitch_height
    front = moment / chassis.wheelbase
    return front, across - front


def wheel_shares(ahead: Any) -> Any:
    """Return the shares (W, 2) of the loads of `axle_loads` that each wheel carries, left and right alike.

    With more than two axles these loads are statically indeterminate.  A rigid frame on equally stiff wheels makes them
    linear along the wheelbase: of all loads in balance those with the least sum of squares.

    Parameters
    ----------
    ahead
        (W,), distance of each wheel ahead of the rear axle, over the wheelbase.

    Examples
    --------
    >>> wheel_shares([1.0, 0.5, 0.0]).round(3).tolist()
    [[0.833, -0.167], [0.333, 0.333], [-0.167, 0.833]]
    """
    ends = np.stack([ahead, 1.0 - np.asarray(ahead)])
    return ends.T @ np.linalg.pinv(ends @ ends.T)


def wheel_loads(chassis: Chassis, ahead: Any, draft: Any, pitch: Any, acceleration: Any) -> Any:
    """Return the load [N] (W, ...) on each wheel, `ahead` as in `wheel_shares`, left and right alike."""
    front, rear = axle_loads(chassis, draft, pitch, acceleration)
    of_front, of_rear = wheel_shares(ahead).T
    return np.multiply.outer(of_front, front) + np.multiply.outer(of_rear, rear)
