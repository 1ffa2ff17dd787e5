"""Implements ``eigenhead export``, which writes a capture for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from server.cli.answers import Json, Overwrite, Overwrites, answer, chosen, prepare_folder, progress_bar, warn

app = typer.Typer(rich_markup_mode=None)


def _dataset_formats() -> tuple[str, ...]:
    from rig.formats.cameras.dataset_json import DATASET_FORMATS

    return DATASET_FORMATS


@app.command(epilog="Example: eigenhead export shots/anna --as nerfstudio --result heads/anna --out sets/anna")
def export(
    capture: Annotated[Path, typer.Argument(help="A capture folder, or a .zip, .tar or .tar.gz of one.", exists=True)],
    form: Annotated[str, chosen("nerfstudio or gaussian-avatars.", _dataset_formats, "--as")],
    out: Annotated[Path, typer.Option(help="The folder of the data set.", file_okay=False)],
    *,
    result: Annotated[
        Path | None,
        typer.Option(
            help="The capture's result folder: head and FLAME parameters.",
            exists=True,
            file_okay=False,
        ),
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="Of the job, a TOML or JSON file.", exists=True)] = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Write a capture as a data set for other programs.

    Undistorted pictures, masks and cameras in metres."""
    from typing import cast

    from pipeline.settings import settings_from_document
    from rig.formats.cameras.dataset_json import DatasetFormat
    from server.cli.reconstruct_local import check_apart
    from server.tasks.export_dataset import export_folder
    from server.tasks.reconstruct_folder import folder_of
    from server.tasks.settings_file import settings_document

    wanted = settings_from_document(settings_document(settings))
    check_apart(out, capture)
    if (out / "transforms.json").exists() and not overwrite:
        raise Overwrites(out / "transforms.json")
    prepare_folder(out)
    with progress_bar() as report, folder_of(capture) as folder:
        made = export_folder(folder, out, cast(DatasetFormat, form), result=result, chosen=wanted, report=report)
    for warning in made.warnings:
        warn(f"{warning.code}: {warning}")
    document = {"out": str(out), "as": form, "cameras": made.cameras, "left_out": made.left_out, "points": made.points}
    document |= {"flame": made.flame}
    seen = (
        f"{len(made.cameras)} views"
        + (", FLAME parameters" if made.flame else "")
        + (f", without {', '.join(made.left_out)}" if made.left_out else "")
    )
    answer(document, json_out, [f"{out}  {seen}"])
