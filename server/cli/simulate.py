"""Implements ``eigenhead simulate``: captures of the simulated studio, and the studio as cameras and a trigger box."""

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.studio.sensor.faults import KINDS, fault_from_text
from server.cli.answers import Json, Overwrite, Overwrites, answer, number, prepare_folder, progress_bar, wrong_usage
from server.cli.moments import film_sequence

if TYPE_CHECKING:
    from rig.studio.sensor.preset import Preset

MAX_GAZE_DEG = 35.0  # of the studio's eyeballs: lids hide more
BOARD_SHOTS = 24  # calibrate advises 20 or more
app = typer.Typer(rich_markup_mode=None)

HairNames = Annotated[
    str | None,
    typer.Option(
        help="NAME[,NAME]: short, over-ears, long, curly, fringe, bun, beard, bald, cap, swim-cap, wig-cap, glasses."
    ),
]

Expressions = Annotated[
    list[str] | None, typer.Option(help="NAME=WEIGHT, 0 to 1; may be repeated. `eigenhead model info` lists the names.")
]
Gaze = Annotated[
    tuple[float, float] | None, typer.Option(help="Azimuth (to the subject's left) and elevation of the eyes, degrees.")
]
Faults = Annotated[
    list[str] | None, typer.Option(help=f"KIND[:CAMERA][=AMOUNT]; may be repeated. Kinds: {', '.join(KINDS)}.")
]
BoardShots = Annotated[bool, typer.Option("--board", help="OUT/CAMERA/SHOT.png of a board, and board.toml.")]
BoardFile = Annotated[Path | None, typer.Option(help="--board: of your own board; else 12 x 9 of 30 mm.", exists=True)]
Realism = Annotated[
    str | None, typer.Option(help="NAME[,NAME] of real photographs: smooth, oily, scattering, mosaic, jpeg; or all.")
]
Frames = Annotated[int | None, typer.Option(help="Frames of a subject that moves and speaks.", min=2)]
Served = Annotated[bool, typer.Option("--serve", help="Run the studio as cameras and a trigger box, until Ctrl-C.")]


@app.command(
    epilog="Example: eigenhead simulate shots/anna --seed 7 --fault bumped:cam03=0.5   "
    "eigenhead simulate studio --serve --port 8700   eigenhead simulate shots --board"
)
def simulate(
    out: Annotated[
        Path | None,
        typer.Argument(help="The capture folder to write (--serve: the rig's); the truth goes to OUT.truth."),
    ] = None,
    *,
    subject: Annotated[str, typer.Option(help="random, mean, or a mesh file (head frame, mm).")] = "random",
    seed: Annotated[int, typer.Option(help="Of subject, looks, pose and noise.", min=0)] = 0,
    noise: Annotated[float | None, number("Sensor noise, share of full scale.", min=0, max=1)] = None,
    light_drift: Annotated[float | None, number("From plate to shot, share.", min=0, max=1)] = None,
    defocus: Annotated[float | None, number("Blur, pixels.", min=0)] = None,
    rolling_ms: Annotated[float | None, number("Readout of a rolling shutter.", min=0, max=200)] = None,
    hair: HairNames = None,
    realism: Realism = None,
    no_hair: Annotated[bool, typer.Option("--no-hair", help="Neither hair nor beard.")] = False,
    polarised: Annotated[bool, typer.Option("--polarised", help="Also the texture sets cross and parallel.")] = False,
    expression: Expressions = None,
    gaze: Gaze = None,
    fault: Faults = None,
    board: BoardShots = False,
    board_file: BoardFile = None,
    sequence: Frames = None,
    serve: Served = False,
    port: Annotated[int, typer.Option(help="--serve: of the cameras; 0 takes a free one.", min=0, max=65535)] = 0,
    fps: Annotated[float, number("--serve: of the live views.", min=0.5, max=30)] = 4.0,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Take a capture with the simulated studio.

    The truth is written beside it. --serve opens eleven motion-JPEG cameras and a trigger box, and writes OUT/rig.toml
    (OUT is "studio" where none is given) with which the rig commands and the service work as with a real rig."""
    chosen: dict[str, Any] = {"noise": noise, "light_drift": light_drift, "defocus_px": defocus}
    chosen |= {"rolling_ms": rolling_ms, "hair": not no_hair, "polarised": polarised}
    chosen["hairstyle"] = tuple(hair.split(",")) if hair else ()
    preset = _studio_preset(realism, **chosen)
    _check_use(gaze, served_board=serve and (board or board_file is not None))
    if serve:
        from server.tasks.subjects import SubjectChoice

        seated = SubjectChoice(subject, expression or [], gaze)
        _serve_studio(out or Path("studio"), json_out, port=port, fps=fps, subject=seated, seed=seed, preset=preset,
                      faults=fault or [])  # fmt: skip
        return
    if out is None:
        raise typer.BadParameter("say where the capture goes, or --serve", param_hint="OUT")
    if board or board_file:
        return _photograph_board(out, board_file, seed, overwrite, json_out)
    _check_planted(fault or [], expression or [])
    _make_way(out, overwrite)
    if sequence:
        return film_sequence(out, sequence, seed, preset, json_out)
    from rig.render.renderer import Renderer
    from server.tasks.subjects import simulate_folder

    with progress_bar() as report, Renderer.create() as renderer:
        report("simulate", 0.0)
        truth = simulate_folder(out, subject=subject, seed=seed, preset=preset, faults=fault or [], renderer=renderer,
                                expression=expression or [], gaze_deg=gaze)  # fmt: skip
    answer({"capture": str(out), "truth": str(truth)}, json_out, [str(out), str(truth)])


def _check_use(gaze: tuple[float, float] | None, *, served_board: bool) -> None:
    """Raises typer.BadParameter for eyes turned too far aside, and for a board with ``--serve``."""
    if gaze is not None and not max(map(abs, gaze)) <= MAX_GAZE_DEG:
        raise typer.BadParameter(f"at most {MAX_GAZE_DEG} degrees", param_hint="--gaze")
    if served_board:
        raise typer.BadParameter("is for OUT, not for --serve", param_hint="--board")


def _studio_preset(realism: str | None, **chosen: Any) -> "Preset":
    """Returns the studio's preset with the chosen values. Raises typer.BadParameter for an unknown name in
    ``realism``."""
    from dataclasses import replace

    from rig.studio.sensor.preset import PRESET, made_real, realism_names

    with wrong_usage("--realism"):
        named = {key: value for key, value in chosen.items() if value is not None}
        return made_real(replace(PRESET, **named), realism_names(realism))


def _check_planted(faults: list[str], expression: list[str]) -> None:
    """Raises typer.BadParameter for faults or expressions that are unknown."""
    with wrong_usage("--fault"):
        for text in faults:
            fault_from_text(text)
    if expression:
        from pipeline.head_model.expressions import weights_from_text
        from pipeline.head_model.model import load_model

        with wrong_usage("--expression"):
            weights_from_text(expression, load_model().expressions.names)


def _photograph_board(out: Path, board_file: Path | None, seed: int, overwrite: bool, json_out: bool) -> None:
    """Writes ``BOARD_SHOTS`` pictures of the board by each of the studio's cameras as <camera>/<shot>.png, board.toml,
    and beside them the true cameras."""
    import numpy as np

    from calibration.board.board import Board, board_poses, photograph_board, read_board, write_board
    from rig.formats.cameras.cameras_json import write_rig
    from rig.formats.pictures.images import write_image
    from rig.studio.scene.layout import default_layout

    board = read_board(board_file) if board_file else Board("charuco", 12, 9, 30.0)
    rng, studio = np.random.default_rng(seed), default_layout()
    _make_way(out, overwrite, "board.toml")
    with progress_bar() as report:
        for shot, pose in enumerate(board_poses(board, BOARD_SHOTS, rng)):
            report("simulate", shot / BOARD_SHOTS)
            for camera in studio:
                write_image(out / camera.name / f"{shot:02}.png", photograph_board(board, pose, camera, rng))
    write_board(board, out / "board.toml")
    truth = out.with_name(out.name + ".truth")
    write_rig(studio, truth / "cameras.json")
    written = {"images": str(out), "board": str(out / "board.toml"), "truth": str(truth)}
    answer(written, json_out, list(written.values()))


def _make_way(out: Path, overwrite: bool, sign: str = "cameras.json") -> None:
    """Removes an earlier simulated capture, which has the file ``sign``, if ``overwrite`` is true. Raises Overwrites
    and CannotWrite."""
    occupied = out.exists() and (not out.is_dir() or any(out.iterdir()))
    if occupied and not (overwrite and (out / sign).is_file()):
        raise Overwrites(out)
    prepare_folder(out)
    if occupied:
        shutil.rmtree(out)
        shutil.rmtree(out.with_name(out.name + ".truth"), ignore_errors=True)


def _serve_studio(folder: Path, json_out: bool, **options: Any) -> None:
    """Serves the simulated studio until Ctrl-C, which ends the command with status 0."""
    from contextlib import ExitStack, suppress

    from server.cli.studio import serve_studio, studio_lines

    with ExitStack() as bar, suppress(KeyboardInterrupt):
        report = bar.enter_context(progress_bar())

        def ready(studio: dict[str, Any]) -> None:
            bar.close()
            answer(studio, json_out, studio_lines(studio))
            sys.stdout.flush()

        serve_studio(folder, ready=ready, report=report, **options)
