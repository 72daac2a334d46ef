"""The cases of the blind test, by kind and seed."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from soilbus.config.model import Config, Prior
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import REFERENCES, TRACTOR, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil, WheelModel, sinkage, state_on
from tests.lab.blind import contact_forms, further_forms, outside, soil_forms, vehicle_forms
from tests.lab.blind.form import SIZES, Form, Hidden, Setting, together
from tests.lab.computed_loads import FIELD_BOUNCE

KINDS = ("single", "pair", "outside", "plain", "hard", "shaking")
"""One effect of the catalogue, two of them, one that it lacks, none, none in harsh conditions, and none on ground over
which loads shake by FIELD_BOUNCE."""
SOILS = (
    "loam", "wet_clay", "dry_sand", "clayey_soil_38", "upland_sandy_loam_51", "north_gower_clayey_loam_46",
    "rubicon_sandy_loam_43", "sandy_loam_11_michigan",
)  # fmt: skip
DURATION = 120.0
EARLIER = (*soil_forms.FORMS, *contact_forms.FORMS, *vehicle_forms.FORMS)
PAIRED = (*EARLIER, *further_forms.FURTHER)
FORMS = (*PAIRED, *further_forms.FAR, *further_forms.LATE)
PAIRS, FURTHER_PAIRS, NULLS = 24, 8, 24
"""Cases of these kinds for each seed: pairs of earlier forms, pairs with a further one, nulls."""
_ALIKE = ({"grade", "draft_offset"}, {"draft_offset", "draft_gain"})
"""Pairs that no diagnosis could distinguish from one of the two."""
_HARSH = {"slowest": 0.15, "fastest": 0.40}


@dataclass(frozen=True)
class Case:
    """One recording to be diagnosed.

    hidden: names of the catalogue's effects in it, none for nulls and for what the catalogue
    lacks; forms: titles of the formulas used; imitable: only for the latter; far: all formulas are.  `config` is all
    that the diagnosis is given beside `recording.channels`; `soil` is the truth, at the
    middle of the way where it changes.  machine: a name of REFERENCES.
    """

    id: str
    kind: str
    hidden: tuple[str, ...]
    forms: tuple[str, ...]
    size: str
    imitable: bool
    far: bool
    soil_name: str
    soil: Soil
    with_sinkage: bool
    config: Config
    scenario: Scenario
    seed: int
    parts: tuple[Hidden, ...]
    machine: str = TRACTOR.stem

    @property
    def how(self) -> Hidden:
        """All that is hidden, at once."""
        return together(self.parts)

    @property
    def half(self) -> str:
        """ "tune" or "report", which share no formula; "mixed" for pairs of both.  A null goes by its id."""
        if not self.forms:
            return "tune" if zlib.crc32(self.id.encode()) % 2 else "report"
        halves = {half_of(title) for title in self.forms}
        return halves.pop() if len(halves) == 1 else "mixed"

    @cached_property
    def recording(self) -> Recording:
        """The drive, simulated when first asked for; SimulationError if it cannot be driven."""
        driven = simulate(self.how.tractor(self.config), self.how.way(self.scenario), self.seed, self.how.effects)
        return self.how.after(driven)


@cache
def _order(title: str) -> int:
    alike = [form.title for form in (*FORMS, *outside.FORMS) if form.title.startswith(title.partition(":")[0] + ":")]
    return alike.index(title)


def half_of(title: str) -> str:
    """ "tune" or "report" by turns among the formulas of an effect: one stays on its side for ever."""
    first = zlib.crc32(title.partition(":")[0].encode())
    return "tune" if (first + _order(title)) % 2 else "report"


def cases(kind: str, seed: int, machine: str = TRACTOR.stem) -> Iterator[Case]:
    """The cases of one of KINDS on one of REFERENCES; the same for the same seed.  ValueError for another kind."""
    if kind not in KINDS:
        raise ValueError(f"no kind is named {kind}; known: {', '.join(KINDS)}")
    if kind in ("single", "outside"):
        forms = FORMS if kind == "single" else outside.FORMS
        chosen: Iterable[tuple[tuple[Form, ...], str]] = (((form,), size) for form in forms for size in SIZES)
    elif kind == "pair":
        chosen = _pairs(seed)
    else:
        chosen = itertools.repeat(((), ""), NULLS)
    for number, (forms_of_case, size) in enumerate(chosen):
        yield _case(kind, seed, number, forms_of_case, size, machine)


def _pairs(seed: int) -> Iterator[tuple[tuple[Form, ...], str]]:
    rng = np.random.default_rng([seed, 2])
    for count, forms, further in ((PAIRS, EARLIER, False), (FURTHER_PAIRS, PAIRED, True)):
        found = 0
        while found < count:
            one, other = (forms[i] for i in rng.choice(len(forms), 2, replace=False))
            names = {one.effect, other.effect}
            wanted = not further or one in further_forms.FURTHER or other in further_forms.FURTHER
            if len(names) == 2 and names not in _ALIKE and wanted:
                found += 1
                yield (one, other), str(rng.choice(SIZES[1:]))


def _case(kind: str, seed: int, number: int, forms: tuple[Form, ...], size: str, machine: str) -> Case:
    titles = tuple(form.title for form in forms)
    rng = np.random.default_rng([seed, zlib.crc32("/".join([kind, *titles, size, str(number)]).encode())])
    name = str(rng.choice(SOILS))
    soil, with_sinkage = soil_named(name), bool(rng.integers(2)) or any(form.by_sinkage for form in forms)
    with_sinkage &= all(wheel.sinkage is not None for wheel in _configuration(machine).wheel)
    config = _configured(kind, _configuration(machine), soil, with_sinkage, rng)
    setting = Setting(soil, plain_sinkage(soil, machine), rng)
    parts = tuple(form.hide(form.size(size, with_sinkage), setting) for form in forms)
    sensors, other = "sinkage" if with_sinkage else "bare", machine if machine != TRACTOR.stem else ""
    return Case(
        id="/".join(part for part in (kind, "+".join(titles), size, name, sensors, other, f"{seed}.{number}") if part),
        kind=kind,
        hidden=tuple(form.effect for form in forms if form.effect),
        forms=titles,
        size=size,
        imitable=any(form.imitable for form in forms),
        far=bool(forms) and all(form.far for form in forms),
        soil_name=name,
        soil=soil,
        with_sinkage=with_sinkage,
        config=together(parts).configured(config),
        scenario=_scenario(kind, name, rng),
        seed=int(rng.integers(2**31)),
        parts=parts,
        machine=machine,
    )


def _configured(kind: str, config: Config, soil: Soil, with_sinkage: bool, rng: np.random.Generator) -> Config:
    """The configuration that the diagnosis has: sensors, and c and K off by 20 to 25 %.

    Hard: c and K off by 30 to 40 %, three times the gain errors, and half the time no accelerometer, unless it is all
    that measures the slope.
    """
    hard = kind == "hard"
    low, high = (0.30, 0.40) if hard else (0.20, 0.25)
    prior = {}
    for parameter in ("c", "K"):
        value = float(getattr(soil, parameter) * (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(low, high)))
        prior[parameter] = Prior(value=value, std=high * value)
    config = config.model_copy(update={"soil": config.soil.model_copy(update=prior)})
    if hard:
        config = config.model_copy(update={"noise": config.noise.scaled(3.0, "gain")})
        if rng.integers(2) and config.signals.pitch is not None:
            config = config.model_copy(update={"signals": config.signals.model_copy(update={"acceleration": None})})
    if not with_sinkage:
        wheels = [wheel.model_copy(update={"sinkage": None}) for wheel in config.wheel]
        config = config.model_copy(update={"wheel": wheels})
    return config


def _scenario(kind: str, soil: str, rng: np.random.Generator) -> Scenario:
    """All slips from 0.05 to 0.4 over gentle slopes; hard: speed and slip swing fast; shaking: loads do."""
    pace = _HARSH if kind == "hard" else {}
    x = np.cumsum(np.concatenate([[0.0], rng.uniform(12.0, 25.0, 20)]))
    slope = rng.uniform(-0.04, 0.04, len(x))
    return Scenario(
        DURATION, (Patch(0.0, soil),), speed=Swing(0.8, 2.0, **pace), slip=Swing(0.05, 0.40, **pace),
        slope=tuple(zip(x.tolist(), slope.tolist(), strict=True)), bounce=FIELD_BOUNCE if kind == "shaking" else 0.0,
    )  # fmt: skip


@cache
def _configuration(machine: str) -> Config:
    return reference_configuration(path=REFERENCES[machine])


@cache
def plain_sinkage(soil: Soil, machine: str = TRACTOR.stem) -> float:
    """Sinkage [m] of a rear wheel under a quarter of the tractor at a slip of 0.2."""
    config = _configuration(machine)
    assert config.vehicle is not None
    wheel = next(w for w in config.wheel if w.axle == "rear")
    state = state_on(soil, np.nan, 0.2, wheel.radius, wheel.width)
    return float(sinkage(entry_angle_for_load(config.vehicle.mass * 9.80665 / 4.0, state, WheelModel()), wheel.radius))
