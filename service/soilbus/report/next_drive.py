"""What to drive next, in lines of text: to settle a diagnosis, or to know a soil better."""

from __future__ import annotations

import math

from soilbus.config.model import Config
from soilbus.estimation.posterior import Posterior
from soilbus.offline.manoeuvre import MAX_REPEATS, Plan
from soilbus.simulator.manoeuvre import Manoeuvre


def plan_lines(plan: Plan) -> list[str]:
    """Return what to drive next, and what it is expected to settle."""
    return [
        f"what to drive next, to decide between {', '.join(plan.between)} ({plan.manoeuvre.duration:.0f} s; "
        "--manoeuvre-out keeps it):",
        f"  {plan.manoeuvre.words}",
        f"  {hope_of(plan)}",
    ]


def hope_of(plan: Plan) -> str:
    """Return what a plan is expected to settle, and how often it must be driven."""
    if plan.repeats is None:
        return f"even {MAX_REPEATS} such drives are not expected to settle it: rather take one of the sensors above"
    times = "once" if plan.repeats == 1 else f"{plan.repeats} times"
    return f"driven {times} and diagnosed together with what there is, it is expected to settle the name"


def excitation_lines(manoeuvre: Manoeuvre, expected: Posterior, now: Posterior, config: Config) -> list[str]:
    """Return a manoeuvre, and the standard deviations of the soil that are expected after it."""
    z_ref, b_ref = config.estimator.z_ref, config.estimator.b_ref
    shares = []
    for posterior in (now, expected):
        pressure = posterior.bearing_pressure(z_ref, b_ref)
        shares.append((100.0 * pressure.std / pressure.value, math.degrees(posterior.parameters()["phi"].std)))
    (pressure_now, phi_now), (pressure_then, phi_then) = shares
    return [
        f"what to drive next ({manoeuvre.duration:.0f} s; --manoeuvre-out keeps it): {manoeuvre.words}",
        f"  bearing pressure is known to +- {pressure_now:.2g} % and phi to +- {phi_now:.2g} deg; the sensors alone "
        f"would then allow {pressure_then:.2g} % and {phi_then:.2g} deg",
    ]
