"""Implements the commands of calibration: board, calibrate, refine, convert."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from rig.files import write_atomically
from rig.messages.message import compose, texts_of
from server.cli.answers import (
    Json,
    Overwrite,
    answer,
    prepare_file,
    prepare_folder,
    progress_bar,
    switch,
    warn,
    warn_of_replacement,
    wrong_usage,
)

app = typer.Typer(rich_markup_mode=None)
CameraFormat = Literal[
    "eigenhead", "colmap", "colmap-text", "caliscope", "aniposelib", "metashape", "realitycapture",
    "realitycapture-csv", "nerfstudio", "opencv-yaml", "blender",
]  # fmt: skip


@app.command(epilog="Example: eigenhead board --kind charuco --squares 12x9 --square-mm 30 --out board.pdf")
def board(
    out: Annotated[Path, typer.Option(help="The PDF to write; board.toml goes beside it.", dir_okay=False)],
    kind: Annotated[Literal["checkerboard", "charuco"], typer.Option(help="Of the pattern.")] = "charuco",
    squares: Annotated[str, typer.Option(help="COLUMNSxROWS, counted in squares.")] = "12x9",
    square_mm: Annotated[float, typer.Option(help="Side of a square.")] = 30.0,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Write a calibration board at true scale.

    A ruler beside it checks the print."""
    from calibration.board.board import board_from_document, write_board, write_board_pdf

    if out.suffix.lower() not in ("", ".pdf"):
        raise typer.BadParameter(f"{out.suffix!r}: a board is written as .pdf", param_hint="--out")
    columns, _, rows = squares.partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise typer.BadParameter(f"{squares!r} is not like 9x6", param_hint="--squares")
    document = {"kind": kind, "columns": int(columns), "rows": int(rows), "square_mm": square_mm}
    with wrong_usage("--kind, --squares, --square-mm"):
        chosen = board_from_document(document, "board")
    for path in (out, out.with_name("board.toml")):
        prepare_file(path, overwrite=overwrite)
    paper = "{:g} x {:g} mm".format(*write_board_pdf(chosen, out))
    write_board(chosen, out.with_name("board.toml"))
    written = {"pdf": str(out), "board": str(out.with_name("board.toml"))}
    answer(written, json_out, [*written.values(), f"print on paper of {paper} at 100 %, then measure the pattern"])


@app.command(
    epilog="Example: eigenhead calibrate shots --board board.toml --out cameras.json   "
    "eigenhead calibrate photos --from scene --scale scale.json --out cameras.json"
)
def calibrate(
    images: Annotated[
        Path,
        typer.Argument(
            help="IMAGES/<camera>/<shot>.<ext>; same shot name, same moment. From a scene also IMAGES/<camera>.<ext>."
        ),
    ],
    out: Annotated[Path, typer.Option(help="The cameras.json to write; its report goes beside it.", dir_okay=False)],
    *,
    board: Annotated[Path | None, typer.Option(help="The board.toml.", exists=True, dir_okay=False)] = None,
    source: Annotated[
        Literal["board", "scene"], typer.Option("--from", help="A scene: photographs of anything.")
    ] = "board",
    scale: Annotated[
        Path | None, typer.Option(help="From a scene: a known length, scale.json.", exists=True, dir_okay=False)
    ] = None,
    lenses: Annotated[
        Literal["one", "each"] | None, typer.Option(help="From a scene: one of all cameras, or each its own; guessed.")
    ] = None,
    front: Annotated[str | None, typer.Option(help="The camera that the subject faces.")] = None,
    previous: Annotated[Path | None, typer.Option(help="The rig's last cameras.json.", exists=True)] = None,
    intrinsics_only: Annotated[
        bool, switch("--intrinsics-only", "A board: each lens alone; moments may differ.")
    ] = False,
    anyway: Annotated[bool, switch("--anyway", "Of a board: write cameras.json even where checks refuse it.")] = False,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Calibrate a rig from pictures of a board or scene."""
    warn_of_replacement(out, overwrite)
    of_board = {"--board": board, "--previous": previous, "--anyway": anyway, "--intrinsics-only": intrinsics_only}
    why = "is for a board; a scene takes none" if source == "scene" else "is for --from scene"
    for option, value in (of_board if source == "scene" else {"--scale": scale, "--lenses": lenses}).items():
        if value:
            raise typer.BadParameter(why, param_hint=option)
    prepare_file(out)
    if source == "scene":
        _calibrate_scene(images, out, scale, front, lenses, json_out)
    elif board is None:
        raise typer.BadParameter("say which board, or --from scene", param_hint="--board")
    elif intrinsics_only:
        _calibrate_lenses(images, board, out, json_out)
    else:
        _calibrate_board(images, board, out, front, previous, json_out, anyway=anyway)


def _calibrate_lenses(images: Path, board: Path, out: Path, json_out: bool) -> None:
    """Writes each camera's lens in the keys of cameras.json, without a pose, with the standard deviations of fx fy cx
    cy (px) k1 k2 p1 p2 k3."""
    from calibration.adjustment.intrinsics import estimate_lenses
    from calibration.board.board import read_board
    from calibration.board.detection import detect_folder
    from calibration.quality.outliers import drop_blurred
    from calibration.result import CalibrationRefused

    with progress_bar() as report:
        detections, _ = drop_blurred(detect_folder(images, read_board(board), together=False, report=report))
    lenses = estimate_lenses(detections)
    absent = [name for name in detections.sizes if name not in lenses]
    said = [compose("camera-without-board", camera=name, why=compose("no-picture-of-board")) for name in absent]
    if not lenses:
        raise CalibrationRefused(said)
    warn(*texts_of([*said, *(lens.weakness for lens in lenses.values() if lens.weakness)]))
    cameras = []
    for name, lens in lenses.items():
        k, figures = lens.intrinsics, {"rms_px": lens.rms_px, "views": lens.views, "sigma": lens.sigma.tolist()}
        focal = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}
        distortion = {"model": "brown-conrady", **asdict(k.distortion)}
        held = {"width": k.width, "height": k.height, "intrinsics": focal, "distortion": distortion}
        cameras.append({"name": name, **held, **figures})
    document = {"cameras": cameras}
    write_atomically(out, json.dumps(document, indent=1).encode())
    answer(document, json_out, [str(out), *(f"{name}  {lens.rms_px:.3f} px" for name, lens in lenses.items())])


def _calibrate_board(
    images: Path, board: Path, out: Path, front: str | None, previous: Path | None, json_out: bool, *, anyway: bool
) -> None:
    from calibration.board.board import read_board
    from calibration.calibrate import calibrate as run
    from calibration.report import report_page
    from calibration.result import CalibrationRefused
    from rig.formats.cameras.cameras_json import read_rig, write_rig

    known = None if previous is None else read_rig(previous)
    page = out.with_suffix(".html")
    try:
        with progress_bar() as report:
            calibration = run(images, read_board(board), front=front, previous=known, report=report)
    except CalibrationRefused as refusal:
        if refusal.calibration is None:
            raise
        write_atomically(page, report_page(refusal.calibration).encode())
        if not anyway:
            reasons = (*refusal.reasons, "its report is written, and --anyway writes cameras.json, too, for a look")
            raise CalibrationRefused(reasons, refusal.calibration) from refusal
        warn(str(refusal))
        calibration = refusal.calibration
    write_rig(calibration.rig, out)
    write_atomically(page, report_page(calibration).encode())
    figures = calibration.figures()
    cameras = [f"{name}  {figure['rms_px']:.3f} px" for name, figure in figures["cameras"].items()]
    total = f"{figures['rms_px']:.3f} px over {figures['used_share']:.1%} of the corners: {calibration.verdict().word}"
    answer(calibration.document(), json_out, [str(out), str(page), *cameras, total, *texts_of(calibration.warnings)])


def _calibrate_scene(
    photographs: Path, out: Path, scale: Path | None, front: str | None, lenses: str | None, json_out: bool
) -> None:
    from calibration.scene.result import scene_page
    from calibration.scene.scene import calibrate_scene
    from rig.formats.cameras.cameras_json import write_rig

    page = out.with_suffix(".html")
    one_lens = None if lenses is None else lenses == "one"
    with progress_bar() as report:
        calibration = calibrate_scene(photographs, scale=scale, front=front, one_lens=one_lens, report=report)
    write_rig(calibration.rig, out)
    write_atomically(page, scene_page(calibration).encode())
    figures = calibration.figures()
    cameras = [
        f"{name}  {figure['rms_px']:.3f} px, {figure['points']} points, known to {figure['pose_sigma_px']:.2f} px"
        for name, figure in figures["cameras"].items()
    ]
    total = f"{figures['rms_px']:.3f} px over {figures['points']} points; front camera {calibration.front}"
    warn(*texts_of(calibration.warnings))
    lines = [str(out), str(page), *cameras, total, f"scale: {calibration.scale.provenance}"]
    answer(calibration.document(), json_out, lines)


@app.command(epilog="Example: eigenhead refine shots/anna shots/ben shots/cleo shots/dora --out cameras.json")
def refine(
    captures: Annotated[list[Path], typer.Argument(help="Capture folders or archives, better 5 or more.", exists=True)],
    out: Annotated[Path, typer.Option(help="The cameras.json to write; its report goes beside it.", dir_okay=False)],
    *,
    calibration: Annotated[
        Path | None, typer.Option(help="Start from this cameras.json, not from the captures' own.", exists=True)
    ] = None,
    focal: Annotated[bool, typer.Option(help="Refine focal lengths too.")] = False,
    model: Annotated[str | None, typer.Option(help="A head model whose rims speak as well: a name or file.")] = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Refine a calibration by silhouettes of captures.

    The change is kept only if each capture agrees with the others."""
    warn_of_replacement(out, overwrite)
    prepare_file(out)
    from calibration.silhouette_refinement.report import refinement_page
    from rig.formats.cameras.cameras_json import write_rig
    from server.tasks.refine import refine_locally

    page = out.with_suffix(".html")
    with progress_bar() as report:
        run = refine_locally(captures, calibration=calibration, focal=focal, model=model, report=report)
    write_rig(run.refinement.rig, out)
    write_atomically(page, refinement_page(run).encode())
    verdict = "refined" if run.refinement.kept else "not changed"
    cameras = [f"{name}  {px:.2f} px at the subject" for name, px in run.refinement.change_px.items()]
    lines = [f"{out}  {verdict}: {run.refinement.reason}", str(page), *cameras, *texts_of(run.warnings)]
    answer(run.document(), json_out, lines)


@app.command(epilog="Example: eigenhead convert cameras.json --to colmap --out sparse/0")
def convert(
    source: Annotated[Path, typer.Argument(help="A rig's file, or a folder that holds one.", exists=True)],
    out: Annotated[
        Path, typer.Option(help="The file to write; for COLMAP, RealityCapture's XMP and OpenCV's YAML the folder.")
    ],
    to: Annotated[CameraFormat, typer.Option(help="The program that shall read them.")] = "eigenhead",
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Convert calibrations to and from other programs."""
    from rig.errors import InputError
    from rig.formats.cameras.cameras_file import (
        FOLDER_FORMATS,
        find_rig_file,
        no_rig_fault,
        read_cameras,
        write_rig_file,
    )
    from rig.formats.pictures.picture_names import entry
    from rig.plausibility import rig_faults

    file = find_rig_file(source) if source.is_dir() else source
    if file is None:
        raise InputError(str(source), [no_rig_fault(source)])
    read = read_cameras(file)
    rig = read.rig
    if faults := rig_faults(rig, any_unit=entry(file.parent, "scale.json").is_file()):
        raise InputError(file.name, faults)
    warn(*(f"{remark.code}: {remark}" for remark in read.remarks))
    warn_of_replacement(out, overwrite)
    prepare = prepare_folder if to in FOLDER_FORMATS else prepare_file
    prepare(out)
    write_rig_file(rig, out, to)
    answer({"out": str(out), "cameras": list(rig.names)}, json_out, [f"{out}  {len(rig)} cameras"])
