"""Defines the one type for everything that the program reports: warnings, faults, refusals, failures.

A message's code is stable; its template (``rig/messages/english``) may be reworded at any time. In a template
``{name}`` is replaced by a parameter, ``{name:.1f}`` by a number; "one | several" are the forms for a count. Templates
use only those of Python's format specifications that the console's ``messages.js`` also supports (``SPECIFICATIONS``).
The specification ``word`` marks a value that is translated, such as the state of a job; names are not translated.

A new message needs, as tests check: its code and template in a module of ``rig/messages/english``, its German in
``server/console/static/messages_de.js``, and ``compose(code, ...)`` where it is used.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType, ModuleType
from typing import Any, NotRequired, Protocol, TypedDict, Union, runtime_checkable

from rig.messages.english import batch, calibration, cameras, formats, general, live, pipeline, rig, server
from rig.text import printable

NAMED_MOST = 4  # cameras or keys that one message names
SAME_LEAST = 3  # from so many faults on that differ in names alone, one message stands for all
MEASURED = re.compile(r"(?<![\w.])-?(?:\d+\.\d+(?:e[+-]?\d+)?(?![\w.])|\d+(?=%))")
# matches no sizes in pixels: cameras that differ in size stay apart
FIELD = re.compile(r"\{(\w+)(?::([^{}]+))?\}")
SPECIFICATIONS = re.compile(r"word|g|,|[+]?\.\d[f%g]")
FORMS = " | "


def fields_of(template: str) -> dict[str, str]:
    """Returns the format specification (or "") of every field of a template, and of ``count`` if it has two forms."""
    fields = {name: specification or "" for name, specification in FIELD.findall(template)}
    return {"count": "", **fields} if FORMS in template else fields


def render(template: str, parameters: Mapping[str, Any]) -> str:
    """Fills in a template. Raises KeyError if a field of the template has no parameter."""
    forms = template.split(FORMS)
    form = forms[0] if len(forms) == 1 or parameters["count"] == 1 else forms[-1]
    return FIELD.sub(lambda field: _written(parameters[field[1]], field[2] or ""), form)


def _written(value: object, specification: str) -> str:
    """Formats a value as text; a list gets commas between names and semicolons between sentences."""
    if isinstance(value, tuple):
        between = ", " if all(isinstance(item, str | int | float) for item in value) else "; "
        return between.join(_written(item, specification) for item in value)
    if isinstance(value, int | float) and specification != "word":
        return format(value, specification)
    return str(value)


AREAS: tuple[ModuleType, ...] = (batch, calibration, cameras, formats, general, live, pipeline, rig, server)


def _all() -> dict[str, str]:
    templates: dict[str, str] = {}
    for area in AREAS:
        assert not templates.keys() & area.TEMPLATES.keys(), "a code stands in two areas"
        templates |= area.TEMPLATES
    return templates


CATALOGUE: Mapping[str, str] = MappingProxyType(_all())

Parameter = Union[str, int, float, "Message", tuple[Any, ...]]  # a list is of parameters, too
Raw = Union[str, int, float, "Scalar", "Message", Iterable[Any]]
VERBATIM = "verbatim"  # the code of text that another program or an earlier version wrote


@runtime_checkable
class Scalar(Protocol):
    """Describes a number of NumPy. The module does not import NumPy itself, so that a command that only prints a
    message starts at once."""

    @property
    def dtype(self) -> Any:
        """Returns NumPy's type of the number."""
        ...

    def item(self) -> Any:
        """Returns the plain number."""
        ...


class MessageDocument(TypedDict):
    """Holds a message in JSON. Messages stored by earlier versions of the program have no parameters."""

    code: str
    message: str
    parameters: NotRequired[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Message:
    """Holds a message: its stable ``code`` in the catalogue, the ``parameters`` by their names in the template, and the
    English ``text``."""

    code: str
    parameters: Mapping[str, Parameter]
    text: str

    def __str__(self) -> str:
        return self.text

    def __hash__(self) -> int:
        return hash((self.code, self.text))

    def document(self) -> MessageDocument:
        """Returns the message for JSON; characters that UTF-8 cannot encode are escaped."""
        parameters = {name: _document(value) for name, value in self.parameters.items()}
        return {"code": self.code, "message": printable(self.text), "parameters": parameters}


def compose(code: str, /, **parameters: Raw) -> Message:
    """Makes the message of a code, with exactly the parameters in the code's template. Raises KeyError for an unknown
    code, and AssertionError for other parameters, because these are programming errors."""
    template, values = CATALOGUE[code], {name: _parameter(value) for name, value in parameters.items()}
    assert values.keys() == fields_of(template).keys(), f"{code}: {sorted(values)} for {template!r}"
    return Message(code, values, render(template, values))


def verbatim(text: str) -> Message:
    """Makes a message without a code from a text, which another program or an earlier version wrote."""
    return Message(VERBATIM, {"text": text}, text)


def message_of(message: Message | str) -> Message:
    """Returns the message unchanged; a text becomes a message without a code."""
    return message if isinstance(message, Message) else verbatim(message)


def read_message(document: object) -> Message:
    """Reads the output of ``Message.document``, and the texts and ``{code, message}`` of earlier versions. Raises
    ValueError for any other document."""
    if isinstance(document, str):
        return verbatim(document)
    if not isinstance(document, Mapping) or not all(isinstance(document.get(key), str) for key in ("code", "message")):
        raise ValueError(f"no message: {document!r:.80}")
    parameters = document.get("parameters") or {}
    return Message(document["code"], {name: _read(value) for name, value in parameters.items()}, document["message"])


def texts_of(messages: Iterable[Message]) -> list[str]:
    """Returns the English texts."""
    return [message.text for message in messages]


def documents_of(messages: Iterable[Message]) -> list[MessageDocument]:
    """Returns messages as JSON types."""
    return [message.document() for message in messages]


def _parameter(value: Raw) -> Parameter:
    if isinstance(value, Scalar):
        value = value.item()
    if isinstance(value, str | int | float | Message):
        return value
    assert isinstance(value, Iterable), type(value)
    return tuple(_parameter(item) for item in value)


def _document(value: Parameter) -> Any:
    if isinstance(value, Message):
        return value.document()
    if isinstance(value, tuple):
        return [_document(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # JSON has no such number
    return printable(value) if isinstance(value, str) else value


def _read(value: Any) -> Parameter:
    if isinstance(value, Mapping):
        return read_message(value)
    return tuple(_read(item) for item in value) if isinstance(value, list) else value


def say_once(faults: Sequence[Message | str], names: Iterable[str], *, named_most: int = NAMED_MOST) -> list[Message]:
    """Groups faults that differ only in the names of cameras and files, and in the values measured for each. Each group
    of faults becomes one message that names the first cameras or files and counts the others."""
    ordered = sorted(set(names), key=len, reverse=True)
    name = re.compile(r"(?<![^\W_])(" + "|".join(map(re.escape, ordered)) + r")(?![^\W_])") if ordered else None
    plate = re.compile(r"\b(background/)\S+")
    groups: dict[str, list[Message]] = {}
    for fault in dict.fromkeys(message_of(fault) for fault in faults):
        masked = plate.sub(r"\1", fault.text)
        masked = masked if name is None else name.sub("\0", masked)
        groups.setdefault(MEASURED.sub("\1", masked), []).append(fault)
    grouped = []
    for group in groups.values():
        if len(group) < SAME_LEAST or name is None:
            grouped += group
            continue
        others = dict.fromkeys(found[1] for fault in group[1:] if (found := name.search(fault.text)))
        grouped.append(
            compose("same-of-more", fault=group[0], count=len(group) - 1, names=some_of([*others], named_most))
        )
    return grouped


def some_of(names: Sequence[str], most: int = NAMED_MOST) -> Sequence[str] | Message:
    """Returns the first few names, and a note with the number of the others, for use in a message."""
    more = len(names) - most
    return compose("names-and-more", names=names[:most], more=more) if more > 0 else names
