"""TOML file -> typed, checked configuration.

Every key, unit and default of soilbus is defined here; an unknown key is an error. Values are SI; a quantity in another
unit says so in its name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    PrivateAttr,
    ValidationInfo,
    field_validator,
    model_validator,
)

from soilbus.grouping import grouped
from soilbus.words import LONGEST_NAME, did_you_mean, shown

__all__ = [
    "J1939", "Axle", "Bus", "Column", "Columns", "Config", "ConfigError", "Dbc", "Effect", "Estimator", "Form", "Model",
    "Noise", "NoiseOfChannels", "Output", "Prior", "RunningGear", "Signal", "Signals", "SoilPrior", "Table", "Track",
    "Traversability", "Vehicle", "Warning", "Wheel",
]  # fmt: skip

SHORT_BIN = 0.04
"""Length of a bin [s] in which a wheel's slip hardly changes while its load shakes at 1.5 to 3 Hz; evidence at
`Estimator.bin`."""
CONTROL_FREE_NAME = r"^[A-Za-z0-9_-]{1,16}$"
Name = Annotated[str, Field(pattern=CONTROL_FREE_NAME)]


def _signal_name(value: str, info: ValidationInfo) -> str:
    """The same name, which without [columns] must be "Message.Signal"."""
    if not (info.context or {}).get("columns") and not re.fullmatch(r"[^.\s]+\.[^.\s]+", value):
        name = value if len(value) <= LONGEST_NAME else f"{value[:LONGEST_NAME]}..."
        raise ValueError(f'"{name}" is not "Message.Signal", the names of a message and of its signal in the DBC')
    return value


SignalName = Annotated[str, Field(min_length=1), AfterValidator(_signal_name)]


class ConfigError(Exception):
    """Error of a configuration that cannot be used; `faults` holds one line for each fault."""

    def __init__(self, faults: Iterable[str]) -> None:
        self.faults = [shown(fault) for fault in faults]
        super().__init__("\n".join(self.faults))


@dataclass(frozen=True)
class Usual:
    """Range of values that real machines have; a value outside is a slip of the pen.

    `slips` are units in which the quantity is often written by mistake, with their SI value:
    the one that makes the most ordinary value of it is named.
    """

    low: float
    high: float
    unit: str
    slips: tuple[tuple[str, float], ...] = ()

    def __call__(self, value: float) -> float:
        """Return the value; raise ValueError for one that no machine has."""
        if not self.low <= value <= self.high:
            raise ValueError(self._fault(value))
        return value

    def _fault(self, value: float) -> str:
        unit = f" {self.unit}" if self.unit else ""
        text = f"{value:g}{unit} is not from {self.low:g} to {self.high:g}{unit}"
        middle = math.sqrt(max(self.low, self.high / 50.0) * self.high)
        sensible = [(n, value * size) for n, size in self.slips if self.low <= value * size <= self.high]
        if not sensible:
            return text
        name, meant = min(sensible, key=lambda slip: abs(math.log(max(slip[1], 1e-9) / middle)))
        return f"{text}; is it in {name}? {value:g} {name} are {meant:.4g}{unit}"


_SHORT = (("mm", 1e-3), ("cm", 1e-2))
# From the smallest rovers and single-wheel test beds of the literature (radius 85 mm) to the largest
# articulated tractors and harvesters (30 t, tyres of 2.2 m diameter), with a margin.
RADIUS = Usual(0.05, 1.5, "m", _SHORT)
WIDTH = Usual(0.02, 2.0, "m", _SHORT)
MASS = Usual(20.0, 6.0e4, "kg", (("t", 1e3),))
WHEELBASE = Usual(0.2, 8.0, "m", _SHORT)
CG_AHEAD = Usual(0.02, 8.0, "m", _SHORT)
HEIGHT = Usual(0.02, 4.0, "m", _SHORT)
HITCH_HEIGHT = Usual(0.0, 2.5, "m", _SHORT)
TRACK = Usual(0.15, 5.0, "m", _SHORT)
CONTACT_LENGTH = Usual(0.2, 8.0, "m", _SHORT)
MASS_STD = Usual(0.0, 3.0e4, "kg", (("t", 1e3),))
LENGTH_STD = Usual(0.0, 4.0, "m", _SHORT)
GEAR_RATIO = Usual(0.1, 1000.0, "")
WHEEL_TORQUE = Usual(5.0, 2.0e5, "N m", (("kN m", 1e3),))
SPRING_AREA = Usual(1.0e-4, 1.0, "m^2", (("cm^2", 1e-4), ("mm^2", 1e-6)))
AXLE_TORQUE = Usual(10.0, 4.0e5, "N m", (("kN m", 1e3),))
WINDOW = Usual(0.5, 600.0, "s", (("ms", 1e-3),))
SHARE = Usual(0.0, 1.0, "", (("%", 1e-2),))
# Soils: Wong, Theory of Ground Vehicles (2008), table 2.3, has phi of 6 to 38 degrees, n of 0.11 to 1.6, k_phi of
# 43 to 5880 kN/m^(n+2), k_c up to 102 kN/m^(n+1), c up to 69 kPa, K of a few mm to cm; simulants reach n of 1.3.
ANGLE = Usual(0.0, 1.05, "rad", (("degrees", math.pi / 180.0),))
EXPONENT = Usual(0.0, 3.0, "")
MODULUS_C = Usual(0.0, 1.0e7, "N/m^(n+1)")
MODULUS_PHI = Usual(6.0e3, 1.0e9, "N/m^(n+2)", (("kN/m^(n+2)", 1e3),))
COHESION = Usual(0.0, 1.0e6, "Pa")
SHEAR_LENGTH = Usual(0.0, 0.5, "m", _SHORT)


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


class Bus(BaseModel):
    """Interface of python-can; keys that are not ours go to it as they are."""

    model_config = ConfigDict(extra="allow", frozen=True)
    interface: str = "socketcan"
    """Backend of python-can."""
    channel: str = "can0"
    """Name of the interface."""

    @model_validator(mode="after")
    def _no_typing_error(self) -> Bus:
        for key in self.model_extra or {}:
            if meant := did_you_mean(key, type(self).model_fields):
                raise ValueError(f"{key}: unknown key{meant}")
        return self


class Dbc(_Section):
    """DBC files that describe the vehicle's frames, beside the configuration or ours by name."""

    input: list[str] = Field(default_factory=list)
    """Files that hold the mapped messages."""
    checked: list[str] = Field(default_factory=list)
    """Messages of the vehicle's own DBC that count only with a right Counter and Checksum (dbc/README.md)."""


class Signal(_Section):
    """Source of a role's value: "Message.Signal", or a table with more keys."""

    signal: SignalName
    """`Message.Signal` of the DBC; with [columns] the name of a column."""
    sign: Literal[1, -1] = 1
    """-1 for a sensor mounted the other way round."""
    at: Literal["wheel", "shaft"] | None = None
    """Side of the gear on which a torque or speed is measured."""
    valid: str | None = None
    """Signal of the same message that must hold one of `valid_values` for the value to count."""
    valid_values: list[int] | None = None
    """Codes of `valid`; by default those that the DBC's value table calls valid, ok, normal and the like, else 1."""
    timeout: PositiveFloat | None = None
    """Age from which the channel is stale [s]."""
    delay: Annotated[float, Field(ge=-1.0, le=2.0)] = 0.0
    """Time [s] by which a sample is late: a radar's filter, a receiver's solution, a queue."""
    torque_constant: PositiveFloat | None = None
    """Torque for a current [N m/A], where a motor's current is mapped to its torque."""
    reference_torque: PositiveFloat | None = None
    """Torque of 100 % [N m], where a percentage is mapped: in J1939 SPN 544, of which SPN 513 is the percentage."""
    effective_area: Annotated[PositiveFloat, AfterValidator(SPRING_AREA)] | None = None
    """Force over pressure of an axle's air springs together [m^2], where their pressure is mapped to its load."""
    unsprung_mass: NonNegativeFloat = 0.0
    """Mass that the air springs do not carry [kg]: axle and wheels."""
    unit: str | None = None
    """Unit of a column's values, where its name does not end in one."""

    @model_validator(mode="after")
    def _of_one_kind(self) -> Signal:
        if self.unsprung_mass and self.effective_area is None:
            raise ValueError("unsprung_mass is for the pressure of air springs: give their effective_area, too")
        if self.torque_constant is not None and self.reference_torque is not None:
            kinds = "torque_constant is for a current, reference_torque for a percentage"
            raise ValueError(f"{kinds}: leave out one of the two")
        return self

    @model_validator(mode="before")
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        return {"signal": value} if isinstance(value, str) else value


class Vehicle(_Section):
    """Longitudinal vehicle; lengths m, mass kg, heights above the ground."""

    mass: Annotated[PositiveFloat, AfterValidator(MASS)]
    """Of the whole vehicle [kg], ballast included; `{ value, std }` where tanks, driver or load change it."""
    mass_std: Annotated[NonNegativeFloat, AfterValidator(MASS_STD)] | None = None
    """Its std [kg], which `mass = { value, std }` sets; by default 2 % of the mass (driver, half a tank) where a load
    is not measured, else 0."""
    wheelbase: Annotated[PositiveFloat, AfterValidator(WHEELBASE)]
    """First to last axle [m]."""
    cg_ahead_of_rear_axle: Annotated[PositiveFloat, AfterValidator(CG_AHEAD)]
    """Centre of gravity ahead of the rear axle [m]; `{ value, std }` where it is not known well."""
    cg_std: Annotated[NonNegativeFloat, AfterValidator(LENGTH_STD)] | None = None
    """Its std [m], which `cg_ahead_of_rear_axle = { value, std }` sets; by default 2 % of the wheelbase where a load is
    not measured, else 0."""
    cg_height: Annotated[PositiveFloat, AfterValidator(HEIGHT)]
    """Centre of gravity above the ground [m]."""
    hitch_height: Annotated[NonNegativeFloat, AfterValidator(HITCH_HEIGHT)] = 0.5
    """Line of draft above the ground at the hitch [m]."""
    track: Annotated[PositiveFloat, AfterValidator(TRACK)] | None = None
    """Distance between the middles of the left and the right wheels; turns a yaw rate into a difference of speeds."""
    towing: Literal["measured", "never", "unknown"] = "measured"
    """Draft at the hitch: measured by `signals.draft`, never any, or unknown, which no sensor shows in full: then
    `signals.draft` is not used and there is no GO."""
    steering: Literal["wheels", "skid"] = "wheels"
    """By turned wheels, or by the speeds of the two sides: then wheels slide sideways in every turn."""
    differential_lock: Signal | None = None
    """Above 0.5 while the differentials are locked; optional."""

    @model_validator(mode="before")
    @classmethod
    def _with_std(cls, value: Any) -> Any:
        """`{ value, std }` of a measure as two keys."""
        if not isinstance(value, Mapping):
            return value
        out = dict(value)
        for key, std in (("mass", "mass_std"), ("cg_ahead_of_rear_axle", "cg_std")):
            if not isinstance(given := out.get(key), Mapping):
                continue
            if unknown := [k for k in given if k not in ("value", "std")]:
                raise ValueError(f"{key}: unknown key {unknown[0]}; it is a number or {{ value, std }}")
            if "std" in given and std in out:
                raise ValueError(f"{key} = {{ value, std }} and {std} are the same: leave out one of the two")
            del out[key]
            out |= {{"value": key, "std": std}[part]: number for part, number in given.items()}
        return out

    @model_validator(mode="after")
    def _cg_between_axles(self) -> Vehicle:
        if self.cg_ahead_of_rear_axle >= self.wheelbase:
            raise ValueError("cg_ahead_of_rear_axle must be less than wheelbase")
        return self


class SignalOfAcceleration(Signal):
    """An accelerometer along the vehicle, with the keys of a Signal; `kind` says what it measures."""

    kind: Literal["kinematic", "specific_force"] = "kinematic"
    """dv/dt, or the specific force dv/dt + g sin(pitch) that an inertial sensor fixed to the vehicle feels."""


class Axle(_Section):
    """Motor, differential, load cell or air spring of an axle.

    Axles stand in the order of their tables, from the front to the rear; `front` is always the first and `rear` the
    last.  `both` is the shaft that drives all axles; its differentials are those between the axles.  Torques are of the
    axle: the sum over its wheels.
    """

    name: Name
    """`front`, `middle`, `rear` or a name of your own; `both` for a motor or engine that drives all axles."""
    ahead_of_rear_axle: Annotated[PositiveFloat, AfterValidator(WHEELBASE)] | None = None
    """Distance [m] of an axle between the first and the last from the last; without, all are equally far apart."""
    gear_ratio: Annotated[PositiveFloat, AfterValidator(GEAR_RATIO)] = 1.0
    """Turns of the motor for one of the axle's wheels; of `both`: for one of the shafts to the axles, whose own ratios
    are those of `front` and `rear`."""
    differential: Literal["open", "locked", "limited"] = "open"
    """Open: the same torque left and right.  Locked: the same speed.  Limited: in between."""
    torque_bias: Annotated[NonNegativeFloat, AfterValidator(SHARE)] | None = None
    """Sd of the difference of the two torques over their sum; by default 0.05 of an open differential (bias ratio 1.1),
    0.25 of limited slip (bias ratios of 2 to 3; Wong 2008, sect. 4.4)."""
    max_torque: Annotated[PositiveFloat, AfterValidator(AXLE_TORQUE)] | None = None
    """Greatest torque at the axle [N m], where no signal reports it."""
    torque: Signal | None = None
    """Torque [N m] of its motor; with `torque_constant` its current [A], with `reference_torque` a percentage."""
    torque_limit: Signal | None = None
    """Greatest torque that the motor reports it can give [N m]; optional."""
    motor_speed: Signal | None = None
    """Rotation of its motor [rad/s]: the mean of its wheels' speeds, where these have no sensor."""
    load: Signal | None = None
    """Load on the axle [N]: load cell, or with `effective_area` the pressure of the air springs."""


class RunningGear(_Section):
    """Motor and sensors of a wheel, or of a track: "wheel" is then its sprocket."""

    driven: bool = True
    """false: it rolls freely, without any torque but the drag of its bearing."""
    gear_ratio: Annotated[PositiveFloat, AfterValidator(GEAR_RATIO)] = 1.0
    """Turns of the motor shaft for one of the wheel."""
    max_torque: Annotated[PositiveFloat, AfterValidator(WHEEL_TORQUE)] | None = None
    """The motor's limit at the wheel [N m], where no signal reports it."""
    torque: Signal | None = None
    """Motor torque [N m], at the wheel or the shaft."""
    speed: Signal | None = None
    """Rotation [rad/s], at the wheel or the shaft."""
    load: Signal | None = None
    """Load cell [N]; without, the load follows from the vehicle's weight."""
    sinkage: Signal | None = None
    """Depth of the rut [m]; optional."""
    torque_limit: Signal | None = None
    """Greatest torque that the motor reports it can give [N m]; optional."""
    motor_speed: Signal | None = None
    """Only to find a faulty speed sensor."""


class Wheel(RunningGear):
    """One wheel, with the keys of a RunningGear.

    Only the wheel of a test rig has no axle; of an axle the left one stands first.
    """

    name: Name
    """For messages, JSON and frames: FL, FR, RL, RR on a tractor, ML and MR between them on six wheels."""
    axle: Name | None = None
    """Axle that carries it: `front`, `middle`, `rear`, or the name of an [[axle]]."""
    radius: Annotated[PositiveFloat, AfterValidator(RADIUS)]
    """Rolling radius [m]."""
    width: Annotated[PositiveFloat, AfterValidator(WIDTH)]
    """Of the tyre [m]."""
    tyre: Literal["flexible", "rigid"] = "flexible"
    """A rigid wheel has no tyre that could flatten or wear."""

    _contact_length: float = PrivateAttr(0.0)

    @property
    def contact_length(self) -> float:
        """Contact length of a track on the ground [m]; 0 of a wheel."""
        return self._contact_length

    @property
    def section(self) -> str:
        """Section of the TOML file that describes it."""
        return "track" if self._contact_length else "wheel"

    @model_validator(mode="after")
    def _can_be_used(self) -> Wheel:
        _check_free(self, "wheel")
        return self


def _check_free(part: Wheel | Track, section: str) -> None:
    """ValueError for a wheel or track that rolls freely and has a motor's torque or limit."""
    of_motor = [role for role in ("torque", "torque_limit", "max_torque") if getattr(part, role) is not None]
    if not part.driven and of_motor:
        raise ValueError(f"{section} {part.name} has driven = false and a {of_motor[0]}: leave out one of the two")


class Track(RunningGear):
    """One track, the left one first, with the keys of a RunningGear.

    Pressure on the ground is uniform, or peaks below its rollers.  Tracks alone carry the whole vehicle: its
    `wheelbase` is then their contact length, and it steers by `skid`, unless [vehicle] says otherwise.  With wheels, or
    on both axles, a track takes the place of the wheel of its axle.
    """

    name: Name
    """For messages, JSON and frames: L, R."""
    axle: Name | None = None
    """Axle whose place it takes on a half-track or a machine with four tracks."""
    contact_length: Annotated[PositiveFloat, AfterValidator(CONTACT_LENGTH)]
    """On the ground, from the first to the last roller [m]."""
    width: Annotated[PositiveFloat, AfterValidator(WIDTH)]
    """Of the track [m]."""
    sprocket_radius: Annotated[PositiveFloat, AfterValidator(RADIUS)] | None = None
    """Pitch radius of the driving sprocket [m]; without, it follows from pitch and sprocket_teeth."""
    pitch: Annotated[PositiveFloat, AfterValidator(WIDTH)] | None = None
    """Of the links [m]; radius of the sprocket: pitch times sprocket_teeth over 2 pi."""
    sprocket_teeth: PositiveInt | None = None
    """Links that one turn of the sprocket moves."""
    roller_spacing: Annotated[PositiveFloat, AfterValidator(WIDTH)] | None = None
    """From one road roller to the next [m], where pressure peaks below each by p (1 + cos(2 pi x / spacing)) (Wills
    1963).  Without, pressure is uniform."""

    def as_wheel(self) -> Wheel:
        """Return the rigid wheel of the sprocket's radius that has its sensors, with the contact length."""
        same = {key: getattr(self, key) for key in type(self).model_fields if key in Wheel.model_fields}
        wheel = Wheel(**same | {"axle": self.axle or "front"}, radius=self.radius, tyre="rigid")
        wheel._contact_length = self.contact_length
        return wheel

    @property
    def radius(self) -> float:
        """Pitch radius of the sprocket [m]."""
        if self.sprocket_radius is not None:
            return self.sprocket_radius
        assert self.pitch is not None  # _has_radius sees to both
        assert self.sprocket_teeth is not None
        return self.pitch * self.sprocket_teeth / (2.0 * math.pi)

    @property
    def rollers(self) -> int:
        """Periods of the pressure along the contact; 0: uniform."""
        return 0 if self.roller_spacing is None else max(round(self.contact_length / self.roller_spacing), 1)

    @model_validator(mode="after")
    def _has_radius(self) -> Track:
        by_pitch = self.pitch is not None
        if by_pitch == (self.sprocket_teeth is None) or by_pitch == (self.sprocket_radius is not None):
            raise ValueError(f"track {self.name} needs sprocket_radius, or pitch and sprocket_teeth: one of the two")
        if self.roller_spacing is not None and self.roller_spacing > self.contact_length:
            raise ValueError(f"track {self.name}: roller_spacing is greater than contact_length")
        _check_free(self, "track")
        return self


class Signals(_Section):
    """Signals of the whole vehicle."""

    ground_speed: Signal | None = None
    """True speed over ground [m/s]: radar, GNSS or ISO 11783 ground-based speed."""
    draft: Signal | None = None
    """Pull at the hitch [N], positive backward."""
    pitch: Signal | None = None
    """Nose-up angle [rad]."""
    acceleration: SignalOfAcceleration | None = None
    """Along the vehicle [m/s^2], dv/dt or specific force."""
    yaw_rate: Signal | None = None
    """Positive to the left [rad/s]; distinguishes turns from wheels that spin on one side."""
    roll: Signal | None = None
    """Left side up [rad]; shifts load where no cell measures it."""
    steering_angle: Signal | None = None
    """Of the front wheels, positive to the left [rad]; with the wheelbase a yaw rate where none is mapped."""
    latitude: Signal | None = None
    """WGS84, positive north; only for the map."""
    longitude: Signal | None = None
    """WGS84, positive east."""

    @model_validator(mode="after")
    def _whole_position(self) -> Signals:
        if (self.latitude is None) != (self.longitude is None):
            raise ValueError("a position needs both latitude and longitude")
        return self


class Column(_Section):
    """A column of a table: its name, or a table with the factor that brings it to SI."""

    column: Annotated[str, Field(min_length=1)]
    """Name in the head of the table."""
    factor: float = 1.0
    """From its unit to SI."""

    @model_validator(mode="before")
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        return {"column": value} if isinstance(value, str) else value

    @field_validator("factor")
    @classmethod
    def _not_zero(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("a factor of 0 leaves nothing of the column")
        return value


class Columns(_Section):
    """A table of decoded signals over time in place of a bus: CSV, Parquet or MF4; roles then name its columns."""

    time: str = ""
    """Column of the time: numbers, dates as ISO 8601 writes them, or dates of a Parquet file.  MF4 has its own."""
    unit: Literal["s", "ms", "us", "ns"] | None = None
    """Unit of numbers in it; by default the one that ends its name, else s."""


class Table(_Section):
    """A test rig's table, each row one steady state: where its quantities stand, with an example in test-rig.md.

    At least one of drawbar_pull, torque and sinkage must be mapped.  The soil bed is the same in all rows, or in those
    with the same value of the column `run`.
    """

    wheel_load: Column
    """Vertical load on the wheel [N]; a row without it is left out."""
    slip: Column
    """1 - V/(r omega), r the wheel's rolling radius; a row without it is left out."""
    drawbar_pull: Column | None = None
    """Net pull [N], positive forward; its noise is that of `draft`."""
    torque: Column | None = None
    """Torque about the axle [N m]."""
    sinkage: Column | None = None
    """Depth of the wheel's deepest point [m]."""
    t: Column | None = None
    """Time [s]; without it no effect of time is a candidate of a diagnosis."""
    run: Annotated[str, Field(min_length=1)] | None = None
    """Name of the column by which soil beds differ."""
    where: dict[str, Any] = Field(default_factory=dict)
    """Only rows that equal these values count."""

    @field_validator("where")
    @classmethod
    def _comparable(cls, value: dict[str, Any]) -> dict[str, Any]:
        for column, wanted in value.items():
            if isinstance(wanted, bool) or not isinstance(wanted, (str, int, float)):
                raise ValueError(f"{column} must be a text or a number")
        return value

    @model_validator(mode="after")
    def _tells_something(self) -> Table:
        if self.drawbar_pull is self.torque is self.sinkage is None:
            raise ValueError("map at least one of drawbar_pull, torque and sinkage: nothing to compare the model with")
        return self

    @property
    def columns(self) -> dict[str, Column]:
        """The mapped columns of numbers, by role."""
        roles = ("wheel_load", "slip", "drawbar_pull", "torque", "sinkage", "t")
        return {role: column for role in roles if (column := getattr(self, role)) is not None}


class Noise(_Section):
    """One channel's error: sd of each sample and sd of a gain fixed over a recording.

    The sd of a sample adds three parts in quadrature: `absolute` (the channel's SI
    unit), `relative` (of the reading), `of_mean` (of the window's mean magnitude).
    """

    absolute: NonNegativeFloat = 0.0
    """Sd of a sample in the channel's SI unit."""
    relative: Annotated[NonNegativeFloat, AfterValidator(SHARE)] = 0.0
    """Sd of a sample over its reading."""
    of_mean: Annotated[NonNegativeFloat, AfterValidator(SHARE)] = 0.0
    """Sd of a sample over the window's mean magnitude."""
    gain: Annotated[NonNegativeFloat, AfterValidator(SHARE)] = 0.0
    """Sd of the gain error that is fixed over a recording."""

    @model_validator(mode="after")
    def _not_perfect(self) -> Noise:
        if self.absolute + self.relative + self.of_mean == 0.0:
            raise ValueError("a sensor without any noise cannot be weighed: give absolute, relative or of_mean")
        return self


class NoiseOfChannels(_Section):
    """Noise of each channel; the defaults are those of a well-instrumented tractor."""

    torque: Noise = Noise(of_mean=0.02, gain=0.01)
    """[N m]."""
    load: Noise = Noise(relative=0.02, gain=0.01)
    """[N]."""
    speed: Noise = Noise(relative=0.003, gain=0.002)
    """[rad/s]."""
    ground_speed: Noise = Noise(relative=0.01, gain=0.003)
    """[m/s]."""
    draft: Noise = Noise(absolute=60.0, gain=0.01)
    """[N]."""
    sinkage: Noise = Noise(absolute=0.005)
    """[m]."""
    pitch: Noise = Noise(absolute=0.003)
    """[rad]."""
    acceleration: Noise = Noise(absolute=0.02)
    """[m/s^2]."""
    yaw_rate: Noise = Noise(absolute=0.01)
    """[rad/s]."""
    roll: Noise = Noise(absolute=0.005)
    """[rad]."""
    steering_angle: Noise = Noise(absolute=0.02)
    """[rad]."""
    computed_load: Noise = Noise(relative=0.12, gain=0.02)
    """Load that no cell measures: rms of what uneven ground adds to a wheel's load, over it, and the fixed error of the
    share left and right.  What mass, centre of gravity, pitch, acceleration and draft leave open comes besides.
    Dynamic wheel loads of tractors vary by 5 to 15 % of the static load on fields (the field vehicle's: 12 %)."""
    slip: Noise = Noise(absolute=0.005)
    """Of a table that holds slip itself; its gain is the relative error of 1 - slip."""

    @field_validator("sinkage", "pitch", "acceleration", "yaw_rate", "roll", "steering_angle")
    @classmethod
    def _without_gain(cls, noise: Noise) -> Noise:
        if noise.gain:
            raise ValueError("a fixed gain error of this sensor is not estimated: say it in absolute or relative")
        return noise

    def scaled(self, factor: float, *parts: str) -> NoiseOfChannels:
        """Return the noise with these parts (by default all) of each channel times a factor, which may be 0."""
        scaled = {}
        for name, noise in self:
            sizes = {part: factor * size for part, size in noise if part in parts or not parts}
            scaled[name] = noise.model_copy(update=sizes)
        return self.model_copy(update=scaled)


class Prior(_Section):
    """Prior of a soil parameter; std = 0 holds it at value."""

    value: NonNegativeFloat
    """Median of the prior."""
    std: NonNegativeFloat
    """Standard deviation; 0 holds the parameter."""

    @model_validator(mode="after")
    def _free_is_positive(self) -> Prior:
        if self.std > 0.0 and self.value == 0.0:
            raise ValueError("value must be above 0 unless std = 0 holds it")
        return self


def _prior(usual: Usual) -> AfterValidator:
    """Check of a prior: its value, if it has one, and its std must be ones that soils have."""

    def checked(prior: Prior) -> Prior:
        for key, value in (("value", prior.value), ("std", prior.std)):
            try:
                if value > 0.0 and (key == "value" or value > usual.high):
                    usual(value)
            except ValueError as error:
                raise ValueError(f"{key}: {error}") from None
        return prior

    return AfterValidator(checked)


class SoilPrior(_Section):
    """Prior of each soil parameter (SI, phi in rad), for tilled soils of all textures.

    `soilbus check` names the known soils outside of it: stiff clays of 69 kPa, for one.
    A free parameter's prior is log-normal with median `value`; std/value is its
    coefficient of variation.
    """

    k_c: Annotated[Prior, _prior(MODULUS_C)] = Prior(value=6.0e3, std=1.2e4)
    """Cohesive modulus [N/m^(n+1)]."""
    k_phi: Annotated[Prior, _prior(MODULUS_PHI)] = Prior(value=8.0e5, std=1.4e6)
    """Frictional modulus [N/m^(n+2)]."""
    n: Annotated[Prior, _prior(EXPONENT)] = Prior(value=0.6, std=0.4)
    """Sinkage exponent."""
    phi: Annotated[Prior, _prior(ANGLE)] = Prior(value=0.40, std=0.20)
    """Angle of internal friction [rad]."""
    c: Annotated[Prior, _prior(COHESION)] = Prior(value=3.0e3, std=2.0e3)
    """Cohesion [Pa]."""
    K: Annotated[Prior, _prior(SHEAR_LENGTH)] = Prior(value=0.02, std=0.01)
    """Shear deformation modulus [m]."""

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, value: Any) -> Any:
        """What one key of a parameter leaves open keeps its default."""
        if not isinstance(value, Mapping):
            return value
        defaults = {name: field.default for name, field in cls.model_fields.items()}
        return {
            name: {**defaults[name].model_dump(), **prior} if name in defaults and isinstance(prior, Mapping) else prior
            for name, prior in value.items()
        }


class Estimator(_Section):
    """Window estimation; times s, speeds m/s, lengths m."""

    window: Annotated[PositiveFloat, AfterValidator(WINDOW)] = 10.0
    """Length of a window [s]."""
    hop: PositiveFloat = 1.0
    """From the end of one window to the next [s]."""
    soil_drift: NonNegativeFloat = 0.015
    """How far the soil may wander in the time of one window, as sd of a relative change."""
    bin: PositiveFloat = 0.1
    """Samples are averaged over bins of this length [s].  The watch follows bins, the fit averages them over 0.25 s, or
    0.5 s where loads are computed.  By default 0.04 s where wheels share a torque behind an open or limited
    differential: there slip changes with the load at 1.5 to 3 Hz, and torque at a mean slip is not the mean torque."""
    min_speed: PositiveFloat = 0.2
    """Below it slip is not judged (standstill gate)."""
    max_turn: PositiveFloat = 0.15
    """Relative difference of speeds left and right in a turn above which slip is not judged (turn gate)."""
    max_lateral: PositiveFloat = 0.3
    """Lateral over longitudinal sliding speed of the wheels of a vehicle that steers by skidding, above which slip is
    not judged; at 0.3 the shear along the wheel is 4 % less than all of it."""
    z_ref: PositiveFloat = 0.02
    """Depth of the reported bearing pressure [m]."""
    b_ref: PositiveFloat = 0.3
    """Plate width of the reported bearing pressure [m]."""
    max_bearing_std: PositiveFloat = 0.10
    """Relative std of the bearing pressure up to which a window is valid; at z_ref, or the nearest depth that carries
    load."""
    max_draft_std: PositiveFloat = 0.25
    """Std of the largest draft up to which a window of a vehicle is valid, as a share of this draft, or of a tenth of
    the weight where that is more."""
    max_tan_phi_std: PositiveFloat = 0.15
    """Relative std of tan phi, or of the strength c + p tan phi at the contact's pressure p, up to which a window of a
    test rig is valid, and up to which the warning uses the soil's strength."""
    max_prediction_error: PositiveFloat = 0.25
    """Error of the torque or pull that the model predicts for unseen data, as a share of them, above which a window is
    `model_mismatch`."""
    max_gain_error: PositiveFloat = 6.0
    """Gain error of a sensor, in sd of its configured gain, above which a window is `model_mismatch`: sound multibody
    drives end at 5.3, those with a wrong weight or draft reach 9 to 20."""
    search_rate: NonNegativeFloat = 4.0
    """Evaluations of the model on a whole window that a search for another soil may take in each window.  Windows that
    the model describes take 1 to 3 in all."""
    search_burst: PositiveFloat = 100.0
    """Evaluations that are kept for later at most: three times what nine of ten searches at starts and borders take."""

    @model_validator(mode="after")
    def _lengths_fit(self) -> Estimator:
        if not self.bin <= self.hop <= self.window:
            raise ValueError("bin <= hop <= window must hold")
        return self


class Traversability(_Section):
    """Thresholds of go and no_go; draft N, slopes rad."""

    max_slip: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.6
    """Slip that no driven wheel may pass; the largest draft is sought up to it."""
    max_sinkage: PositiveFloat = 0.25
    """Sinkage [m] that no wheel may pass: ground clearance."""
    margin: NonNegativeFloat = 0.15
    """Share of the present demand that must be left over."""
    go: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.95
    """Probability from which the state is go."""
    no_go: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.50
    """Probability below which the state is no_go."""
    hysteresis: NonNegativeFloat = 0.25
    """Standard deviations by which a better state must pass its threshold."""
    hold: PositiveInt = 2
    """Windows in a row that must speak for a better state."""
    max_age: PositiveFloat = 3.0
    """Age [s] of its last instant from which a posterior no longer supports go."""
    min_share: Annotated[float, Field(gt=0.0, le=1.0)] = 0.15
    """Share of a window that must be measured on the present ground: since it changed, since a wheel last spun."""
    spin_time: PositiveFloat = 0.4
    """Time [s] for which a wheel beyond max_slip, or thrust that moves nothing, ends go: by means over 0.3 s within one
    second."""
    stuck_time: PositiveFloat = 1.2
    """Time [s] without way under thrust from which a vehicle is stuck; no start takes as long to show."""
    standstill: PositiveFloat = 0.05
    """Rim speed [m/s] below which a wheel does not turn: two impulses a second of 100 teeth at 0.5 m."""
    stall_resistance: PositiveFloat = 0.15
    """Thrust beyond draft, slope and inertia, as a share of the weight, from which a vehicle whose wheels do not turn
    stalls: more than an idling drive gives, less than wheels need on loam (0.2)."""
    contradiction: PositiveFloat = 3.0
    """Standard deviations by which wheels that pull less than predicted at their slip contradict the estimate."""
    full_torque: Annotated[float, Field(gt=0.0, le=1.0)] = 0.95
    """Share of its torque limit from which a motor gives all it can: ripple and gain error of its sensor."""

    @model_validator(mode="after")
    def _ordered(self) -> Traversability:
        if self.no_go >= self.go:
            raise ValueError("no_go must be less than go")
        return self


class Warning(_Section):
    """Warning of immobilisation from slip and speed alone, without any estimate of the soil.

    Tuned on six measured immobilisations of a 90 kg rover on snow (A. Lines, PhD thesis, 2023, ch. 7), with eleven
    others looked at: `python -m tests.lab.snow`.
    """

    slip_horizon: PositiveFloat = 1.0
    """Slip that is to pass `traversability.max_slip` within this time [s] warns."""
    stop_horizon: PositiveFloat = 1.5
    """A vehicle that is to stand within this time [s], while thrust holds and wheels slip, warns."""
    steady_horizon: PositiveFloat = 3.0
    """The same time [s] by the steady trend of its speed."""
    probability: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.7
    """Probability of either from which it warns."""
    least_slip: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.25
    """Slip below which a vehicle that loses speed is only slowed down."""
    least_thrust: NonNegativeFloat = 0.03
    """Thrust, as a share of the weight, from which wheels drive the vehicle: rolling resistance on a road is less
    (0.02, Wong 2008, table 1.3)."""
    thrust_held: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    """Share of its mean over `thrust_time` that thrust keeps where the ground, not the driver, stops the vehicle."""
    thrust_time: PositiveFloat = 1.0
    """Time constant [s] of that mean."""
    slip_noise: PositiveFloat = 0.02
    """Sd of slip by uneven ground from bin to bin, beside the sensors' noise."""
    slip_wander: PositiveFloat = 0.3
    """How fast the rate of the log speed ratio changes [1/s per sqrt(s)]."""
    speed_wander: PositiveFloat = 1.0
    """How fast the acceleration changes [m/s^2 per sqrt(s)]."""
    steady_wander: PositiveFloat = 0.2
    """The same of the steady trend."""
    depth_wander: PositiveFloat = 0.05
    """How fast the rate of sinkage changes [m/s per sqrt(s)]: ruts deepen by centimetres a second.  No evidence
    recorded."""
    settling_time: NonNegativeFloat = 1.0
    """Time [s] for which the vehicle must have moved: the trends of a start are not those of driving."""
    hold: PositiveFloat = 1.0
    """Time [s] after its last cause at which the warning ends."""


class Effect(BaseModel):
    """A physical effect of the catalogue with its parameters."""

    model_config = ConfigDict(extra="allow", frozen=True)
    name: str
    """As in the catalogue (effects.md); further keys are its parameters, each a number or `{ value, std }`."""


class Form(_Section):
    """Largest difference in form between the contact of wheel and soil and the model; 0: none.

    The greatest stress sits at (c1 + c2 s) of the entry angle, where the model has 0.5: c1 is 0.18 in loose and
    0.43 in compact sand, c2 0.32 in both (Wong & Reece 1967, J. Terramechanics 4:81).  Every form from the model's to
    the farthest is as likely as any other before a window's data.
    """

    peak: NonNegativeFloat = 0.32
    """How much less c1 may be than 0.5."""
    peak_by_slip: NonNegativeFloat = 0.32
    """How large c2 may be."""
    exit: NonNegativeFloat = 0.17
    """How large the exit angle behind the axle may be, over the entry angle: a rut that springs back by 3 %."""
    shear: NonNegativeFloat = 1.0
    """Share of the strength that the other shear law may mobilise: all of it or none, equally likely."""


class Model(_Section):
    """The wheel-soil model: base choices and added effects."""

    shear_law: Literal["exponential", "rational"] = "exponential"
    """Janosi-Hanamoto, or the rational law of Xi et al. 2024."""
    effects: list[Effect] = Field(default_factory=list)
    """Of the catalogue, as `diagnose --model-out` writes them."""
    form: Form = Form()


class Output(_Section):
    """Layout of our frames, and classes of the soil map."""

    dbc: str = "soilbus.dbc"
    """Layout of our own frames."""
    compaction: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = Field(default=(5.0e4, 1.0e5, 2.0e5), strict=False)
    """Bearing pressures [Pa] from which soil is slightly compacted, compacted, very compacted: codes 2, 3, 4 of DDI 470
    in `replay --isoxml`.  Such ground carries a tyre inflated to 0.5, 1, 2 bar with a rut of at most `estimator.z_ref`
    (Wong 2008, ch. 2)."""

    @field_validator("compaction")
    @classmethod
    def _rising(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not value[0] < value[1] < value[2]:
            raise ValueError("the three pressures must rise")
        return value


class J1939(_Section):
    """Our source address and NAME (SAE J1939-81, ISO 11783-5); the claim concerns `soilbus run` only.

    Without a claim frames carry the address of the DBC.  With one nothing is sent before the address is claimed, nor
    after a node with a smaller NAME has taken it.
    """

    address_claim: bool = False
    """Claim the address before anything is sent (extra `j1939`)."""
    address: Annotated[int, Field(ge=128, le=247)] | None = None
    """Source address of our frames, in the range of those that are claimed; by default that of `output.dbc`."""
    identity_number: Annotated[int, Field(ge=0, lt=2**21)] = 0
    """Serial number; two of the same NAME cannot live on one bus."""
    manufacturer_code: Annotated[int, Field(ge=0, lt=2**11)] = 0x7FF
    """Of the vehicle's maker, as SAE assigns it; by default not available."""
    ecu_instance: Annotated[int, Field(ge=0, lt=2**3)] = 0
    """Of several ECUs that do one function."""
    function_instance: Annotated[int, Field(ge=0, lt=2**5)] = 0
    """Of several units of one function."""
    function: Annotated[int, Field(ge=0, lt=2**8)] = 0xFF
    """By default not available."""
    device_class: Annotated[int, Field(ge=0, lt=2**7)] = 17
    """17: sensor system."""
    device_class_instance: Annotated[int, Field(ge=0, lt=2**4)] = 0
    """Of several of one class."""
    industry_group: Annotated[int, Field(ge=0, lt=2**3)] = 2
    """2: agriculture and forestry."""


class Config(_Section):
    """The whole configuration."""

    bus: Bus = Bus()
    dbc: Dbc = Dbc()
    vehicle: Vehicle | None = None
    axle: list[Axle] = Field(default_factory=list, max_length=9)
    wheel: list[Wheel] = Field(default_factory=list, max_length=8)
    track: list[Track] = Field(default_factory=list, max_length=4)
    signals: Signals = Signals()
    columns: Columns | None = None
    table: Table | None = None
    noise: NoiseOfChannels = NoiseOfChannels()
    soil: SoilPrior = SoilPrior()
    estimator: Estimator = Estimator()
    traversability: Traversability = Traversability()
    warning: Warning = Warning()
    model: Model = Model()
    output: Output = Output()
    j1939: J1939 = J1939()
    folder: Path = Field(default=Path("."), exclude=True)
    log_channel: str | None = Field(default=None, exclude=True)
    """The channel that --channel demands of logs; None: bus.channel, where a log has it."""

    @model_validator(mode="before")
    @classmethod
    def _vehicle_on_one_axle(cls, value: Any) -> Any:
        """What follows for [vehicle] from tracks, or from the wheels of a single axle, that carry all of it."""
        if not isinstance(value, Mapping) or not isinstance(value.get("vehicle"), Mapping):
            return value
        wheels, tracks = (
            [part for part in (given if isinstance(given, list) else [given]) if isinstance(part, Mapping)]
            for given in (value.get("wheel"), value.get("track"))
        )
        names = {str(wheel.get("axle", "front")) for wheel in wheels}
        if wheels and len(names) == 1 and not tracks and not names & {"front", "middle", "rear"}:
            key, size, steering = "radius", 2.0, "wheels"
        elif tracks and not wheels and any("axle" not in track for track in tracks):
            key, size, steering = "contact_length", 1.0, "skid"
        else:
            return value
        lengths = [size * part[key] for part in (*wheels, *tracks) if type(part.get(key)) in (int, float)]
        usual = [length for length in lengths if WHEELBASE.low <= length <= WHEELBASE.high]
        length = usual[0] if usual else WHEELBASE.high  # then the fault is that of the wheel or track alone
        defaults = {"wheelbase": length, "steering": steering, "cg_ahead_of_rear_axle": length / 2.0}
        return {**value, "vehicle": defaults | dict(value["vehicle"])}

    @model_validator(mode="before")
    @classmethod
    def _one_axle_of_a_name(cls, value: Any) -> Any:
        """[[axle]]s of one name that share no other key as one: a motor, and a load cell that stands apart."""
        axles = value.get("axle") if isinstance(value, Mapping) else None
        if not isinstance(axles, list) or not all(isinstance(axle, Mapping) for axle in axles):
            return value
        merged: list[Mapping[str, Any]] = []
        for axle in axles:
            for i, known in enumerate(merged):
                if known.get("name") == axle.get("name") and known.keys() & axle.keys() == {"name"}:
                    merged[i] = {**known, **axle}
                    break
            else:
                merged.append(axle)
        return {**value, "axle": merged}

    @model_validator(mode="after")
    def _tracks_as_wheels(self) -> Config:
        """`wheel` holds the tracks, too, behind the wheels: all that runs on the ground."""
        if self.track and (self.wheel or len(self.track) == 1) and any(t.axle is None for t in self.track):
            raise ValueError("a [[track]] beside [[wheel]]s, or alone, needs its axle")
        if len({t.rollers for t in self.track}) > 1:
            raise ValueError("[[track]]s of a vehicle need the same number of rollers: contact_length / roller_spacing")
        if len({t.axle is None for t in self.track}) > 1:
            raise ValueError("give the axle of all [[track]]s or, where they carry the whole vehicle, of none")
        object.__setattr__(self, "wheel", [*self.wheel, *(t.as_wheel() for t in self.track)])
        return self

    @property
    def rollers(self) -> int:
        """Periods of the pressure along each track's contact; 0: uniform."""
        return self.track[0].rollers if self.track else 0

    @property
    def tows_nothing(self) -> bool:
        """Whether nothing is ever towed."""
        return self.vehicle is not None and self.vehicle.towing == "never"

    @property
    def measures_draft(self) -> bool:
        """Whether a sensor shows all that is towed."""
        return self.signals.draft is not None and (self.vehicle is None or self.vehicle.towing != "unknown")

    @property
    def axles(self) -> dict[str, float]:
        """Axles that have wheels or tracks, front to rear, and how far ahead of the last one, over the wheelbase."""
        of_wheels = [w.axle for w in self.wheel if w.axle is not None]
        names = [name for name in dict.fromkeys([*(a.name for a in self.axle), *of_wheels]) if name in of_wheels]
        names.sort(key=lambda name: (name == "rear") - (name == "front"))
        if len(names) == 1:
            return {name: float(name != "rear") for name in names}
        length = WHEELBASE.high if self.vehicle is None else self.vehicle.wheelbase
        given = {a.name: a.ahead_of_rear_axle / length for a in self.axle if a.ahead_of_rear_axle is not None}
        return {name: given.get(name, 1.0 - i / (len(names) - 1)) for i, name in enumerate(names)}

    @property
    def on_one_axle(self) -> bool:
        """Whether tracks, or the wheels of a single axle of its own name, carry the whole vehicle."""
        is_whole = bool(self.track) and all(t.axle is None for t in self.track)
        return is_whole or (len(self.axles) == 1 and not self.axles.keys() & {"front", "middle", "rear"})

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        names = [w.name for w in self.wheel]
        for name in {n for n in names if names.count(n) > 1}:
            raise ValueError(f"two {'tracks' if name in [t.name for t in self.track] else 'wheels'} are named {name}")
        if len(self.wheel) > 1 and self.vehicle is None:
            raise ValueError("several wheels need a [vehicle]")
        if self.columns is not None and (self.dbc.input or self.table is not None):
            other = "dbc.input" if self.dbc.input else "[table]"
            raise ValueError(f"[columns] and {other} are two sources of the same signals: leave out one of the two")
        if self.table is not None and (self.vehicle is not None or len(self.wheel) != 1):
            raise ValueError("[table] is of a test rig: exactly one [[wheel]] and no [vehicle]")
        for w in self.wheel:
            if w.axle is None and self.table is None:
                raise ValueError(f"wheel {w.name}: axle: missing")
        for fault in self._faults_of_axles():
            raise ValueError(fault)
        if self.tows_nothing and self.signals.draft is not None:
            raise ValueError("vehicle.towing = never, but signals.draft is mapped: leave out one of the two")
        return self

    def _faults_of_axles(self) -> Iterator[str]:
        """A line for each axle that does not go with its wheels, and for each torque that would count twice."""
        named = list(dict.fromkeys(["front", "middle", "rear", *(a.name for a in self.axle if a.name != "both")]))
        for w in self.wheel:
            if w.axle is not None and w.axle not in named:
                meant = did_you_mean(w.axle, named) or "; an axle of another name needs an [[axle]]"
                yield f'{w.section}.{w.name}.axle: "{w.axle}" is not one of {", ".join(named)}{meant}'
        yield from self._faults_of_places()
        for axle in self.axle:
            if sum(a.name == axle.name for a in self.axle) > 1:
                yield f"two axles are named {axle.name}"
            wheels = [w for w in self.wheel if axle.name in ("both", w.axle)]
            if not wheels:
                yield f"axle {axle.name} has no [[wheel]]"
            of_motor = ("torque", "torque_limit", "max_torque", "motor_speed")
            given = [role for role in of_motor if getattr(axle, role) is not None]
            if wheels and given and not any(w.driven for w in wheels):
                yield f"axle {axle.name} has a {given[0]}, but each of its wheels has driven = false"
            if axle.torque is None:
                continue
            own = [f"wheel.{w.name}" for w in wheels if w.torque is not None]
            own += [f"axle.{a.name}" for a in self.axle if axle.name == "both" != a.name and a.torque is not None]
            if own:
                yield f"axle.{axle.name}.torque and {own[0]}.torque are the same torque: leave out one of the two"

    def _faults_of_places(self) -> Iterator[str]:
        """A line for each axle whose place along the vehicle is missing or out of order."""
        (*before, _), places = ("", *self.axles), list(self.axles.values())
        between = before[2:]
        given = [axle for axle in self.axle if axle.ahead_of_rear_axle is not None]
        for axle in given:
            if axle.name not in between:
                yield f"axle {axle.name}: ahead_of_rear_axle is for axles between the first and the last one"
        if missing := [name for name in between if given and name not in {axle.name for axle in given}]:
            yield f"axle {missing[0]}: ahead_of_rear_axle: missing; give it of each axle between the first and last"
        if any(ahead <= behind for ahead, behind in pairwise(places)):
            order = "must stand from the front to the rear, as their [[axle]] tables do"
            yield f"the axles {', '.join(self.axles)} {order}: ahead_of_rear_axle must fall from vehicle.wheelbase to 0"

    @model_validator(mode="after")
    def _bins_of_differentials(self) -> Config:
        """The default of `estimator.bin` behind differentials."""
        shared = any(axle.torque is not None and axle.differential != "locked" for axle in self.axle)
        shared |= any(len(wheels) > 1 for wheels in self.same_signal("torque"))
        if shared and "bin" not in self.estimator.model_fields_set:
            object.__setattr__(self, "estimator", self.estimator.model_copy(update={"bin": SHORT_BIN}))
        return self

    def axle_named(self, name: str | None) -> Axle | None:
        """Return the [[axle]] of this name; None without."""
        return next((axle for axle in self.axle if axle.name == name), None)

    def same_signal(self, role: str) -> list[list[Wheel]]:
        """Return the wheels that have a role (torque, speed, load), those on the same signal together."""
        mapped = [wheel for wheel in self.wheel if getattr(wheel, role) is not None]
        return list(grouped(mapped, lambda wheel: getattr(wheel, role).signal).values())

    @property
    def soil_prior(self) -> dict[str, Prior]:
        """Prior by parameter name, in the order k_c, k_phi, n, phi, c, K."""
        return {name: getattr(self.soil, name) for name in SoilPrior.model_fields}
