"""Implements ``eigenhead compare`` (two visits of a person), ``register`` (a head on the surface of a CT) and
``measure`` (lengths by which helmets, masks and spectacles are fitted)."""

from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from server.cli.answers import Data, Json, Overwrite, answer, file_in, prepare_folder, warn

if TYPE_CHECKING:
    from pipeline.applications.clinic.comparison_files import Comparison

app = typer.Typer(rich_markup_mode=None)

Result = Annotated[Path, typer.Argument(help="A result folder.", exists=True, file_okay=False)]
Model = Annotated[
    str | None, typer.Option(help="The head model's name or file, if not the one that report.json names.")
]


@app.command(epilog="Example: eigenhead compare heads/anna-march heads/anna-june --out compared/anna")
def compare(
    earlier: Annotated[Path, typer.Argument(help="The earlier result folder.", exists=True, file_okay=False)],
    later: Annotated[Path, typer.Argument(help="The later one, of the same person.", exists=True, file_okay=False)],
    out: Annotated[Path, typer.Option(help="The folder of the comparison.", file_okay=False)],
    *,
    model: Model = None,
    overwrite: Overwrite = False,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Compare two results of one person.

    Both are aligned on the forehead and the bridge of the nose. Writes the signed distances as PLY, GLB, picture and
    tables, and a PDF; what is below two combined standard deviations is grey."""
    prepare_folder(out, "compare.json", overwrite=overwrite)
    from pipeline.applications.clinic.comparison_files import compare as compare_visits
    from pipeline.applications.clinic.comparison_files import write_comparison
    from pipeline.applications.clinic.visit import read_visit

    comparison = compare_visits(read_visit(earlier, model), read_visit(later, model))
    document = write_comparison(out, comparison, date.today().isoformat())
    warn(*map(str, comparison.warnings))
    answer(document | {"out": str(out)}, json_out, _comparison_lines(comparison, out))


def _comparison_lines(comparison: "Comparison", out: Path) -> list[str]:
    fit, whole = comparison.fit, comparison.regions["whole"]
    changed = [
        f"  {name}: {of.changed_share:.0%} of it, {of.largest_mm:+.2f} mm at most, {of.volume_ml:+.2f} ml"
        for name, of in comparison.regions.items()
        if name != "whole" and of.changed_share > 0.0
    ]
    lengths = [
        f"  {name}: {of.change_mm:+.1f} mm (standard deviation {of.std_mm:.1f})"
        for name, of in comparison.lengths.items()
        if of.is_sure and of.std_mm is not None
    ]
    return [
        str(out / "comparison.pdf"),
        f"aligned on forehead and bridge of the nose: scatter {fit.std_mm:.3f} mm, {fit.kept_share:.0%} of it used",
        f"changed by more than two standard deviations: {whole.changed_share:.1%} of the surface",
        *changed,
        *(lengths or ["no measurement changed by more than two standard deviations"]),
        str(out / "difference.png"),
    ]


@app.command(epilog="Example: eigenhead register heads/anna cbct/anna-skin.stl --axes LPS --out registered/anna")
def register(
    result: Result,
    surface: Annotated[
        Path,
        typer.Argument(help="The skin of a CT or CBCT, .ply, .obj, .glb or .stl, in mm.", exists=True, dir_okay=False),
    ],
    out: Annotated[Path, typer.Option(help="The folder of the registered head.", file_okay=False)],
    *,
    axes: Annotated[
        Literal["LPS", "RAS"] | None, typer.Option(help="Of the surface; by default what its header states, else LPS.")
    ] = None,
    landmarks: Annotated[
        Path | None, file_in("Of the surface, .mrk.json, .json, .pp or .ljson: three or more of docs/models.md.")
    ] = None,
    model: Model = None,
    overwrite: Overwrite = False,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Lay a head on the surface of a CT or CBCT.

    A rigid fit of the face; what contradicts the rest (swelling, a chin rest, the surfaces of skull and airways) has no
    part in it. Writes the head and its landmarks in the surface's frame, and what is left between the two."""
    prepare_folder(out, "registration.json", overwrite=overwrite)
    from pipeline.applications.clinic.patient_files import write_registration
    from pipeline.applications.clinic.registration import read_surface, read_surface_landmarks
    from pipeline.applications.clinic.registration import register as register_head
    from pipeline.applications.clinic.visit import read_visit

    patient = read_surface(surface, axes)
    marks = None if landmarks is None else read_surface_landmarks(landmarks, patient.axes)
    visit = read_visit(result, model)
    warn(*map(str, visit.warnings))
    registered = register_head(visit, patient, marks)
    document = write_registration(out, registered)
    answer(document | {"out": str(out)}, json_out, _registration_lines(document, out))


def _registration_lines(document: dict[str, Any], out: Path) -> list[str]:
    figures, surface = document["figures"], document["surface"]
    stated = "as its header states" if surface["axes_stated"] else "which it does not state"
    return [
        str(out / "head.ply"),
        f"axes {surface['axes']}, {stated}; started from {document['start']}",
        f"residual of the face: {figures['median_mm']:.3f} mm (median), {figures['rms_mm']:.3f} (RMS), "
        f"{figures['p95_mm']:.3f} (95 %); {figures['covered_share']:.0%} of it is on the surface",
        f"of the {figures['kept_share']:.0%} that the fit used: {figures['kept_std_mm']:.3f} mm (standard deviation)",
        str(out / "residual.ply"),
    ]


@app.command(epilog="Example: eigenhead measure heads/anna --sizes helmets.toml")
def measure(
    result: Result,
    *,
    sizes: Annotated[Path | None, file_in("Tables of sizes, a TOML file (docs/clinic.md).")] = None,
    model: Model = None,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Measure a head for helmets, masks and spectacles.

    Prints each measure with its standard deviation and ISO name, and of every table of sizes how likely each size
    fits."""
    from pipeline.applications.clinic.fitting import (
        ISO_NAMES,
        MEASURES,
        Fitted,
        choose_size,
        fitting_measures,
        read_size_tables,
    )
    from pipeline.applications.clinic.visit import read_visit
    from rig.messages.message import compose, documents_of

    visit = read_visit(result, model)
    tables = [] if sizes is None else read_size_tables(sizes, {*visit.measurements, *MEASURES, *ISO_NAMES})
    measures = {
        name: Fitted(of.value_mm, of.std_mm, "mm") for name, of in visit.measurements.items() if of.std_mm is not None
    }
    measures |= fitting_measures(visit)
    absent = [
        compose("size-measure-absent", table=of.name, measure=of.measure) for of in tables if of.measure not in measures
    ]
    chosen = [
        choose_size(of, measures[of.measure].value, measures[of.measure].std) for of in tables if of.measure in measures
    ]
    warn(*map(str, (*visit.warnings, *absent)))
    document = {
        "warnings": documents_of([*visit.warnings, *absent]),
        "measures": {
            name: {"value": of.value, "std": of.std, "unit": of.unit, "iso": ISO_NAMES.get(name)}
            for name, of in measures.items()
        },
        "sizes": {
            of.table: {"measure": of.measure, "best": of.best, "probabilities": dict(of.probabilities), "none": of.none}
            for of in chosen
        },
    }
    answer(document, json_out, _measure_lines(document))


def _measure_lines(document: Mapping[str, Any]) -> list[str]:
    lines = [
        f"{name:<26} {of['value']:>7.1f} {of['unit']:<3}  (standard deviation {of['std']:.1f})"
        + (f"  {of['iso']}" if of["iso"] else "")
        for name, of in document["measures"].items()
    ]
    for table, of in document["sizes"].items():
        shares = ", ".join(f"{size} {share:.0%}" for size, share in of["probabilities"].items())
        lines.append(f"{table}, by {of['measure']}: {of['best']}  ({shares}, none {of['none']:.0%})")
    return lines
