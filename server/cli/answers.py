"""What every command shares: option types, the service's settings, a progress bar, and the answer on stdout."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
Data = Annotated[Path | None, typer.Option(help="The service's data folder.", file_okay=False)]
Report = Callable[[str, float], None]


def service_settings(**given: Any) -> Any:
    """The service's settings: options over variables over defaults. A wrong variable is wrong usage."""
    from pydantic import ValidationError

    from server.settings import ServiceSettings

    try:
        return ServiceSettings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise typer.BadParameter(faults) from error


@contextmanager
def progress_bar() -> Iterator[Report]:
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


def fail(message: str) -> NoReturn:
    """One clear line on standard error, and status 1."""
    print(f"eigenhead: {message}", file=sys.stderr)
    sys.exit(1)
