"""Runs a record of the table: makes the command line's options from the signature of its function, makes the inputs,
calls it, and writes and prints what it returns.

Parameters before the ``*`` of a function are positional on the command line, those behind it are options; what is named
in ``inputs.INPUTS`` or in the record is made by a function, whose own parameters count in the same way. A note in
``Annotated`` is the option's help.
"""

import argparse
import importlib
import inspect
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from rig.files import write_atomically
from rig.formats.pictures.images import write_image
from tests.laboratory.experiments import markdown
from tests.laboratory.inputs import INPUTS

Makers = Mapping[str, Callable[..., Any]]
SCALARS = (int, float, str, bool, Path)


@dataclass(frozen=True, slots=True)
class Record:
    """Describes an experiment or a benchmark.

    Attributes:
        function: module below tests.laboratory, and the function in it.
        sentence: says what it measures.
        takes: functions that make parameters which ``INPUTS`` does not make, or makes otherwise.
    """

    function: str
    sentence: str
    takes: Makers = field(default_factory=dict)

    def load(self) -> Callable[..., dict[str, Any]]:
        """Imports the function."""
        module, _, name = self.function.partition(":")
        return getattr(importlib.import_module(f"tests.laboratory.{module}"), name)


def run(name: str, record: Record, words: Sequence[str]) -> tuple[dict[str, Any], bool]:
    """Runs a record with the words of a command line. Returns its result and whether JSON is wanted. Its table and
    pictures are written to the folder of ``--out``. Raises EigenheadError; ends the process for wrong usage."""
    function = record.load()
    words_read = vars(parser_of(name, record, function).parse_args(words))
    as_json = words_read.pop("json")
    values = {key: value for key, value in words_read.items() if value not in (None, [])}
    found = call(function, record.takes, **values)
    pictures, text = found.pop("pictures", {}), found.pop("markdown", None)
    out = values.get("out")
    if out is not None and "rows" in found:
        write_atomically(out / f"{name}.md", (text or markdown.of_figures(found["figures"])).encode())
        for title, image in pictures.items():
            write_image(out / f"{name}-{title}.png", image)
    return found, as_json


def call(function: Callable[..., Any], takes: Makers, **values: Any) -> Any:
    """Calls a function with its inputs made and with those of ``values`` that it takes."""
    with ExitStack() as stack:
        return _call(function, {**INPUTS, **takes}, values, stack, {})


def _call(function: Callable[..., Any], makers: Makers, values: Mapping[str, Any], stack: ExitStack, made: dict) -> Any:
    arguments = {}
    for name in inspect.signature(function).parameters:
        if name in makers:
            maker = makers[name]
            if maker not in made:
                value = _call(maker, _others(makers, name), values, stack, made)
                opens = hasattr(type(value), "__exit__") and not isinstance(value, Path)
                made[maker] = stack.enter_context(value) if opens else value
            arguments[name] = made[maker]
        elif name in values:
            arguments[name] = values[name]
    return function(**arguments)


def _others(makers: Makers, name: str) -> Makers:
    return {other: maker for other, maker in makers.items() if other != name}


def parser_of(name: str, record: Record, function: Callable[..., Any]) -> argparse.ArgumentParser:
    """Returns the parser of a record's command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m tests.laboratory {name}",
        description=f"{record.sentence}\n\n{inspect.getmodule(function).__doc__}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    found = dict(_parameters(function, {**INPUTS, **record.takes}))
    if record.function.startswith("experiments."):
        found = dict(_parameters(_common, INPUTS)) | found
    lists_end = not any(parameter.kind is not parameter.KEYWORD_ONLY for parameter in found.values())
    for parameter in found.values():
        _add(parser, parameter, lists_end)
    parser.add_argument("--json", action="store_true", default=False, help="print one JSON object and nothing else")
    return parser


def _common(model: object, facekit: object, folder: object, *, subjects: int | None = None) -> None:
    """Has the options of every experiment, whether it needs them or not: --model, --shared, --out, --subjects."""


def _parameters(function: Callable[..., Any], makers: Makers) -> Iterator[tuple[str, inspect.Parameter]]:
    """Yields the parameters that the command line gives to a function and to the functions that make its inputs."""
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if name in makers:
            yield from _parameters(makers[name], _others(makers, name))
        elif _scalar(parameter.annotation) is not None:
            yield name, parameter


def _scalar(annotation: Any) -> Any:
    """Returns the type of one word of the command line: a scalar or a Literal; None if the annotation has none."""
    origin = get_origin(annotation)
    if annotation in SCALARS or origin is Literal:
        return annotation
    if origin is Annotated or (inspect.isclass(origin) and issubclass(origin, Sequence)):
        return _scalar(get_args(annotation)[0])
    if origin in (Union, UnionType):
        (kind, *more) = [each for each in get_args(annotation) if each is not NoneType]
        return None if more else _scalar(kind)
    return None


def _add(parser: argparse.ArgumentParser, parameter: inspect.Parameter, lists_end: bool) -> None:
    annotation, default = parameter.annotation, parameter.default
    note = get_args(annotation)[1] if get_origin(annotation) is Annotated else ""
    kind = _scalar(annotation)
    several = inspect.isclass(origin := get_origin(_bare(annotation))) and issubclass(origin, Sequence)
    needed = default is parameter.empty
    shown = "" if needed or default in (None, False, (), "") else f" (default: {default})"
    settings: dict[str, Any] = {"help": f"{note}{shown}".strip()}
    if get_origin(kind) is Literal:
        settings["choices"] = get_args(kind)
    else:
        settings["type"] = _count(1 if parameter.name == "subjects" else 0) if kind is int else kind
    if parameter.kind is not parameter.KEYWORD_ONLY:
        nargs = ("+" if needed else "*") if several else (None if needed else "?")
        parser.add_argument(parameter.name, nargs=nargs, **settings)
        return
    flag = f"--{parameter.name.replace('_', '-')}"
    if kind is bool:
        action = argparse.BooleanOptionalAction if default else "store_true"
        parser.add_argument(flag, action=action, help=settings["help"])
    elif several:
        repeated: dict[str, Any] = {"action": "extend", "nargs": "+"} if lists_end else {"action": "append"}
        parser.add_argument(flag, **(settings | repeated))
    else:
        parser.add_argument(flag, **settings)


def _bare(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _count(least: int) -> Callable[[str], int]:
    def count(text: str) -> int:
        if int(text) < least:
            raise argparse.ArgumentTypeError(f"{text} is less than {least}")
        return int(text)

    return count


def lines_of(found: Mapping[str, Any]) -> list[str]:
    """Returns a result as lines for people: its own, or a line for each figure."""
    return found.get("lines") or [f"{key:<40} {_text(value)}" for key, value in _flat(found["figures"])]


def _flat(figures: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in figures.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key} ")
        else:
            yield f"{before}{key}", value


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, int | float) else value if isinstance(value, str) else json.dumps(value)
