"""The command line ``eigenhead``. Everything heavy is imported inside the commands, so that --help answers at once."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from rig.errors import EigenheadError

app = typer.Typer(
    name="eigenhead",
    help="One shot of a calibrated camera rig in, a textured 3D head with its uncertainty out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # importing rich's markdown alone takes half a second
    context_settings={"help_option_names": ["-h", "--help"]},
)
keys_app = typer.Typer(help="API keys of the service.", no_args_is_help=True, rich_markup_mode=None)
rig_app = typer.Typer(help="The real rig of a rig.toml.", no_args_is_help=True, rich_markup_mode=None)
model_app = typer.Typer(help="Head models.", no_args_is_help=True, rich_markup_mode=None)
for group, name in ((keys_app, "keys"), (rig_app, "rig"), (model_app, "model")):
    app.add_typer(group, name=name)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
Data = Annotated[Path | None, typer.Option(help="The service's data folder.", file_okay=False)]
RigFile = Annotated[Path, typer.Option("--rig", help="The rig.toml.", exists=True, dir_okay=False)]
Report = Callable[[str, float], None]


def main() -> None:
    """Entry point: 0 done, 1 failed with one clear line on stderr, 2 wrong usage."""
    try:
        app()
    except EigenheadError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if os.environ.get("EIGENHEAD_DEBUG"):
            raise
        _fail(f"{type(error).__name__}: {error} (EIGENHEAD_DEBUG=1 shows where)")


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
    from server.log import set_up
    from server.serve import run_service

    settings = _settings(data=data, host=host, port=port, rig=rig, console=console)
    set_up(settings.log_json)
    run_service(settings, worker=worker, ready=lambda url: print(f"eigenhead listens on {url}", file=sys.stderr))


@app.command(epilog="Example: EIGENHEAD_DATABASE_URL=postgresql://db/eigenhead eigenhead worker --data /mnt/heads")
def worker(
    data: Data = None,
    queue: Annotated[str | None, typer.Option(help="The queue to serve.")] = None,
    concurrency: Annotated[int | None, typer.Option(help="Jobs at once.", min=1)] = None,
    until_eof: Annotated[bool, typer.Option("--until-eof", hidden=True)] = False,
) -> None:
    """Run a worker that takes jobs from the service's queue."""
    from server.log import set_up
    from server.worker import run_worker

    settings = _settings(data=data, queue=queue, concurrency=concurrency)
    set_up(settings.log_json)
    run_worker(settings, until_eof=until_eof)


@app.command(epilog="Example: eigenhead reconstruct shots/anna.tar.gz --out heads/anna --method contour")
def reconstruct(
    capture: Annotated[Path, typer.Argument(help="A capture folder, or a .zip, .tar or .tar.gz of one.", exists=True)],
    out: Annotated[Path, typer.Option(help="The result folder.", file_okay=False)],
    method: Annotated[str | None, typer.Option(help="contour or simplex.")] = None,
    model: Annotated[str | None, typer.Option(help="A model's name or file.")] = None,
    front: Annotated[str | None, typer.Option(help="The camera that the subject faces.")] = None,
    detail: Annotated[str | None, typer.Option(help="span, kernel or photo.")] = None,
    settings: Annotated[Path | None, typer.Option(help="More settings, a TOML or JSON file.", exists=True)] = None,
    json_out: Json = False,
) -> None:
    """Reconstruct one capture without the service."""
    from server.local import reconstruct_locally, settings_document

    document = settings_document(settings, method=method, front=front, detail=detail)
    with _progress() as report:
        written = reconstruct_locally(capture, out, model=model, settings=document, report=report)
    _answer(written, json_out, [f"{out / 'head.ply'}"])


@app.command(
    epilog="Example: eigenhead simulate shots/anna --seed 7 --fault bumped:cam03=0.5   "
    "eigenhead simulate studio --serve --port 8700"
)
def simulate(
    out: Annotated[
        Path | None,
        typer.Argument(help="The capture folder to write (--serve: the rig's); the truth goes to OUT.truth."),
    ] = None,
    subject: Annotated[str, typer.Option(help="random, mean, or a mesh file (head frame, mm).")] = "random",
    seed: Annotated[int, typer.Option(help="Of subject, looks, pose and noise.", min=0)] = 0,
    noise: Annotated[float | None, typer.Option(help="Sensor noise, share of full scale.", min=0, max=1)] = None,
    light_drift: Annotated[float | None, typer.Option(help="From plate to shot, share.", min=0, max=1)] = None,
    defocus: Annotated[float | None, typer.Option(help="Blur, pixels.", min=0)] = None,
    rolling_ms: Annotated[float | None, typer.Option(help="Readout of a rolling shutter.", min=0, max=200)] = None,
    hair: Annotated[bool, typer.Option(help="Give the subject hair.")] = True,
    fault: Annotated[list[str] | None, typer.Option(help="KIND[:CAMERA][=AMOUNT]; may be repeated.")] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Keep the studio running as cameras and a trigger box, until Ctrl-C.")
    ] = False,
    port: Annotated[int, typer.Option(help="--serve: of the cameras; 0 takes a free one.", min=0, max=65535)] = 0,
    fps: Annotated[float, typer.Option(help="--serve: of the live views.", min=0.5, max=30)] = 4.0,
    json_out: Json = False,
) -> None:
    """Take a capture with the simulated studio, and write the truth beside it; or serve the studio as real devices.

    --serve opens eleven motion-JPEG cameras and a trigger box, and writes OUT/rig.toml (OUT is "studio" where none is
    given) with which the rig commands and the service work as with a real rig."""
    from dataclasses import replace

    from rig.render.renderer import Renderer
    from rig.studio.preset import PRESET
    from server.shoot import simulate_folder

    chosen = {"noise": noise, "light_drift": light_drift, "defocus_px": defocus, "rolling_ms": rolling_ms}
    preset = replace(PRESET, hair=hair and PRESET.hair, **{k: v for k, v in chosen.items() if v is not None})
    if serve:
        _serve_studio(out or Path("studio"), json_out, port=port, fps=fps, subject=subject, seed=seed, preset=preset,
                      faults=fault or [])  # fmt: skip
        return
    if out is None:
        raise typer.BadParameter("say where the capture goes, or --serve", param_hint="OUT")
    with _progress() as report, Renderer.create() as renderer:
        report("simulate", 0.0)
        truth = simulate_folder(out, subject=subject, seed=seed, preset=preset, faults=fault or [], renderer=renderer)
    _answer({"capture": str(out), "truth": str(truth)}, json_out, [str(out), str(truth)])


def _serve_studio(folder: Path, json_out: bool, **options: Any) -> None:
    """Serves until Ctrl-C, which is how it ends well."""
    from contextlib import ExitStack, suppress

    from server.studio import OpenStudio, serve_studio

    with ExitStack() as bar, suppress(KeyboardInterrupt):
        report = bar.enter_context(_progress())

        def ready(studio: OpenStudio) -> None:
            bar.close()
            _answer(studio.document(), json_out, studio.lines())
            sys.stdout.flush()

        serve_studio(folder, ready=ready, report=report, **options)


@app.command(epilog="Example: eigenhead demo --out out/demo")
def demo(
    out: Annotated[Path, typer.Option(help="Where the result goes.", file_okay=False)] = Path("out/demo"),
    seed: Annotated[int, typer.Option(help="Subject and noise of the simulated studio.", min=0)] = 1,
    json_out: Json = False,
) -> None:
    """The main job end to end: simulated rig, capture, service, head."""
    from server.demo import run_demo

    with _progress() as report:
        done = run_demo(out, seed=seed, report=report)
    error = done["error_mm"]
    _answer(
        done,
        json_out,
        [
            f"head           {done['ply']}",
            f"contact sheet  {done['contact_sheet']}",
            f"error          {error['median']:.2f} mm median, {error['mean']:.2f} mm mean, {error['max']:.2f} mm max",
            *(
                f"  {name:<12} {of['error_mm']['mean']:.2f} mm mean, {of['seconds']:.1f} s, {of['evaluations']} steps"
                for name, of in done["methods"].items()
            ),
            f"time           {done['seconds']:.1f} s",
        ],
    )


@app.command(epilog="Example: eigenhead doctor")
def doctor(data: Data = None, json_out: Json = False) -> None:
    """Say what is wrong with this machine, and what to do."""
    from server.doctor import examine

    findings = examine(_settings(data=data))
    width = max(len(name) for name in findings)
    lines = [f"{'ok   ' if f['ok'] else 'WRONG'}  {name:<{width}}  {f['detail']}" for name, f in findings.items()]
    _answer(findings, json_out, lines)
    if not all(finding["ok"] for finding in findings.values()):
        sys.exit(1)


@app.command(epilog="Example: eigenhead board --kind charuco --squares 9x6 --square-mm 25 --out board.pdf")
def board(
    out: Annotated[Path, typer.Option(help="The PDF to write; board.toml goes beside it.", dir_okay=False)],
    kind: Annotated[str, typer.Option(help="checkerboard or charuco.")] = "checkerboard",
    squares: Annotated[str, typer.Option(help="COLUMNSxROWS, counted in squares.")] = "9x6",
    square_mm: Annotated[float, typer.Option(help="Side of a square.")] = 25.0,
    json_out: Json = False,
) -> None:
    """Write a calibration board at true scale, with a ruler to check the print."""
    from calibration.board import board_from_document, write_board, write_board_pdf

    columns, _, rows = squares.partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise typer.BadParameter(f"{squares!r} is not like 9x6", param_hint="--squares")
    document = {"kind": kind, "columns": int(columns), "rows": int(rows), "square_mm": square_mm}
    chosen = board_from_document(document, "board")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_board_pdf(chosen, out)
    write_board(chosen, out.with_name("board.toml"))
    written = {"pdf": str(out), "board": str(out.with_name("board.toml"))}
    _answer(written, json_out, list(written.values()))


@app.command(epilog="Example: eigenhead calibrate shots --board board.toml --out cameras.json")
def calibrate(
    images: Annotated[Path, typer.Argument(help="IMAGES/<camera>/<shot>.<ext>; same shot name, same moment.")],
    board: Annotated[Path, typer.Option(help="The board.toml.", exists=True, dir_okay=False)],
    out: Annotated[Path, typer.Option(help="The cameras.json to write; its report goes beside it.", dir_okay=False)],
    front: Annotated[str | None, typer.Option(help="The camera that the subject faces.")] = None,
    previous: Annotated[Path | None, typer.Option(help="The rig's last cameras.json.", exists=True)] = None,
    json_out: Json = False,
) -> None:
    """Calibrate a rig from pictures of a board."""
    from calibration.board import read_board
    from calibration.calibrate import CalibrationRefused, write_calibration
    from calibration.calibrate import calibrate as run
    from calibration.report import write_report
    from rig.layout import read_rig

    known = None if previous is None else read_rig(previous)
    page = out.with_suffix(".html")
    try:
        with _progress() as report:
            found = run(images, read_board(board), front=front, previous=known, report=report)
    except CalibrationRefused as refusal:
        if refusal.calibration is not None:
            write_report(refusal.calibration, page)
        raise
    write_calibration(found, out)
    write_report(found, page)
    figures = found.figures()
    cameras = [f"{name}  {figure['rms_px']:.3f} px" for name, figure in figures["cameras"].items()]
    total = f"{figures['rms_px']:.3f} px over {figures['used_share']:.1%} of the corners"
    _answer(found.document(), json_out, [str(out), str(page), *cameras, total, *found.warnings])


@app.command(epilog="Example: eigenhead refine shots/anna shots/ben shots/cleo shots/dora --out cameras.json")
def refine(
    captures: Annotated[list[Path], typer.Argument(help="Capture folders or archives, better 5 or more.", exists=True)],
    out: Annotated[Path, typer.Option(help="The cameras.json to write; its report goes beside it.", dir_okay=False)],
    calibration: Annotated[
        Path | None, typer.Option(help="Start from this cameras.json, not from the captures' own.", exists=True)
    ] = None,
    focal: Annotated[bool, typer.Option(help="Refine focal lengths too.")] = False,
    model: Annotated[str | None, typer.Option(help="A head model whose rims speak as well: a name or file.")] = None,
    json_out: Json = False,
) -> None:
    """Refine a calibration by the silhouettes of several captures; kept only if each agrees with the others."""
    from calibration.refinement_report import refinement_page
    from rig.files import write_atomically
    from rig.layout import write_rig
    from server.refine import refine_locally

    page = out.with_suffix(".html")
    with _progress() as report:
        run = refine_locally(captures, calibration=calibration, focal=focal, model=model, report=report)
    write_rig(run.refinement.rig, out)
    write_atomically(page, refinement_page(run).encode())
    verdict = "refined" if run.refinement.kept else "not changed"
    cameras = [f"{name}  {px:.2f} px at the subject" for name, px in run.refinement.change_px.items()]
    _answer(
        run.document(), json_out, [f"{out}  {verdict}: {run.refinement.reason}", str(page), *cameras, *run.warnings]
    )


@app.command(epilog="Example: eigenhead convert cameras.json --to colmap --out sparse/0")
def convert(
    source: Annotated[Path, typer.Argument(help="A rig's file, or a folder that holds one.", exists=True)],
    out: Annotated[Path, typer.Option(help="The file to write; for COLMAP the folder.")],
    to: Annotated[str, typer.Option(help="eigenhead, colmap, colmap-text, caliscope or aniposelib.")] = "eigenhead",
    json_out: Json = False,
) -> None:
    """Turn a calibration into another program's format, or another program's into ours."""
    from rig.errors import InputError
    from rig.layout_files import find_rig_file, read_rig_file, write_rig_file

    file = find_rig_file(source) if source.is_dir() else source
    if file is None:
        raise InputError(str(source), ["holds no cameras.json, COLMAP model, camera_array.toml or aniposelib file"])
    rig = read_rig_file(file)
    write_rig_file(rig, out, to)
    _answer({"out": str(out), "cameras": list(rig.names)}, json_out, [f"{out}  {len(rig)} cameras"])


@rig_app.command("check", epilog="Example: eigenhead rig check --rig rig.toml")
def rig_check(rig: RigFile = Path("rig.toml"), json_out: Json = False) -> None:
    """Open every camera, take a test shot, and print what to act on."""
    from rig.config import read_rig_config
    from rig.operate import COLUMNS, check

    found = check(read_rig_config(rig))
    widths = [max(len(row[i]) for row in (COLUMNS, *found.rows)) for i in range(len(COLUMNS))]
    lines = ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)) for row in (COLUMNS, *found.rows)]
    lines += [str(fault) for fault in found.faults if fault.camera is None]
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in found.rows]
    faults = [{"code": f.code, "camera": f.camera, "detail": f.detail} for f in found.faults]
    _answer({"healthy": found.healthy, "cameras": rows, "faults": faults}, json_out, lines)
    if not found.healthy:
        sys.exit(1)


@rig_app.command("preview", epilog="Example: eigenhead rig preview --rig rig.toml --out sheet.jpg")
def rig_preview(
    out: Annotated[Path, typer.Option(help=".jpg or .png", dir_okay=False)] = Path("preview.jpg"),
    rig: RigFile = Path("rig.toml"),
    json_out: Json = False,
) -> None:
    """Write a contact sheet of what every camera sees."""
    from rig.config import read_rig_config
    from rig.operate import preview

    faults = [str(fault) for fault in preview(read_rig_config(rig), out)]
    _answer({"sheet": str(out), "faults": faults}, json_out, [str(out), *faults])


@rig_app.command("capture", epilog="Example: eigenhead rig capture --rig rig.toml --out shots/anna")
def rig_capture(
    out: Annotated[Path | None, typer.Argument(help="The capture folder to write.", show_default=False)] = None,
    out_option: Annotated[
        Path | None, typer.Option("--out", help="The same; without either captures/<date>-<time>, UTC.")
    ] = None,
    rig: RigFile = Path("rig.toml"),
    json_out: Json = False,
) -> None:
    """Take one synchronised shot into a capture folder."""
    from datetime import UTC, datetime
    from time import monotonic

    from rig.config import read_rig_config
    from rig.operate import capture

    if out is not None and out_option is not None:
        raise typer.BadParameter("the capture folder is named twice", param_hint="--out")
    folder = out or out_option or Path("captures") / datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    at: dict[str, float] = {}
    with _progress() as progress:

        def report(stage: str, fraction: float) -> None:
            at[stage] = monotonic()
            progress(stage, fraction)

        shot = capture(read_rig_config(rig), folder, report=report)
    seconds = {"warm_up": round(at["shot"] - at["warm up"], 3), "capture": round(at["done"] - at["shot"], 3)}
    told = f"{len(shot.images)} pictures in {seconds['capture']:.2f} s, after {seconds['warm_up']:.2f} s of warm-up"
    document = {"capture": str(folder), "seconds": seconds} | shot.document()
    _answer(document, json_out, [str(folder), told, *shot.certificate.lines(), *map(str, shot.faults)])


@rig_app.command("board", epilog="Example: eigenhead rig board --rig rig.toml --shots 25 --out board-shots")
def rig_board(
    out: Annotated[Path, typer.Option(help="The folder that `eigenhead calibrate` reads.", file_okay=False)],
    rig: RigFile = Path("rig.toml"),
    shots: Annotated[int, typer.Option(help="How many.", min=1)] = 25,
    pause_s: Annotated[float, typer.Option(help="Before each, to move the board and hold it still.", min=0)] = 4.0,
    json_out: Json = False,
) -> None:
    """Take shots of the calibration board with every camera."""
    from rig.config import read_rig_config
    from rig.operate import board_shots

    document = []
    for name, cameras, faults in board_shots(read_rig_config(rig), out, shots, pause_s=pause_s):
        told = [str(fault) for fault in faults]
        print(f"{name}  {len(cameras)} pictures  {'; '.join(told)}".rstrip(), file=sys.stderr)
        document.append({"shot": name, "cameras": list(cameras), "faults": told})
    _answer({"images": str(out), "shots": document}, json_out, [f"{out}  {len(document)} shots"])


@rig_app.command("plates", epilog="Example: eigenhead rig plates --rig rig.toml")
def rig_plates(rig: RigFile = Path("rig.toml"), json_out: Json = False) -> None:
    """Take new clean plates of the empty studio."""
    from rig.config import read_rig_config
    from rig.operate import take_plates

    taken = sorted(take_plates(read_rig_config(rig)).files)
    _answer({"cameras": taken}, json_out, [f"clean plates of {len(taken)} cameras"])


@model_app.command("list", epilog="Example: eigenhead model list")
def model_list(json_out: Json = False) -> None:
    """List the head models at hand."""
    from pipeline.eigenheads.model import list_models

    found = {name: str(path) for name, path in list_models().items()}
    _answer({"models": found}, json_out, [f"{name}  {path}" for name, path in found.items()])


@model_app.command("info", epilog="Example: eigenhead model info --json")
def model_info(
    name: Annotated[str, typer.Argument(help="A model's name or file.")] = "default", json_out: Json = False
) -> None:
    """Say what a head model is made of."""
    from pipeline.eigenheads.info import model_info as describe
    from pipeline.eigenheads.model import load_model

    document = describe(load_model(name))
    _answer(document, json_out, [f"{key:<18} {value}" for key, value in document.items() if key != "figures"])


@model_app.command("import", epilog="Example: eigenhead model import ICT-FaceKit --name ict")
def model_import(
    source: Annotated[Path, typer.Argument(help="ICT-FaceKit, statismo or Basel HDF5, or npz.", exists=True)],
    name: Annotated[str | None, typer.Option(help="What to call it.")] = None,
    json_out: Json = False,
) -> None:
    """Make a foreign head model one of ours."""
    from pipeline.eigenheads.imports import import_model
    from pipeline.eigenheads.model import models_folder, save_model

    with _progress() as report:
        parts = import_model(source, name=name, report=report)
        path = models_folder() / f"{parts.name}.npz"
        save_model(path, parts)
    _answer({"name": parts.name, "file": str(path)}, json_out, [f"{parts.name}  {path}"])


@model_app.command("build", epilog="Example: eigenhead model build scans --out model.npz")
def model_build(
    scans: Annotated[Path, typer.Argument(help="A folder of PLY, OBJ or GLB scans and their landmarks.", exists=True)],
    out: Annotated[Path, typer.Option(help="The model file to write.", dir_okay=False)],
    name: Annotated[str | None, typer.Option(help="What to call it.")] = None,
    skip_bad: Annotated[bool, typer.Option(help="Leave out scans that cannot be used, instead of stopping.")] = False,
    json_out: Json = False,
) -> None:
    """Build a head model from raw scans (section 3.2)."""
    from pipeline.eigenheads.build import build_model

    with _progress() as report:
        built = build_model(scans, out, name=name or out.stem, on_bad="skip" if skip_bad else "stop", report=report)
    document = {
        "file": str(out),
        "used": list(built.used),
        "repaired": {scan: list(words) for scan, words in built.repaired.items()},
        "skipped": dict(built.skipped),
    }
    told = [f"repaired {scan}: {'; '.join(words)}" for scan, words in built.repaired.items()]
    told += [f"left out {scan}: {why}" for scan, why in built.skipped.items()]
    _answer(document, json_out, [*told, f"{out}  from {len(built.used)} scans"])


@model_app.command("fetch", epilog="Example: eigenhead model fetch ict-facekit")
def model_fetch(
    name: Annotated[str, typer.Argument(help="ict-facekit.")],
    source: Annotated[str | None, typer.Option(help="Another address or folder to take it from.")] = None,
    json_out: Json = False,
) -> None:
    """Fetch a published head model, show its licence, and make it one of ours."""
    from pipeline.eigenheads.fetch import fetch_model

    with _progress() as report:
        fetched = fetch_model(name, source=source, report=report)
    document = {"name": name, "file": str(fetched.path), "commit": fetched.commit, "licence": fetched.licence_text}
    _answer(document, json_out, [fetched.licence_text, f"{name}  {fetched.path}"])


@model_app.command("show", epilog="Example: eigenhead model show default --out out/model")
def model_show(
    name: Annotated[str, typer.Argument(help="A model's name or file.")] = "default",
    out: Annotated[Path, typer.Option(help="Folder for the pictures.", file_okay=False)] = Path("out/model"),
    modes: Annotated[int, typer.Option(help="How many modes to draw.", min=1)] = 5,
    json_out: Json = False,
) -> None:
    """Draw a model's modes, a correspondence, and how compact, general and specific it is (figures 2 and 3)."""
    from pipeline.eigenheads.model import load_model
    from pipeline.eigenheads.show import show_model

    with _progress() as report:
        drawn = [str(path) for path in show_model(load_model(name), out, modes=modes, report=report)]
    _answer({"pictures": drawn}, json_out, drawn)


@app.command(epilog="Example: eigenhead experiments limit --subjects 3 --json")
def experiments(
    name: Annotated[
        str,
        typer.Argument(
            help="table1, table2, table3, cost, levels, peers, limit, robustness, convergence, alignment, posterior, "
            "views, span or detail."
        ),
    ],
    model: Annotated[str, typer.Option(help="A model's name or file.")] = "default",
    subjects: Annotated[int | None, typer.Option(help="How many, instead of the experiment's own.", min=1)] = None,
    simplex: Annotated[
        int | None, typer.Option(help="table1 to table3: how many of them the simplex fits too (a minute each).", min=0)
    ] = None,
    shared: Annotated[Path, typer.Option(help="Where captures/ and ict-facekit/ are.")] = Path("../shared/data"),
    out: Annotated[
        Path | None, typer.Option(help="Keeps rows there, so that a stopped run goes on; and the table and pictures.")
    ] = None,
    json_out: Json = False,
) -> None:
    """Repeat the paper's experiments, and ours."""
    from server.experiments import run_experiment

    with _progress() as report:
        found = run_experiment(
            name, model=model, subjects=subjects, simplex=simplex, shared=shared, folder=out, report=report
        )
    _answer(found, json_out, [f"{key:<40} {value:.6g}" for key, value in found["figures"].items()])


@keys_app.command("add", epilog="Example: eigenhead keys add console --scope read --scope capture --scope submit")
def keys_add(
    name: str,
    scope: Annotated[list[str], typer.Option(help="read, capture, submit or admin; may be repeated.")] = ["admin"],  # noqa: B006
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Make an API key; it is shown this once."""
    from server.access import SCOPES

    unknown = set(scope) - set(SCOPES)
    if unknown:
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: there are {', '.join(SCOPES)}", param_hint="--scope")
    with _keys(data) as keys:
        key = keys.add(name, tuple(scope))
    _answer({"id": key.split("_")[1], "key": key}, json_out, [key])


@keys_app.command("list", epilog="Example: eigenhead keys list")
def keys_list(data: Data = None, json_out: Json = False) -> None:
    """List the API keys, without their secrets."""
    with _keys(data) as keys:
        found = keys.all()
    _answer({"keys": found}, json_out, [f"{key['id']}  {key['name']}  {' '.join(key['scopes'])}" for key in found])


@keys_app.command("remove", epilog="Example: eigenhead keys remove 3f2a90b1c4d5")
def keys_remove(key_id: str, data: Data = None) -> None:
    """Revoke an API key."""
    with _keys(data) as keys:
        keys.remove(key_id)


@contextmanager
def _keys(data: Path | None) -> Iterator[Any]:
    from server.access import Keys
    from server.database import open_database

    engine = open_database(_settings(data=data))
    try:
        yield Keys(engine)
    finally:
        engine.dispose()


def _settings(**given: Any) -> Any:
    """The service's settings: options over variables over defaults. A wrong variable is wrong usage."""
    from pydantic import ValidationError

    from server.settings import ServiceSettings

    try:
        return ServiceSettings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise typer.BadParameter(faults) from error


@contextmanager
def _progress() -> Iterator[Report]:
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


def _answer(document: Any, as_json: bool, lines: list[str]) -> None:
    print(json.dumps(document, allow_nan=False) if as_json else "\n".join(lines))


def _fail(message: str) -> NoReturn:
    print(f"eigenhead: {message}", file=sys.stderr)
    sys.exit(1)


if __name__ == "__main__":
    main()
