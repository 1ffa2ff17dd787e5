"""Implements ``eigenhead wrap``: gives a raw scan the vertex order of a template."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from server.cli.answers import Data, Json, Overwrite, Overwrites, answer, prepare_folder, progress_bar, warn

if TYPE_CHECKING:
    from pipeline.applications.wrapping.wrap import Wrapped

app = typer.Typer(rich_markup_mode=None)


@app.command(epilog="Example: eigenhead wrap scan.glb --template ict --model ict-facekit --out heads/scan")
def wrap(
    scan: Annotated[Path, typer.Argument(help="The scan of a head, .ply, .obj or .glb.", exists=True, dir_okay=False)],
    template: Annotated[str, typer.Option(help="A template's name (eigenhead template add).")],
    out: Annotated[Path, typer.Option(help="The folder of the result.", file_okay=False)],
    *,
    model: Annotated[str, typer.Option(help="The head model that carries the template.")] = "default",
    landmarks: Annotated[
        Path | None,
        typer.Option(
            help="Of the scan, .json, .pp or .ljson: 4 or more of docs/models.md, where no face is found on it.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    overwrite: Overwrite = False,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Give a raw scan the vertex order of a template.

    The scan's unit and axes are found by its face. Writes wrapped.obj with its texture, in the scan's own frame and
    unit, the distance of every vertex from the scan, and a picture to look at."""
    if (out / "wrapped.obj").exists() and not overwrite:
        raise Overwrites(out / "wrapped.obj")
    from pipeline.applications.model_building.correspondence.scans import read_landmarks
    from pipeline.applications.templates.template_file import load_template
    from pipeline.applications.wrapping.scan import read_raw_scan
    from pipeline.applications.wrapping.wrap import wrap as wrap_scan
    from pipeline.applications.wrapping.write import write_wrapped
    from pipeline.head_model.model import load_model

    head_model = load_model(model)
    known = load_template(template, head_model)
    assert known is not None
    marks = read_landmarks(landmarks) if landmarks else None
    raw = read_raw_scan(scan)
    prepare_folder(out)
    with progress_bar() as report:
        wrapped = wrap_scan(raw, known, head_model, landmarks=marks, report=report)
        document = write_wrapped(out, wrapped)
    if wrapped.placed.unit is None:
        warn("no unit makes the scan a head: it was taken to be as large as a mean adult's, so mm are a guess")
    answer(document | {"out": str(out)}, json_out, _lines(wrapped, out))


def _lines(wrapped: "Wrapped", out: Path) -> list[str]:
    figures, placed = wrapped.figures(), wrapped.placed
    unit = placed.unit or f"{placed.mm_per_unit:.4g} mm"
    placement = f"face found in {placed.views} renders" if placed.views else "placed by landmarks"
    turned = ", triangles turned over" if placed.turned_over else ""
    return [
        f"{out / 'wrapped.obj'}",
        f"unit {unit}, up {placed.up}, front {placed.front}{turned}; {placement}",
        f"{figures['vertices']:.0f} vertices, {figures['covered_share']:.0%} of them on the scan",
        f"these from its surface: {figures['median_mm']:.3f} mm (median), {figures['p95_mm']:.3f} (95 %)",
        f"its points from the template: {figures['scan_median_mm']:.3f} mm (median)",
        f"{out / 'residual.ply'}",
        f"{out / 'wrap.png'}",
    ]
