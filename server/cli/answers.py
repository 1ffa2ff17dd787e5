"""Provides for all commands: types of options, the service's settings, a progress bar, and the answer on stdout."""

import atexit
import errno
import json
import math
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from threading import Event
from time import monotonic, time
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from pipeline.head_model.model_names import DATA, list_models
from rig.errors import EigenheadError, InputError
from rig.messages.message import compose, texts_of
from rig.progress import Progress

# Set before OpenCV is loaded, here and in workers. OpenCV would log damaged pictures; our own errors name them better.
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")


LINE_S = 30.0  # between lines of progress in a log
RESUMED = ("batch", "sequence")  # commands that make only what an earlier run left unmade
GOING_ON = (*RESUMED, "reconstruct", "take", "export")  # the latter keep cameras and masks that they estimated


class CannotWrite(EigenheadError):
    """Reports an output path that cannot be written. The error is raised before the work begins."""

    def __init__(self, path: Path, error: OSError, option: str = "--out") -> None:
        super().__init__(f"{path} cannot be written ({error.strerror or error}); name another place with {option}")


class SpoilsCapture(EigenheadError):
    """Reports an output path within the capture, because the next reconstruction would read the result as input."""

    def __init__(self, path: Path, option: str = "--out") -> None:
        super().__init__(f"{path} lies where the capture's own pictures do; name another place with {option}")


class Overwrites(EigenheadError):
    """Reports an output file that exists already while ``--overwrite`` was not given."""

    def __init__(self, path: Path, what: str = "place") -> None:
        super().__init__(f"{path} is there already; choose another {what}, or replace it with --overwrite")


def _use_data(folder: Path | None) -> Path | None:
    """Sets the variable EIGENHEAD_DATA from ``--data``, so that this process and its children all use that folder."""
    if folder is not None:
        os.environ[DATA] = str(folder.resolve())
    return folder


QUIET = Event()  # set by --quiet: neither progress nor warnings are shown


def use_threads(value: int | None) -> None:
    """Sets the variable EIGENHEAD_THREADS from ``--threads``, so that this process and its children use that number."""
    if value is not None:
        os.environ["EIGENHEAD_THREADS"] = str(value)


def file_in(help_text: str) -> Any:
    """Returns a typer option that takes a file that exists."""
    return typer.Option(help=help_text, exists=True, dir_okay=False)


def switch(name: str, help_text: str) -> Any:
    """Returns a typer option without a value and without a negative form."""
    return typer.Option(name, help=help_text)


Json = Annotated[bool, switch("--json", "Print one JSON object on stdout and nothing else.")]
Anyway = Annotated[bool, switch("--anyway", "Make a head, with a warning, where a check would refuse the capture.")]
Strict = Annotated[bool, switch("--strict", "Refuse a capture if one of its pictures is missing, damaged or black.")]
Data = Annotated[
    Path | None,
    typer.Option(
        "--data",
        help="The folder of captures, results, keys and models; by default EIGENHEAD_DATA.",
        file_okay=False,
        callback=_use_data,
    ),
]
Overwrite = Annotated[bool, switch("--overwrite", "Replace what is there.")]


def service_settings(**overrides: Any) -> Any:
    """Returns the service's ``ServiceSettings``. An option that is not None overrides the environment variable, which
    overrides the default.

    Raises typer.BadParameter (exit status 2) naming every option or variable with a wrong value.
    """
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
    """Returns a sentence on a fault found by pydantic, naming the option or variable with the wrong value."""
    from server.settings import PREFIX

    field, *inner = map(str, fault["loc"])
    name = field if field in options else PREFIX + field.upper()
    return f"{'.'.join([name, *inner])}: {fault['msg'].removeprefix('Value error, ')}"


def completing(choices: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Returns a function for completion by the shell, which lists the choices that begin with what was typed."""
    # The parameter's name tells typer what to pass.
    return lambda incomplete: [choice for choice in choices() if choice.startswith(incomplete)]


def _finite(value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):  # NaN passes every comparison with a limit
        raise typer.BadParameter(f"{value} is no finite number")
    return value


def number(help_text: str, **limits: Any) -> Any:
    """Returns a typer option that takes a finite number between the limits ``min`` and ``max``."""
    return typer.Option(help=help_text, callback=_finite, **limits)


def model_names() -> tuple[str, ...]:
    """Returns the names of all installed head models."""
    return tuple(list_models())


@contextmanager
def wrong_usage(option: str) -> Iterator[None]:
    """Turns an InputError raised in the block into typer.BadParameter of ``option``, which ends the command with status
    2."""
    try:
        yield
    except InputError as error:
        raise typer.BadParameter("; ".join(texts_of(error.faults)), param_hint=option) from error


def prepare_file(path: Path, *, overwrite: bool = True, option: str = "--out") -> None:
    """Makes the folder of an output file and checks, before any other work, that the file can be written.

    Raises CannotWrite for an unwritable path, and Overwrites if the file exists and ``overwrite`` is false."""
    if path.exists() and not overwrite:
        raise Overwrites(path, "place" if option == "--out" else option)
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        _make_folder(path.parent)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise CannotWrite(path, error, option) from error


def prepare_folder(path: Path, sign: str = "", *, overwrite: bool = True) -> None:
    """Makes an output folder. Raises CannotWrite if the folder cannot be written, and Overwrites if the folder has the
    file ``sign`` and ``overwrite`` is false."""
    if sign and (path / sign).exists() and not overwrite:
        raise Overwrites(path / sign)
    try:
        _make_folder(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except FileExistsError as error:
        raise CannotWrite(path, FileExistsError(errno.ENOTDIR, "it is a file, and a folder is written")) from error
    except OSError as error:
        raise CannotWrite(path, error) from error


def _make_folder(path: Path) -> None:
    """Makes a folder, and removes it at the end of the command if the folder is still empty."""
    atexit.register(_remove_empty, [folder for folder in (path, *path.parents) if not folder.exists()])
    path.mkdir(parents=True, exist_ok=True)


def _remove_empty(folders: Iterable[Path]) -> None:
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def stoppable(run: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Returns the function of a command that SIGTERM ends as Ctrl-C does, so that no unfinished file remains: with a
    line on what was written, and status 130. Job schedulers send SIGTERM some seconds before SIGKILL."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    @wraps(run)
    def command(out: str | None = None, **values: Any) -> None:
        since_s = 0.0 if name in RESUMED else time() - 0.02  # files are dated by a clock of 10 ms steps
        before = signal.signal(signal.SIGTERM, stop)
        try:
            run(**values, **({} if out is None else {"out": out}))
        except KeyboardInterrupt:
            paths = [] if out is None else [Path(out), *Path(out).rglob("*")]
            written = any(path.is_file() and path.stat().st_mtime >= since_s for path in paths)
            again = "run the same command again to go on" if name in GOING_ON else f"{out} is not complete"
            print(f"eigenhead: Stopped; {again if written else 'nothing was written'}", file=sys.stderr, flush=True)
            raise typer.Exit(130) from None
        finally:
            signal.signal(signal.SIGTERM, before)

    return command


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yields a function that shows progress (stage, fraction 0 to 1) as a bar on standard error. If standard error is
    no terminal, the function writes a line every ``LINE_S`` seconds."""
    if QUIET.is_set() or not sys.stderr.isatty():
        yield _line_writer()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:<14}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("start", total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


def _line_writer() -> Progress:
    told_s = monotonic()

    def write(stage: str, fraction: float) -> None:
        nonlocal told_s
        if not QUIET.is_set() and monotonic() - told_s >= LINE_S:
            told_s = monotonic()
            print(f"eigenhead: {stage} {fraction:.0%}", file=sys.stderr, flush=True)

    return write


def answer(document: Any, as_json: bool, lines: list[str]) -> None:
    """Prints the command's result on stdout: ``document`` as one JSON object, or ``lines`` for people."""
    print(json.dumps(document, allow_nan=False) if as_json else "\n".join(lines))


def warn(*messages: str) -> None:
    """Prints warnings on standard error, unless ``--quiet`` was given, and lets the command continue."""
    for message in () if QUIET.is_set() else messages:
        print(f"eigenhead: {message}", file=sys.stderr)


def warn_of_replacement(path: Path, overwrite: bool) -> None:
    """Warns that a file, or a folder with anything in it, will be replaced although ``--overwrite`` was not given."""
    if not overwrite and (any(path.iterdir()) if path.is_dir() else path.exists()):
        warn(f"result-replaced: {compose('result-replaced', file=str(path))}")


def fail(message: str) -> NoReturn:
    """Prints an error on standard error and exits with status 1."""
    print(f"eigenhead: {message}", file=sys.stderr)
    sys.exit(1)
