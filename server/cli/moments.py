"""Implements the commands for one person at many moments: take, sequence, clock."""

import json
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from server.cli.answers import (
    Data,
    Json,
    Overwrite,
    answer,
    prepare_file,
    prepare_folder,
    progress_bar,
    warn,
    warn_of_replacement,
    wrong_usage,
)
from server.cli.heads import Detail, Model

if TYPE_CHECKING:
    from rig.studio.sensor.preset import Preset

app = typer.Typer(rich_markup_mode=None)


@app.command(epilog="Example: eigenhead take shots/anna-calm shots/anna-smile shots/anna-open --out takes/anna")
def take(
    captures: Annotated[
        list[Path], typer.Argument(help="Two or more captures of one person, in different expressions.", exists=True)
    ],
    out: Annotated[Path, typer.Option(help="The folder of the take.", file_okay=False)],
    *,
    model: Model = None,
    detail: Detail = None,
    settings: Annotated[Path | None, typer.Option(help="More settings, a TOML or JSON file.", exists=True)] = None,
    data: Data = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Solve several captures of one person as one.

    Writes the neutral head with the person's own shapes, and the head of each capture."""
    from pipeline.applications.moments.take import check_count, name_errors
    from pipeline.applications.moments.take_files import Shot, make_take, warning_lines
    from pipeline.settings import settings_from_document
    from server.cli.heads import capture_names, head_alone
    from server.cli.reconstruct_local import check_apart
    from server.tasks.photographs import keep_masks, read_or_calibrate
    from server.tasks.prepare import prepare_kernels
    from server.tasks.reconstruct import folder_of
    from server.tasks.settings_file import settings_document

    with wrong_usage("CAPTURES"):
        names = capture_names(captures)
        check_count(len(names))
    chosen = settings_from_document(head_alone(settings_document(settings, detail=detail)))
    for capture in captures:
        check_apart(out, capture)
    warn_of_replacement(out / "report.json", overwrite)
    prepare_folder(out)
    with progress_bar() as report, ExitStack() as stack:
        prepare_kernels(report, chosen)
        shots = {}
        for name, capture in zip(names, captures, strict=True):
            with name_errors(name):
                kept, folder = out / "moments" / name, stack.enter_context(folder_of(capture))
                found = read_or_calibrate(folder, kept, front=chosen.front, report=report)
            shots[name] = Shot(found.capture, found.rig, partial(keep_masks, kept))
        document = make_take(out, shots, model=model or "default", settings=chosen, report=report)
    warn(*warning_lines(document))
    answer(document, json_out, [str(out / name) for name in ("neutral.ply", "neutral.glb", "moments")])


@app.command(epilog="Example: eigenhead sequence films/anna --out tracks/anna --shard 3/4")
def sequence(
    folder: Annotated[
        Path,
        typer.Argument(
            help="cameras.json, and images/CAMERA/FRAME.png or videos/CAMERA.mp4.", file_okay=False, exists=True
        ),
    ],
    out: Annotated[Path, typer.Option(help="The result folder; a killed run goes on there.", file_okay=False)],
    *,
    shard: Annotated[str | None, typer.Option(help="K/N: one part alone; the last writes all.")] = None,
    usd: Annotated[bool, typer.Option("--usd", help="Write sequence.usdc too, a point cache.")] = False,
    model: Model = None,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Track one head through pictures or videos."""
    from pipeline.applications.moments.sequence_files import CACHE, FILES, make_sequence
    from pipeline.settings import settings_from_document
    from server.batch.captures import WHOLE, read_shard
    from server.cli.reconstruct_local import check_apart
    from server.tasks.film import SETTINGS
    from server.tasks.prepare import prepare_kernels

    with wrong_usage("--shard"):
        part = WHOLE if shard is None else read_shard(shard)
    chosen = settings_from_document(SETTINGS)
    check_apart(out, folder)
    prepare_folder(out)
    with progress_bar() as report:
        prepare_kernels(report, chosen)
        document = make_sequence(
            folder, out, model=model or "default", settings=chosen, report=report, usd=usd,
            share=(part.number, part.count),
        )  # fmt: skip
    if document is None:
        return answer({"shard": str(part)}, json_out, [f"part {part} is done; others are not yet"])
    warn(*(f"{warning['code']}: {warning['message']}" for warning in document["warnings"]))
    answer(document, json_out, [str(out / name) for name in (*FILES, *[CACHE][:usd])])


def film_sequence(out: Path, frames: int, seed: int, preset: "Preset", json_out: bool) -> None:
    """Films a moving subject in the simulated studio with cameras of 640 x 480 px; writes the pictures into ``out``."""
    import numpy as np

    from pipeline.applications.moments.footage import TRACKED_PIXELS
    from pipeline.head_model.model import load_model
    from rig.formats.pictures.work_size import work_rig
    from rig.render.renderer import Renderer
    from rig.studio.scene.layout import default_layout
    from server.tasks.moving_subject import Person, simulate_sequence

    model, studio = load_model(), work_rig(default_layout(), TRACKED_PIXELS)
    person = Person(model, np.random.default_rng((seed, 0)).standard_normal(len(model.modes)), seed)
    with progress_bar() as report, Renderer.create() as renderer:
        truth = simulate_sequence(out, person, studio, preset, frames, renderer=renderer, report=report)
    answer({"sequence": str(out), "truth": str(truth)}, json_out, [str(out), str(truth)])


@app.command(epilog="Example: eigenhead clock --page clock.html   eigenhead clock shots --out clock.json")
def clock(
    shots: Annotated[Path | None, typer.Argument(help="SHOTS/CAMERA/SHOT.png.", exists=True, file_okay=False)] = None,
    *,
    page: Annotated[Path | None, typer.Option(help="Write the page of the clock, for any browser.")] = None,
    rate: Annotated[float, typer.Option(help="Refreshes of the screen in a second; the page shows them.", min=20)] = 60,
    out: Annotated[Path | None, typer.Option(help="Also write a JSON file.", dir_okay=False)] = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Measure how much later each free camera exposes.

    All see one screen with the page. Take 40 shots, a second apart: the mean is then known to 2 ms, or to 5 ms where
    cameras run in step with the screen."""
    from calibration.board.picture_files import list_pictures
    from pipeline.applications.moments.screen_clock import clock_page, measure_shots
    from rig.files import write_atomically

    if (shots is None) == (page is None):
        raise typer.BadParameter("either a folder of shots, or --page", param_hint="SHOTS")
    if page is not None:
        prepare_file(page, overwrite=overwrite, option="--page")
        write_atomically(page, clock_page().encode())
        return answer({"page": str(page)}, json_out, [str(page)])
    assert shots is not None
    if out is not None:
        prepare_file(out, overwrite=overwrite)
    skews = measure_shots(list_pictures(shots), rate)
    document = {"format": "eigenhead-clock/1", "rate_hz": rate, "cameras": {n: asdict(s) for n, s in skews.items()}}
    if out is not None:
        write_atomically(out, (json.dumps(document, indent=1) + "\n").encode())
    lines = [
        f"{name}: {skew.mean_ms:+.1f} ms (standard deviation {skew.std_ms:.1f}), "
        f"{skew.scatter_ms:.1f} from shot to shot, {skew.shots} shots"
        for name, skew in skews.items()
    ]
    answer(document, json_out, lines)
