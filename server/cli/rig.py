"""Implements the commands for a real rig: rig check, preview, capture, board, plates."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from server.cli.answers import Json, Overwrite, answer, number, progress_bar, warn_of_replacement

rig_app = typer.Typer(help="The real rig of a rig.toml.", no_args_is_help=True, rich_markup_mode=None)

RigFile = Annotated[Path, typer.Option("--rig", help="The rig.toml.", exists=True, dir_okay=False)]


@rig_app.command("check", epilog="Example: eigenhead rig check --rig rig.toml")
def rig_check(rig: RigFile = Path("rig.toml"), json_out: Json = False) -> None:
    """Open every camera, take a test shot, and print what to act on."""
    from rig.acquisition.commands import COLUMNS, check
    from rig.formats.rig_toml import read_rig_config

    checked = check(read_rig_config(rig))
    widths = [max(len(row[i]) for row in (COLUMNS, *checked.rows)) for i in range(len(COLUMNS))]
    lines = ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)) for row in (COLUMNS, *checked.rows)]
    lines += [str(fault) for fault in checked.faults if fault.camera is None]
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in checked.rows]
    faults = [fault.document() for fault in checked.faults]
    answer({"healthy": checked.healthy, "cameras": rows, "faults": faults}, json_out, lines)
    if not checked.healthy:
        sys.exit(1)


@rig_app.command("preview", epilog="Example: eigenhead rig preview --rig rig.toml --out sheet.jpg")
def rig_preview(
    out: Annotated[Path, typer.Option(help=".jpg or .png", dir_okay=False)] = Path("preview.jpg"),
    rig: RigFile = Path("rig.toml"),
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Write a contact sheet of what every camera sees."""
    from rig.acquisition.commands import preview
    from rig.formats.rig_toml import read_rig_config

    warn_of_replacement(out, overwrite)
    faults = [str(fault) for fault in preview(read_rig_config(rig), out)]
    answer({"sheet": str(out), "faults": faults}, json_out, [str(out), *faults])


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

    from rig.acquisition.commands import capture
    from rig.formats.rig_toml import read_rig_config

    if out is not None and out_option is not None:
        raise typer.BadParameter("the capture folder is named twice", param_hint="--out")
    folder = out or out_option or Path("captures") / datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    at: dict[str, float] = {}
    with progress_bar() as progress:

        def report(stage: str, fraction: float) -> None:
            at[stage] = monotonic()
            progress(stage, fraction)

        shot = capture(read_rig_config(rig), folder, report=report)
    seconds = {"warm_up": round(at["shot"] - at["warm up"], 3), "capture": round(at["done"] - at["shot"], 3)}
    summary = f"{len(shot.images)} pictures in {seconds['capture']:.2f} s, after {seconds['warm_up']:.2f} s of warm-up"
    document = {"capture": str(folder), "seconds": seconds, **shot.document()}
    answer(document, json_out, [str(folder), summary, *shot.certificate.lines(), *map(str, shot.faults)])


@rig_app.command("board", epilog="Example: eigenhead rig board --rig rig.toml --shots 25 --out board-shots")
def rig_board(
    out: Annotated[Path, typer.Option(help="The folder that `eigenhead calibrate` reads.", file_okay=False)],
    rig: RigFile = Path("rig.toml"),
    shots: Annotated[int, typer.Option(help="How many.", min=1)] = 25,
    pause_s: Annotated[float, number("Before each, to move the board and hold it still.", min=0)] = 4.0,
    json_out: Json = False,
) -> None:
    """Take shots of the calibration board with every camera."""
    from rig.acquisition.commands import take_board_shots
    from rig.formats.rig_toml import read_rig_config

    document = []
    for name, cameras, faults in take_board_shots(read_rig_config(rig), out, shots, pause_s=pause_s):
        texts = [str(fault) for fault in faults]
        print(f"{name}  {len(cameras)} pictures  {'; '.join(texts)}".rstrip(), file=sys.stderr)
        document.append({"shot": name, "cameras": list(cameras), "faults": texts})
    answer({"images": str(out), "shots": document}, json_out, [f"{out}  {len(document)} shots"])


@rig_app.command("plates", epilog="Example: eigenhead rig plates --rig rig.toml")
def rig_plates(
    rig: RigFile = Path("rig.toml"),
    use: Annotated[str, typer.Option(help="Put these to use instead: an id under plates.versions.")] = "",
    json_out: Json = False,
) -> None:
    """Take clean plates of the empty studio, or use earlier ones again."""
    from rig.acquisition.commands import take_plates
    from rig.acquisition.plates import use_plates
    from rig.formats.rig_toml import read_rig_config

    config = read_rig_config(rig)
    taken = sorted((use_plates(config.plates_folder, use, config.names) if use else take_plates(config)).files)
    answer({"cameras": taken}, json_out, [f"clean plates of {len(taken)} cameras"])
