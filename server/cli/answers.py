"""What every command shares: option types, the service's settings, a progress bar, and the answer on stdout."""

import errno
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from pipeline.head_model.data_folder import DATA
from rig.errors import EigenheadError, InputError
from rig.messages.message import texts_of
from rig.progress import Progress

# Before OpenCV is loaded, here and in workers: what it has to say of a damaged picture, an error of ours says in words.
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")


class CannotWrite(EigenheadError):
    """An output that cannot be written, found before the work."""

    def __init__(self, path: Path, error: OSError, option: str = "--out") -> None:
        super().__init__(f"{path} cannot be written ({error.strerror or error}); name another place with {option}")


class SpoilsCapture(EigenheadError):
    """An output that would be read as a part of its own input from then on."""

    def __init__(self, path: Path, option: str = "--out") -> None:
        super().__init__(f"{path} lies where the capture's own pictures do; name another place with {option}")


class Overwrites(EigenheadError):
    """An output that is there already."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path} is there already; name another place, or replace it with --overwrite")


def _use_data(folder: Path | None) -> Path | None:
    """``--data`` counts for all that looks for data, keys or models, in this process and in its children."""
    if folder is not None:
        os.environ[DATA] = str(folder.resolve())
    return folder


Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
Data = Annotated[
    Path | None,
    typer.Option(
        "--data",
        help="The folder of captures, results, keys and models; by default EIGENHEAD_DATA.",
        file_okay=False,
        callback=_use_data,
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]


def service_settings(**overrides: Any) -> Any:
    """The service's settings: options over variables over defaults. A wrong variable is wrong usage."""
    from pydantic import ValidationError
    from pydantic_settings import SettingsError

    from server.settings import ServiceSettings, variable_in

    options = {name: value for name, value in overrides.items() if value is not None}
    try:
        return ServiceSettings(**options)
    except ValidationError as error:
        raise typer.BadParameter("; ".join(_setting_fault(fault, options) for fault in error.errors())) from error
    except SettingsError as error:
        raise typer.BadParameter(f'{variable_in(error)} is no JSON, such as ["first", "second"]') from error


def _setting_fault(fault: Any, options: Mapping[str, object]) -> str:
    """``fault`` as pydantic tells it, with the name by which its value came: an option's or a variable's."""
    from server.settings import PREFIX

    field, *inner = map(str, fault["loc"])
    name = field if field in options else PREFIX + field.upper()
    return f"{'.'.join([name, *inner])}: {fault['msg'].removeprefix('Value error, ')}"


def one_of(choices: Callable[[], tuple[str, ...]]) -> Callable[[str | None], str | None]:
    """A callback of an option that takes one of ``choices``, which are asked for when the option is given."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in choices():
            raise typer.BadParameter(f"{value!r} is none of {', '.join(choices())}")
        return value

    return check


def completing(choices: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """What a shell offers for the begun word of such an option."""
    return lambda incomplete: [choice for choice in choices() if choice.startswith(incomplete)]  # typer tells by name


def chosen(help_text: str, choices: Callable[[], tuple[str, ...]], *names: str) -> Any:
    """An option that takes one of ``choices``: asked for when it is given, or completed."""
    return typer.Option(*names, help=help_text, callback=one_of(choices), autocompletion=completing(choices))


def _finite(value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):  # no comparison with a limit says so of NaN
        raise typer.BadParameter(f"{value} is no finite number")
    return value


def number(help_text: str, **limits: Any) -> Any:
    """An option that takes a finite number between ``min`` and ``max``."""
    return typer.Option(help=help_text, callback=_finite, **limits)


def model_names() -> tuple[str, ...]:
    """Of the head models at hand."""
    from pipeline.head_model.model_names import list_models

    return tuple(list_models())


@contextmanager
def wrong_usage(option: str) -> Iterator[None]:
    """Faults of what an option says are wrong usage: status 2."""
    try:
        yield
    except InputError as error:
        raise typer.BadParameter("; ".join(texts_of(error.faults)), param_hint=option) from error


def prepare_file(path: Path, *, overwrite: bool = True, option: str = "--out") -> None:
    """Makes the folder of an output file and tries whether it can be written, before the work that it takes.

    Raises CannotWrite, and Overwrites where the file is there and shall stay."""
    if path.exists() and not overwrite:
        raise Overwrites(path)
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise CannotWrite(path, error, option) from error


def prepare_folder(path: Path) -> None:
    """Makes an output folder and tries whether it can be written. Raises CannotWrite."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except FileExistsError as error:
        raise CannotWrite(path, FileExistsError(errno.ENOTDIR, "it is a file, and a folder is written")) from error
    except OSError as error:
        raise CannotWrite(path, error) from error


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on standard error when that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda stage, fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:<14}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("start", total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


def answer(document: Any, as_json: bool, lines: list[str]) -> None:
    """One JSON object, or lines for people."""
    print(json.dumps(document, allow_nan=False) if as_json else "\n".join(lines))


def warn(message: str) -> None:
    """A line on standard error that stops nothing."""
    print(f"eigenhead: {message}", file=sys.stderr)


def fail(message: str) -> NoReturn:
    """One clear line on standard error, and status 1."""
    print(f"eigenhead: {message}", file=sys.stderr)
    sys.exit(1)
