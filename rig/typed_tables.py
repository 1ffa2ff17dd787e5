"""Converts tables of decoded JSON or TOML to dataclasses, and reports every unknown key and wrong value."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, get_args

from rig.errors import InputError
from rig.messages.message import Message, compose
from rig.text import is_encodable, suggest

T = TypeVar("T")


def read_table(kind: type[T], document: Mapping[str, Any], subject: str) -> T:
    """Converts decoded JSON or TOML to the dataclass ``kind``. Raises an InputError that names every fault."""
    faults: list[Message] = []
    found = read_fields(kind, document, "", faults)
    if faults:
        raise InputError(subject, faults)
    return found


def read_fields(kind: type[T], document: Any, where: str, faults: list[Message]) -> T:
    """Converts decoded JSON or TOML to the dataclass ``kind``. A missing or wrong value becomes the field's default, or
    an ellipsis without a default. Faults are added to ``faults``, with ``where`` before the name of the key."""
    if not isinstance(document, Mapping):
        faults.append(compose("setting-no-object", where=where.rstrip(".") or "settings"))
        return typing.cast(T, ...)
    types = typing.get_type_hints(kind)
    fields = dataclasses.fields(typing.cast(Any, kind))
    hints = {field.name: types[field.name] for field in fields if field.metadata.get("key", True)}
    for key in document:
        if key not in hints:
            near = _sections_with(str(key), hints) or suggest(str(key), hints)
            shown = f"{where + str(key)!r:.80}"
            faults.append(
                compose("setting-unknown-near", key=shown, near=f"{near[0]!r}")
                if near
                else compose("setting-unknown", key=shown)
            )
    values = {key: _value(hints[key], document[key], where + key, faults) for key in hints if key in document}
    needed = [field.name for field in fields if field.default is field.default_factory is dataclasses.MISSING]
    faults += [compose("key-missing", key=where + key) for key in needed if key not in document]
    right = {key: value for key, value in values.items() if value is not ...}
    return kind(**right) if right.keys() >= {*needed} else typing.cast(T, ...)


def _sections_with(key: str, hints: Mapping[str, Any]) -> list[str]:
    """Returns ``section.key`` for each subtable that has a field named ``key``."""
    tables = {name: dataclasses.fields(hint) for name, hint in hints.items() if dataclasses.is_dataclass(hint)}
    return [f"{name}.{key}" for name, fields in tables.items() if key in (field.name for field in fields)]


def _value(hint: Any, value: Any, where: str, faults: list[Message]) -> Any:
    is_union = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
    options = get_args(hint) if is_union else (hint,)
    for option in options:
        if dataclasses.is_dataclass(option):
            return read_fields(typing.cast(type, option), value, where + ".", faults)
        if option is type(None) and value is None:
            return None
        if typing.get_origin(option) is Literal and (type(value), value) in [(type(w), w) for w in get_args(option)]:
            return value
        if option is float and (number := _number(value)) is not None:
            return number
        if typing.get_origin(option) is tuple and isinstance(value, list | tuple):
            one = get_args(option)[0]
            items = tuple(_value(one, item, _item(where, item, i), faults) for i, item in enumerate(value))
            return ... if any(item is ... for item in items) else items
        if option in (int, bool) and type(value) is option:
            return value
        if option is str and isinstance(value, str) and is_encodable(value):
            return value
    faults.append(compose("setting-wrong", setting=where, value=_shown(value), wanted=_wanted(options)))
    return ...


def _number(value: Any) -> float | None:
    """Returns a finite number as a float, or None for any other value and for integers beyond the range of float."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _item(where: str, value: Any, index: int) -> str:
    name = value.get("name") if isinstance(value, Mapping) else None
    return f"{where}.{name}" if isinstance(name, str) else f"{where}[{index}]"


def _shown(value: Any) -> Message | str:
    """Returns a wrong value as text. Python does not print integers of thousands of digits."""
    try:
        return f"{value!r:.80}"
    except (ValueError, RecursionError):
        return compose("value-too-large")


def _wanted(options: tuple[Any, ...]) -> str:
    words = []
    for option in options:
        if typing.get_origin(option) is Literal:
            words += [repr(word) for word in typing.get_args(option)]
        elif typing.get_origin(option) is tuple:
            words.append("a list of texts" if get_args(option)[0] is str else "a list")
        else:
            words.append(
                {float: "a finite number", int: "a whole number", bool: "true or false", str: "a text"}.get(
                    option, "null"
                )
            )
    return " or ".join(words)
