"""Implements the commands about templates (meshes in whose vertex order results are written): template add, list,
remove, and wrap, which gives a raw scan such an order."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from server.cli.answers import Data, Json, Overwrite, answer, file_in, prepare_file, prepare_folder, progress_bar, warn

if TYPE_CHECKING:
    from pipeline.applications.wrapping.wrap import Wrapped

app = typer.Typer(rich_markup_mode=None)

template_app = typer.Typer(
    help="Meshes in whose vertex order results are written.", no_args_is_help=True, rich_markup_mode=None
)


@template_app.command("add", epilog="Example: eigenhead template add flame.obj --name flame --model default")
def template_add(
    file: Annotated[
        Path,
        typer.Argument(help="An OBJ file of a human head, or a FLAME model (.pkl, .npz).", exists=True, dir_okay=False),
    ],
    name: Annotated[str | None, typer.Option(help="What to call it; by default the file's name.")] = None,
    model: Annotated[str, typer.Option(help="The head model that carries it, a name or file.")] = "default",
    *,
    landmarks: Annotated[
        Path | None,
        file_in("Of the mesh, .json, .pp or .ljson: 4 or more of docs/models.md. By default the file beside it."),
    ] = None,
    overwrite: Overwrite = False,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Register a mesh to a head model, once.

    Its unit and axes are found, or told by landmarks. Look at the picture that is written beside it: skin must lie on
    skin. `reconstruct --template NAME` then writes heads in its vertex order, with its polygons and texture
    coordinates; of a FLAME model it writes the parameters, too. The file stays under its own licence."""
    from pipeline.applications.templates.header import new_path

    path = new_path(name or file.stem)
    prepare_file(path, overwrite=overwrite, option="--name")
    from pipeline.applications.model_building.correspondence.scans import landmark_file, read_landmarks
    from pipeline.applications.templates.make import make_template, template_picture
    from pipeline.applications.templates.template_file import save_template
    from pipeline.head_model.model import load_model
    from rig.formats.pictures.images import write_image

    marked = landmarks or landmark_file(file)
    points = read_landmarks(marked) if marked else None
    head_model = load_model(model)
    with progress_bar() as report:
        template, fitted = make_template(file, path.stem, head_model, landmarks=points, report=report)
        picture = path.with_suffix(".png")
        write_image(picture, template_picture(template, fitted, head_model))
        save_template(path, template)
    document = {"name": path.stem, "file": str(path), "picture": str(picture), "model": head_model.name}
    lines = [f"{path.stem}  {path}", *_registration_lines(template.figures), str(picture)]
    answer(document | {"figures": template.figures}, json_out, lines)


def _registration_lines(figures: Mapping[str, float]) -> list[str]:
    count, unlike = figures["vertices"], figures["unlike_median_mm"]
    return [
        f"{count:.0f} vertices, {figures['skin_share']:.0%} of them on the model's skin; the others follow it",
        f"shows {figures['face_covered_share']:.0%} of the model's face",
        f"the model comes as near as {unlike:.2f} mm (median), {figures['unlike_p95_mm']:.2f} (95 %)",
        f"drawn onto it: {figures['off_median_mm']:.3f} mm (median), {figures['off_p95_mm']:.3f} (95 %)",
    ]


@template_app.command("list", epilog="Example: eigenhead template list")
def template_list(data: Data = None, json_out: Json = False) -> None:
    """List the templates at hand, and the models that carry them."""
    from pipeline.applications.templates.header import BadTemplate, list_templates, read_header

    templates, lines = {}, []
    for name, path in list_templates().items():
        try:
            template = read_header(path)
        except BadTemplate as error:
            templates[name], status = {"file": str(path), "fault": str(error)}, "damaged"
        else:
            templates[name] = {"file": str(path), "model": template.model_name, **template.figures}
            status = template.model_name
        lines.append(f"{name}  {status}  {path}")
    answer({"templates": templates}, json_out, lines)


@template_app.command("remove", epilog="Example: eigenhead template remove flame")
def template_remove(
    name: Annotated[str, typer.Argument(help="A template of the list.")], data: Data = None, json_out: Json = False
) -> None:
    """Remove a template and its picture."""
    from pipeline.applications.templates.header import remove_template

    path = remove_template(name)
    answer({"name": name, "file": str(path)}, json_out, [f"removed {path}"])


@app.command(epilog="Example: eigenhead wrap scan.glb --template ict --model ict-facekit --out heads/scan")
def wrap(
    scan: Annotated[Path, typer.Argument(help="The scan of a head, .ply, .obj or .glb.", exists=True, dir_okay=False)],
    template: Annotated[str, typer.Option(help="A template's name (eigenhead template add).")],
    out: Annotated[Path, typer.Option(help="The folder of the result.", file_okay=False)],
    *,
    model: Annotated[str, typer.Option(help="The head model that carries the template.")] = "default",
    landmarks: Annotated[
        Path | None,
        file_in("Of the scan, .json, .pp or .ljson: 4 or more of docs/models.md, where no face is found on it."),
    ] = None,
    overwrite: Overwrite = False,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Give a raw scan the vertex order of a template.

    The scan's unit and axes are found by its face. Writes wrapped.obj with its texture, in the scan's own frame and
    unit, the distance of every vertex from the scan, and a picture to look at."""
    prepare_folder(out, "wrapped.obj", overwrite=overwrite)
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
    with progress_bar() as report:
        wrapped = wrap_scan(raw, known, head_model, landmarks=marks, report=report)
        document = write_wrapped(out, wrapped)
    if wrapped.placed.unit is None:
        warn("no unit makes the scan a head: it was taken to be as large as a mean adult's, so mm are a guess")
    answer(document | {"out": str(out)}, json_out, _wrap_lines(wrapped, out))


def _wrap_lines(wrapped: "Wrapped", out: Path) -> list[str]:
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
