"""Implements the commands that run and maintain the service: serve, worker, prepare, doctor, keys."""

import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import typer

from server.cli.answers import Data, Json, answer, progress_bar, service_settings

if TYPE_CHECKING:
    from server.settings import ServiceSettings

app = typer.Typer(rich_markup_mode=None)
keys_app = typer.Typer(help="API keys of the service.", no_args_is_help=True, rich_markup_mode=None)


@app.command(epilog="Example: eigenhead serve --data /srv/eigenhead --port 8600")
def serve(
    data: Data = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="0 takes a free one.")] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.toml of real cameras; without it the simulated studio.")] = None,
    worker: Annotated[bool, typer.Option(help="Run a worker beside the service.")] = True,
    console: Annotated[bool | None, typer.Option(help="Serve the operator's pages.")] = None,
) -> None:
    """Run the service, and a worker beside it."""
    from server.http.serve import run_service
    from server.log import set_up

    settings = service_settings(data=data, host=host, port=port, rig=rig, console=console)
    set_up(settings.log_json)
    known_as = f", and is known as {settings.public_url}" if settings.public_url else ""
    run_service(
        settings, worker=worker, ready=lambda url: print(f"eigenhead listens on {url}{known_as}", file=sys.stderr)
    )


@app.command(epilog="Example: EIGENHEAD_DATABASE_URL=postgresql://db/eigenhead eigenhead worker --data /mnt/heads")
def worker(
    data: Data = None,
    queue: Annotated[str | None, typer.Option(help="The queue to serve.")] = None,
    concurrency: Annotated[int | None, typer.Option(help="Jobs at once.", min=1)] = None,
    check: Annotated[bool, typer.Option("--check", help="Run none; fail if none of this host is alive.")] = False,
    until_eof: Annotated[bool, typer.Option("--until-eof", hidden=True)] = False,
) -> None:
    """Run a worker that takes jobs from the service's queue."""
    settings = service_settings(data=data, queue=queue, concurrency=concurrency)
    if check:
        sys.exit(not _worker_lives(settings))
    from server.log import set_up
    from server.worker.worker import run_worker

    set_up(settings.log_json, jobs=settings.data / "jobs")
    run_worker(settings, until_eof=until_eof)


def _worker_lives(settings: "ServiceSettings") -> bool:
    """Returns whether a worker of this host is alive; True if the database, whose loss workers survive, is away."""
    import sqlalchemy as sa

    from server.storage.database import DatabaseUnavailable, alive_workers, open_database, workers

    try:
        with open_database(settings).connect() as connection:
            query = sa.select(workers.c.id).where(alive_workers(connection, settings.silent_s))
            return connection.scalar(query.where(workers.c.host == platform.node())) is not None
    except DatabaseUnavailable:
        return True


@app.command(epilog="Example: eigenhead prepare")
def prepare(json_out: Json = False) -> None:
    """Compile the loops of a job ahead.

    They are kept for every later process; the first job does it otherwise."""
    from rig.files import cache_folder
    from server.tasks.prepare import prepare_kernels

    began = monotonic()
    with progress_bar() as report:
        done = prepare_kernels(report)
    seconds = round(monotonic() - began, 3)
    summary = f"all {done.known} loops were compiled before"
    if done.compiled or done.missing:
        summary = f"{done.compiled} of {done.known} loops compiled in {seconds:.1f} s"
    answer(
        done._asdict() | {"seconds": seconds, "folder": str(cache_folder())}, json_out, [f"{cache_folder()}  {summary}"]
    )
    if done.missing:
        sys.exit(1)


@app.command(epilog="Example: eigenhead doctor")
def doctor(data: Data = None, json_out: Json = False) -> None:
    """Say what is wrong with this machine, and what to do."""
    from server.cli.doctor import examine

    findings = examine(service_settings(data=data))
    width = max(len(name) for name in findings)
    lines = [f"{'ok   ' if f['ok'] else 'WRONG'}  {name:<{width}}  {f['detail']}" for name, f in findings.items()]
    answer(findings, json_out, lines)
    if not all(finding["ok"] for finding in findings.values()):
        sys.exit(1)


@keys_app.command("add", epilog="Example: eigenhead keys add console --scope read --scope capture --scope submit")
def keys_add(
    name: str,
    scope: Annotated[list[str], typer.Option(help="read, capture, submit, erase, admin; may be repeated.")] = ["admin"],  # noqa: B006
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Make an API key; it is shown this once."""
    from server.services.keys import SCOPES

    unknown = set(scope) - set(SCOPES)
    if unknown:
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: there are {', '.join(SCOPES)}", param_hint="--scope")
    with _keys(data) as keys:
        key = keys.add(name, tuple(scope))
    where = service_settings().place
    print(f"eigenhead: a key of the service whose data is {where}", file=sys.stderr)
    answer({"id": key.split("_")[1], "key": key, "data": where}, json_out, [key])


@keys_app.command("list", epilog="Example: eigenhead keys list")
def keys_list(data: Data = None, json_out: Json = False) -> None:
    """List the API keys, without their secrets."""
    with _keys(data) as keys:
        keys_listed = keys.all()
    lines = [f"{key.id}  {key.name}  {' '.join(key.scopes)}" for key in keys_listed]
    answer({"keys": [asdict(key) for key in keys_listed]}, json_out, lines)


@keys_app.command("remove", epilog="Example: eigenhead keys remove 3f2a90b1c4d5")
def keys_remove(key_id: str, data: Data = None, json_out: Json = False) -> None:
    """Revoke an API key."""
    with _keys(data) as keys:
        keys.remove(key_id)
    answer({"id": key_id}, json_out, [f"removed {key_id}"])


@contextmanager
def _keys(data: Path | None) -> Iterator[Any]:
    from server.services.keys import Keys, note_keys
    from server.storage.database import open_database

    settings = service_settings(data=data)
    engine = open_database(settings)
    try:
        yield Keys(engine)
        note_keys(settings.data, Keys(engine))
    finally:
        engine.dispose()
