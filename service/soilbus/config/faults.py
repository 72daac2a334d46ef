"""Faults that the configuration's model finds -> lines in the words of the configuration file.

pydantic does the checks; its messages ("valid dictionary or instance of Noise") name Python types, so each type of
error has a sentence of ours with the dotted key. A type without one says only that the value cannot be used.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ValidationError

from soilbus.config.model import Config, Usual
from soilbus.words import did_you_mean

OPEN = "?"
"""A value that nobody has filled in yet, as `soilbus init` writes it."""
MAX_SHOWN_CHARACTERS = 40
"""Characters of a wrong value that a line repeats."""


def fault_lines(raw: Mapping[str, Any], error: ValidationError) -> list[str]:
    """Return one line for each fault: the dotted key, wheels and effects by name, and what is wrong."""
    return [line for e in error.errors(include_url=False) for line in _lines(raw, e)]


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
    model = _model_at(location[:-1])
    field = model.model_fields.get(str(location[-1])) if model is not None else None
    if field is None:
        return "its value"
    if choices := _choices(location):
        return f"one of {', '.join(map(str, choices))}"
    if any(_is_model(kind) and "signal" in kind.model_fields for kind in _parts(field.annotation)):
        return '"Message.Signal"'
    if bool in _parts(field.annotation):
        return "true or false"
    known = [m.func for m in field.metadata if isinstance(m, AfterValidator) and isinstance(m.func, Usual)]
    if known:
        unit = f" {known[0].unit}" if known[0].unit else ""
        return f"a number from {known[0].low:g} to {known[0].high:g}{unit}"
    return "a number" if float in _parts(field.annotation) else "its value"


def _lines(raw: Mapping[str, Any], error: Any) -> Iterator[str]:
    where = ".".join(_named(raw, error["loc"]))
    for text in _text(error).split("\n"):
        yield f"{where}: {text}" if where else text


def _text(error: Any) -> str:
    kind, given, context = error["type"], error.get("input"), error.get("ctx", {})
    if kind == "value_error":
        return str(error["msg"]).removeprefix("Value error, ")
    if kind == "extra_forbidden":
        return _unknown_key(error["loc"])
    if kind == "missing":
        return "missing"
    if kind == "string_pattern_mismatch":
        return f"{_shown(given)} is no name: 1 to 16 letters, digits, - or _"
    if kind == "literal_error":
        known = _choices(error["loc"])
        return f"{_shown(given)} is not one of {', '.join(map(str, known))}{did_you_mean(str(given), map(str, known))}"
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return _table_wanted(error["loc"], given)
    if kind in ("list_type", "tuple_type"):
        return _list_wanted(error["loc"], given)
    sentence = _SENTENCES.get(kind)
    return sentence(given, context) if sentence is not None else f"{_shown(given)} cannot be used here"


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
    ("mqtt",): (
        "the service holds no connection to a network: remove this section; soilbus watch --json prints the results"
        " for mosquitto_pub -l (soilbus docs systemd)"
    ),
}
"""Keys that earlier versions had, and what to write instead."""
_REPEATED = ("axle", "wheel", "track")
_OF_MACHINE = ("vehicle", *_REPEATED, "signals")


def _number(given: Any, _: Mapping[str, Any]) -> str:
    hint = f"; write {float(given):g}, without quotes" if isinstance(given, str) and _is_number(given) else ""
    return f"{_shown(given)} is not a number{hint}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


_SENTENCES: Mapping[str, Callable[[Any, Mapping[str, Any]], str]] = {
    **dict.fromkeys(("float_type", "float_parsing"), _number),
    **dict.fromkeys(
        ("int_type", "int_parsing", "int_from_float", "int_parsing_size"),
        lambda given, _: f"{_shown(given)} is not a whole number",
    ),
    "finite_number": lambda given, _: f"{given} is not a number that counts",
    "greater_than": lambda given, c: f"{_shown(given)} is not above {c['gt']:g}",
    "greater_than_equal": lambda given, c: f"{_shown(given)} is less than {c['ge']:g}",
    "less_than": lambda given, c: f"{_shown(given)} is not less than {c['lt']:g}",
    "less_than_equal": lambda given, c: f"{_shown(given)} is more than {c['le']:g}",
    "string_type": lambda given, _: f"{_shown(given)} is not a text in quotes",
    "string_too_short": lambda given, _: "an empty text names nothing",
    "too_long": lambda given, c: f"{c['actual_length']} are too many; at most {c['max_length']}",
    "bool_type": lambda given, _: f"{_shown(given)} is neither true nor false",
    "bool_parsing": lambda given, _: f"{_shown(given)} is neither true nor false",
}


def _table_wanted(location: Sequence[Any], given: Any) -> str:
    model = _model_at(location)
    keys = ", ".join(model.model_fields) if model is not None else ""
    if model is not None and "signal" in model.model_fields:
        return f'{_shown(given)} is not "Message.Signal", nor a table with {keys}'
    example = f"; write it as a table with any of {keys}" if keys else ""
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
    text = f'"{given}"' if isinstance(given, str) else str(given)
    return text if len(text) <= MAX_SHOWN_CHARACTERS else text[: MAX_SHOWN_CHARACTERS - 3] + "..."


def _named(raw: Any, location: Sequence[Any]) -> list[str]:
    """The steps of a location as they are written in the file: list items by name, else counted from 1."""
    steps: list[str] = []
    here = raw
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
    model = _model_at(location[:-1])
    field = model.model_fields.get(str(location[-1])) if model is not None else None
    return (
        []
        if field is None
        else [v for kind in _parts(field.annotation) if get_origin(kind) is Literal for v in get_args(kind)]
    )


def _model_at(location: Sequence[Any]) -> type[BaseModel] | None:
    """The model of the table at this location of the configuration."""
    model: type[BaseModel] | None = Config
    for part in location:
        if isinstance(part, int):
            continue
        field = model.model_fields.get(part) if model is not None else None
        found = [] if field is None else [kind for kind in _parts(field.annotation) if _is_model(kind)]
        model = found[0] if found else None
    return model


def _parts(kind: Any) -> list[Any]:
    """The kinds that a type is made of: X of X | None, of list[X]."""
    if get_origin(kind) in (Union, types.UnionType, list):
        return [part for argument in get_args(kind) for part in _parts(argument)]
    return [kind]


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
