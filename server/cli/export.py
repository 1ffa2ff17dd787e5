"""Implements ``eigenhead export``, which writes a capture or a result for other programs."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from rig.errors import EigenheadError
from server.cli.answers import Data, Json, Overwrite, Overwrites, answer, file_in, prepare_folder, progress_bar, warn
from server.cli.heads import Albedo, Morphs, TemplateName

if TYPE_CHECKING:
    from rig.formats.cameras.dataset_json import DatasetFormat
    from rig.formats.meshes.markups import Axes

app = typer.Typer(rich_markup_mode=None)
LONGEST_PSEUDONYM = 64  # letters that DICOM's names and numbers of patients take

ExportFormat = Literal[
    "glb", "ply", "obj", "usdz", "stl", "3mf", "slicer", "dicom", "nifti", "nerfstudio", "gaussian-avatars"
]


@app.command(
    epilog="Example: eigenhead export heads/anna --as usdz --out usd/anna   A capture: eigenhead export shots/anna "
    "--as nerfstudio --result heads/anna --out sets/anna"
)
def export(
    source: Annotated[
        Path,
        typer.Argument(
            help="A result folder; for nerfstudio and gaussian-avatars a capture, or a .zip, .tar or .tar.gz of one.",
            exists=True,
        ),
    ],
    form: Annotated[ExportFormat, typer.Option("--as", help="The last two are of a capture.")],
    out: Annotated[Path, typer.Option(help="The folder that is written.", file_okay=False)],
    *,
    result: Annotated[
        Path | None,
        typer.Option(help="The capture's result folder: head and FLAME parameters.", exists=True, file_okay=False),
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="Of the job, a TOML or JSON file.", exists=True)] = None,
    axes: Annotated[Literal["LPS", "RAS"], typer.Option(help="For slicer.")] = "LPS",
    plane: Annotated[Literal["head", "frankfurt"], typer.Option(help="For slicer, dicom and nifti.")] = "head",
    marked: Annotated[
        Path | None, file_in("For these: porion and orbitale, marked over an export without a plane, .mrk.json.")
    ] = None,
    patient: Annotated[
        str, typer.Option(help="For dicom and nifti: a pseudonym of letters and digits, all that names the person.")
    ] = "anonymous",
    template: TemplateName = None,
    morphs: Morphs = False,
    albedo: Albedo = False,
    data: Data = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Write a finished head, or a capture, for other programs.

    A head in another format, without a new job; for 3D Slicer mesh and landmarks in a patient's axes, mm; for a
    hospital's programs without name and date. A capture as a data set: undistorted pictures, masks and cameras in
    metres."""
    from pipeline.settings import FORMATS, OutputSettings
    from server.tasks.export_result import export_result

    head, patients = form in FORMATS, form in ("slicer", "dicom", "nifti")
    unused: dict[str, object] = {
        "--axes": axes != "LPS" and form != "slicer", "--plane": plane != "head" and not patients,
        "--marked": marked and not patients, "--patient": patient != "anonymous" and form not in ("dicom", "nifti"),
        "--template": template and not head, "--morphs": morphs and not head, "--albedo": albedo and not head,
        "--result": result and (head or patients), "--settings": settings and (head or patients),
    }  # fmt: skip
    for option in filter(unused.get, unused):
        raise typer.BadParameter(f"changes nothing in {form}; leave it out", param_hint=option)
    sign = f"head.{form}" if head else "frame.json" if patients else "transforms.json"
    if head and out.resolve() == source.resolve():
        raise Overwrites(out / sign)
    prepare_folder(out, sign, overwrite=overwrite)
    if form in FORMATS:
        outputs = OutputSettings(formats=(form,), template=template, morphs=morphs, albedo="file" if albedo else "none")
        files = export_result(source, out, outputs)
        answer({"out": str(out), "files": files}, json_out, [f"{out}  {', '.join(files)}"])
    elif form in ("slicer", "dicom", "nifti"):
        _export_patient(source, out, form, axes, plane, marked=marked, patient=patient, json_out=json_out)
    else:
        _export_dataset(source, out, form, result=result, settings=settings, json_out=json_out)


def _export_dataset(
    capture: Path, out: Path, form: "DatasetFormat", *, result: Path | None, settings: Path | None, json_out: bool
) -> None:
    """Writes a capture as a data set."""
    from pipeline.settings import settings_from_document
    from server.cli.reconstruct_local import check_apart
    from server.tasks.export_dataset import FOUND, export_folder
    from server.tasks.reconstruct import folder_of
    from server.tasks.settings_file import settings_document

    wanted = settings_from_document(settings_document(settings))
    check_apart(out, capture)
    found_before = (out / FOUND).exists()
    try:
        with progress_bar() as report, folder_of(capture) as folder:
            figures, warnings = export_folder(folder, out, form, result=result, chosen=wanted, report=report)
    except EigenheadError:
        if not found_before:
            shutil.rmtree(out / FOUND, ignore_errors=True)
        raise
    warn(*(f"{warning.code}: {warning}" for warning in warnings))
    summary = (
        f"{len(figures['cameras'])} views"
        + (", FLAME parameters" if figures["flame"] else "")
        + (f", without {', '.join(figures['left_out'])}" if figures["left_out"] else "")
    )
    answer({"out": str(out), "as": form, **figures}, json_out, [f"{out}  {summary}"])


def _export_patient(
    result: Path,
    out: Path,
    form: "Literal['slicer', 'dicom', 'nifti']",
    axes: "Axes",
    plane: str,
    *,
    marked: Path | None,
    patient: str,
    json_out: bool,
) -> None:
    """Writes a result's head in a patient's axes."""
    if not (patient.isascii() and patient.isalnum() and len(patient) <= LONGEST_PSEUDONYM):
        raise typer.BadParameter(f"at most {LONGEST_PSEUDONYM} letters and digits", param_hint="--patient")
    from pipeline.applications.clinic.anatomical_frame import frankfurt_axes, head_axes
    from pipeline.applications.clinic.hospital_files import HOSPITAL_AXES, write_hospital_files
    from pipeline.applications.clinic.patient_files import marked_points, write_patient_files
    from pipeline.applications.clinic.visit import read_visit

    visit = read_visit(result)
    points = marked_points(marked, visit, axes)
    axes = axes if form == "slicer" else HOSPITAL_AXES[form]
    in_plane = plane == "frankfurt" or marked is not None
    frame = frankfurt_axes(visit.measured, axes, points) if in_plane else head_axes(visit.measured, axes)
    if form == "slicer":
        document = write_patient_files(out, visit, frame)
    else:
        document = write_hospital_files(out, visit, frame, form, patient)
    lines = [f"{out}  {frame.axes}, {'Frankfurt plane' if in_plane else 'the attitude of the head frame'}"]
    if frame.tilt_deg is not None:
        lines.append(
            f"the head frame is tilted by {frame.tilt_deg:+.1f} degrees (standard deviation {frame.tilt_std_deg:.1f})"
        )
        lines += [f"  {name}: {source}" for name, source in frame.sources.items()]
    answer(document | {"out": str(out)}, json_out, lines)
