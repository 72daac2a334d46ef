"""Faults that the configuration's model finds -> lines in the words of the configuration file.

pydantic does the checks; its messages ("valid dictionary or instance of Noise") name Python types, so each type of
error has a sentence of ours with the dotted key. A type without one says only that the value cannot be used.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ValidationError
from pydantic.fields import FieldInfo

from soilbus.config.model import Config, Usual
from soilbus.words import did_you_mean, shown

OPEN = "?"
"""A value that nobody has filled in yet, as `soilbus init` writes it."""
MAX_SHOWN_CHARACTERS = 40  # of a wrong value that a line repeats


def fault_lines(raw: Mapping[str, Any], error: ValidationError) -> list[str]:
    """Return one line for each fault: the dotted key, wheels and effects by name, and what is wrong."""
    lines = []
    for each in error.errors(include_url=False):
        where = ".".join(_named(raw, each["loc"]))
        lines += [f"{where}: {text}" if where else text for text in _text(each).split("\n")]
    return lines


def open_lines(raw: Mapping[str, Any]) -> list[str]:
    """Return one line for each open value: its dotted key and what belongs there."""

    def walk(here: Any, location: tuple[Any, ...]) -> Iterator[str]:
        if here == OPEN:
            yield f'{".".join(_named(raw, location))}: still open: put {_wanted(location)} in place of "{OPEN}"'
        elif isinstance(here, (Mapping, list)):
            for key, value in here.items() if isinstance(here, Mapping) else enumerate(here):
                yield from walk(value, (*location, key))

    return list(walk(raw, ()))


def _wanted(location: Sequence[Any]) -> str:
    """What belongs at a place, in words."""
    field = _field_at(location)
    if field is None:
        return "its value"
    if choices := _choices(location):
        return f"one of {', '.join(map(str, choices))}"
    kinds = _parts(field.annotation)
    if any(_is_model(kind) and "signal" in kind.model_fields for kind in kinds):
        return '"Message.Signal"'
    if bool in kinds:
        return "true or false"
    for check in (m.func for m in field.metadata if isinstance(m, AfterValidator)):
        if isinstance(check, Usual):
            return f"a number from {check.low:g} to {check.high:g} {check.unit}".rstrip()
    return "a number" if float in kinds else "its value"


def _text(error: Any) -> str:
    kind, given, context = error["type"], error.get("input"), error.get("ctx", {})
    if kind == "value_error":
        return str(error["msg"]).removeprefix("Value error, ")
    if kind == "extra_forbidden":
        return _unknown_key(error["loc"])
    if kind == "literal_error":
        known = _choices(error["loc"])
        return f"{_shown(given)} is not one of {', '.join(map(str, known))}{did_you_mean(str(given), map(str, known))}"
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return _table_wanted(error["loc"], given)
    if kind in ("list_type", "tuple_type"):
        return _list_wanted(error["loc"], given)
    sentence = _SENTENCES.get(kind)
    return f"{_shown(given)} cannot be used here" if sentence is None else sentence(given, context)


def _unknown_key(location: Sequence[Any]) -> str:
    """Where the key belongs, if it is one of another section of the machine, or else which one was meant."""
    if tuple(location) in _GONE:
        return f"is gone: {_GONE[tuple(location)]}"
    key = str(location[-1])
    tables = [name for name in _OF_MACHINE if key in _keys((name,))]
    places = [f"[[{name}]]" if name in _REPEATED else f"[{name}]" for name in tables]
    if places:
        return f"unknown key here; it belongs in {' or '.join(places)}"
    return f"unknown key{did_you_mean(key, _keys(location[:-1]))}"


_GONE: Mapping[tuple[Any, ...], str] = {
    ("estimator", "max_chi2"): (
        "chi-square judges no window any more: remove it; max_prediction_error, a share of torque and pull, judges now"
    ),
    ("estimator", "min_track_load_change"): "windows at a constant load are judged by their widths: remove it",
    ("mqtt",): "the service holds no connection to a network: remove this section; soilbus watch --json prints the"
    " results for mosquitto_pub -l (soilbus docs systemd)",
}
"""Keys that earlier versions had, and what to write instead."""
_REPEATED = ("axle", "wheel", "track")
_OF_MACHINE = ("vehicle", *_REPEATED, "signals")


def _number(given: Any, _: Mapping[str, Any]) -> str:
    hint = ""
    if isinstance(given, str):
        with suppress(ValueError):
            hint = f"; write {float(given):g}, without quotes"
    return f"{_shown(given)} is not a number{hint}"


_SENTENCES: Mapping[str, Callable[[Any, Mapping[str, Any]], str]] = {
    **dict.fromkeys(("float_type", "float_parsing"), _number),
    **dict.fromkeys(
        ("int_type", "int_parsing", "int_from_float", "int_parsing_size"),
        lambda given, _: f"{_shown(given)} is not a whole number",
    ),
    "missing": lambda given, _: "missing",
    "string_pattern_mismatch": lambda given, _: f"{_shown(given)} is no name: 1 to 16 letters, digits, - or _",
    "finite_number": lambda given, _: f"{given} is not a number that counts",
    "greater_than": lambda given, c: f"{_shown(given)} is not above {c['gt']:g}",
    "greater_than_equal": lambda given, c: f"{_shown(given)} is less than {c['ge']:g}",
    "less_than": lambda given, c: f"{_shown(given)} is not less than {c['lt']:g}",
    "less_than_equal": lambda given, c: f"{_shown(given)} is more than {c['le']:g}",
    "string_type": lambda given, _: f"{_shown(given)} is not a text in quotes",
    "string_too_short": lambda given, _: "an empty text names nothing",
    "too_long": lambda given, c: f"{c['actual_length']} are too many; at most {c['max_length']}",
    **dict.fromkeys(("bool_type", "bool_parsing"), lambda given, _: f"{_shown(given)} is neither true nor false"),
}


def _table_wanted(location: Sequence[Any], given: Any) -> str:
    model = _model_at(location)
    keys = list(model.model_fields) if model is not None else []
    if "signal" in keys:
        return f'{_shown(given)} is not "Message.Signal", nor a table with {", ".join(keys)}'
    example = f"; write it as a table with any of {', '.join(keys)}" if keys else ""
    return f"{_shown(given)} is a single value{example}"


def _list_wanted(location: Sequence[Any], given: Any) -> str:
    key = location[-1]
    if key in _REPEATED:
        return f"write [[{key}]], in two brackets, once for each {key}"
    if key == "effects" or isinstance(given, Mapping):
        return f'{_shown(given)} is not a list of tables, such as {key} = [{{ name = "..." }}]'
    return f"{_shown(given)} is not a list, such as {key} = [{_shown(given)}]"


def _shown(given: Any) -> str:
    if isinstance(given, Mapping):
        return "a table"
    if isinstance(given, bool):
        return str(given).lower()
    return shown(f'"{given}"' if isinstance(given, str) else given, MAX_SHOWN_CHARACTERS)


def _named(raw: Any, location: Sequence[Any]) -> list[str]:
    """The steps of a location as they are written in the file: list items by name, else counted from 1."""
    steps, here = list[str](), raw
    for part in location:
        try:
            here = here[part]
        except (KeyError, IndexError, TypeError):
            here = None
        if isinstance(part, int):
            name = here.get("name") if isinstance(here, Mapping) else None
            steps.append(name if isinstance(name, str) and name else f"number {part + 1}")
        else:
            steps.append(str(part))
    return steps


def _keys(location: Sequence[Any]) -> list[str]:
    """The keys that the table at this location may have."""
    model = _model_at(location)
    return [] if model is None else [key for key in model.model_fields if not model.model_fields[key].exclude]


def _choices(location: Sequence[Any]) -> list[Any]:
    """The values that the key at this location may have."""
    field = _field_at(location)
    kinds = [] if field is None else _parts(field.annotation)
    return [value for kind in kinds if get_origin(kind) is Literal for value in get_args(kind)]


def _field_at(location: Sequence[Any]) -> FieldInfo | None:
    """The field of the key at this location; None where there is no such key."""
    model = _model_at(location[:-1])
    return None if model is None else model.model_fields.get(str(location[-1]))


def _model_at(location: Sequence[Any]) -> type[BaseModel] | None:
    """The model of the table at this location of the configuration."""
    names = [part for part in location if not isinstance(part, int)]
    if not names:
        return Config
    field = _field_at(names)
    return next(filter(_is_model, _parts(field.annotation)), None) if field is not None else None


def _parts(kind: Any) -> list[Any]:
    """The kinds that a type is made of: X of X | None, of list[X]."""
    if get_origin(kind) in (Union, types.UnionType, list):
        return [part for argument in get_args(kind) for part in _parts(argument)]
    return [kind]


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
