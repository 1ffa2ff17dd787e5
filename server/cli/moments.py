"""Implements ``eigenhead take``: several captures of one person, solved as one."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from server.cli.answers import (
    Data,
    Json,
    Overwrite,
    answer,
    prepare_folder,
    progress_bar,
    terminated_like_interrupted,
    warn,
    warn_of_replacement,
    wrong_usage,
)
from server.cli.heads import Detail, Model

if TYPE_CHECKING:
    from pipeline.results.reconstruction import Reconstruction

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
    """Solve several captures of one person as one head.

    All of them share one identity. Writes the neutral head with the person's own shapes, and each capture's head."""
    from pipeline.applications.moments.take import check_names, reconstruct_take
    from pipeline.applications.moments.take_files import Colours, write_take
    from pipeline.head_model.model import load_model
    from pipeline.results.write import write_result
    from pipeline.settings import settings_from_document
    from pipeline.stages.context import ReconstructionContext
    from rig.digest import document_sha256
    from rig.render.renderer import Renderer
    from server.cli.reconstruct_local import check_apart
    from server.cli.verify import head_alone
    from server.tasks.photographs import keep_masks, read_or_calibrate
    from server.tasks.prepare import prepare_kernels
    from server.tasks.reconstruct_folder import folder_of
    from server.tasks.settings_file import settings_document

    names = [path.resolve().name.partition(".")[0] for path in captures]
    with wrong_usage("CAPTURES"):
        check_names(names)
    chosen = settings_from_document(head_alone(settings_document(settings, detail=detail)))
    for capture in captures:
        check_apart(out, capture)
    warn_of_replacement(out / "report.json", overwrite)
    prepare_folder(out)
    with terminated_like_interrupted(), progress_bar() as report, ExitStack() as stack:
        prepare_kernels(report, chosen)
        head_model, renderer = load_model(model or "default"), stack.enter_context(Renderer.create())
        contexts, colours = {}, Colours()
        for name, capture in zip(names, captures, strict=True):
            folder, kept = stack.enter_context(folder_of(capture)), out / "moments" / name
            prepared = read_or_calibrate(folder, kept, front=chosen.front, report=report)
            segment = partial(keep_masks, kept)
            contexts[name] = ReconstructionContext(
                prepared.capture, prepared.rig, head_model, chosen, renderer, segment=segment
            )

        def deliver(name: str, result: "Reconstruction") -> None:
            write_result(out / "moments" / name, result, contexts[name].capture)
            colours.take_over(result)

        found = reconstruct_take(contexts, deliver, report=report)
        digests = {name: document_sha256(context.capture.digests) for name, context in contexts.items()}
        document = write_take(out, found, colours, digests)
    for warning in found.warnings:
        warn(f"{warning.code}: {warning}")
    for moment in found.moments:
        for warning in moment.warnings:
            warn(f"{moment.name}: {warning.code}: {warning}")
    lines = [str(out / "neutral.ply"), *(str(out / "moments" / name / "head.ply") for name in names)]
    answer(document, json_out, lines)
