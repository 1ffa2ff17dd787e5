"""Implements the commands `eigenhead rig check`, `preview`, `capture`, `board` and `plates`.

The function of a command opens the cameras, does its work, and closes the cameras. It prints nothing."""

import itertools
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rig.acquisition.plates import Plates, link_plates
from rig.acquisition.session import MakeDriver, RigSession
from rig.acquisition.shot import Fault, Shot, ShotFailed
from rig.capture import Capture
from rig.drivers.base import driver_for
from rig.errors import EigenheadError, InputError
from rig.files import write_atomically
from rig.formats.captures.capture_folder import write_capture
from rig.formats.pictures.images import write_image
from rig.formats.rig_toml import RigConfig
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.progress import Progress, discard_progress
from rig.rig import Rig

HIDDEN_BY_BOARD = ("view", "swapped", "moved", "plates", "overexposed")  # faults that a board in the picture causes
COLUMNS = ("camera", "found", "resolution", "fps", "exposure", "sharpness", "sync", "last seen", "remark")


class NoCalibration(EigenheadError):
    """Reports a rig without calibration. A capture folder needs the calibration for its cameras.json."""

    def __init__(self) -> None:
        super().__init__(compose("rig-without-calibration"))


@dataclass(frozen=True, slots=True)
class RigCheck:
    """Holds the result of `eigenhead rig check`: a row of texts (``COLUMNS``) for each camera, and all faults."""

    rows: tuple[tuple[str, ...], ...]
    faults: tuple[Fault, ...]

    @property
    def healthy(self) -> bool:
        """Returns whether a capture would succeed now."""
        return not any(fault.is_error for fault in self.faults)


def check(config: RigConfig, make_driver: MakeDriver = driver_for) -> RigCheck:
    """Opens all devices of a rig and takes a test shot, which is not stored."""
    with RigSession(config, make_driver) as session:
        session.warm_up()
        shot = session.shoot()
        return RigCheck(tuple(_row(name, session, shot) for name in config.names), shot.faults)


def preview(config: RigConfig, out: Path, make_driver: MakeDriver = driver_for) -> tuple[Fault, ...]:
    """Takes a shot and writes one picture with small pictures of all cameras to ``out``, a .jpg or .png file. Returns
    the faults of the shot."""
    with RigSession(config, make_driver) as session:
        session.warm_up()
        shot = session.shoot()
    write_image(out, contact_sheet(config.names, shot.images, shot.faults), quality=85)
    return shot.faults


def capture(
    config: RigConfig, out: Path, make_driver: MakeDriver = driver_for, *, report: Progress = discard_progress
) -> Shot:
    """Takes one shot and writes it as the capture folder ``out``. Reports the stages "warm up", "shot" and "done".

    Raises ShotFailed without writing anything if the shot has an error. Raises NoCalibration for a rig without
    calibration, and InputError if ``out`` is not empty. The returned shot and the file shot.json contain the warnings.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(str(out), [compose("folder-exists")])
    report("warm up", 0.0)
    with RigSession(config, make_driver) as session:
        session.warm_up()
        report("shot", 0.5)
        shot = capture_with(session, out)
        report("done", 1.0)
    return shot


def capture_with(session: RigSession, out: Path) -> Shot:
    """Takes one shot with an open session whose cameras are warmed up, and writes the capture folder ``out``. Raises
    ShotFailed and NoCalibration."""
    if session.rig is None:
        raise NoCalibration
    shot = session.shoot()
    if not shot.complete:
        raise ShotFailed(shot.faults)
    write_shot(out, shot, session.plates, session.rig)
    return shot


def take_board_shots(
    config: RigConfig, out: Path, count: int, make_driver: MakeDriver = driver_for, *, pause_s: float = 4.0
) -> Iterator[tuple[str, tuple[str, ...], tuple[Fault, ...]]]:
    """Takes ``count`` shots of a calibration board and writes ``out/<camera>/<shot>.png`` for `eigenhead calibrate`.

    Yields each shot's name, the cameras whose pictures were written, and the faults. Waits ``pause_s`` seconds before
    each shot, so that a person can move the board. Never overwrites earlier shots in ``out``. Raises ShotFailed if no
    camera delivers a picture.
    """
    taken = {path.stem for path in out.glob("*/*.png")}
    names = (name for name in map("shot{:03}".format, itertools.count()) if name not in taken)
    with RigSession(config, make_driver) as session:
        session.warm_up()
        for name in itertools.islice(names, count):
            time.sleep(pause_s)
            shot = take_board_shot(session)
            for camera, image in shot.images.items():
                write_image(out / camera / f"{name}.png", image)
            yield name, tuple(shot.images), shot.faults


def take_board_shot(session: RigSession) -> Shot:
    """Takes one shot of a calibration board with an open session. The rig needs neither calibration nor clean plates.

    Returns the pictures that cameras delivered, and the faults. Leaves out the faults that the calibration board causes
    by hiding the background. Raises ShotFailed if no camera delivers a picture.
    """
    shot = session.shoot()
    faults = tuple(fault for fault in shot.faults if fault.code not in HIDDEN_BY_BOARD)
    spoilt = {fault.camera for fault in faults if fault.is_error}
    images = {} if None in spoilt else {name: image for name, image in shot.images.items() if name not in spoilt}
    if not images:
        raise ShotFailed(faults)
    return replace(shot, images=images, faults=faults)


def take_plates(config: RigConfig, make_driver: MakeDriver = driver_for) -> Plates:
    """Takes new clean plates (pictures of the empty studio) and uses them from now on. If the function raises
    ShotFailed, the old plates stay in use."""
    with RigSession(config, make_driver) as session:
        session.warm_up()
        return session.take_plates()


def write_shot(out: Path, shot: Shot, plates: Plates, rig: Rig) -> None:
    """Writes a shot as a capture folder with clean plates and the timing of the shot (shot.json). The capture folder
    appears only when it is complete."""
    out.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        fresh.chmod(0o777 & ~_umask())  # mkdtemp makes it private
        write_capture(fresh, Capture(shot.images), rig.subset([name for name in rig.names if name in shot.images]))
        link_plates(plates, fresh / "background")
        write_atomically(fresh / "shot.json", json.dumps(shot.document(), indent=1).encode())
        if out.exists():
            out.rmdir()
        fresh.rename(out)
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise


def contact_sheet(
    names: tuple[str, ...], images: Mapping[str, ImageRgb], faults: tuple[Fault, ...], tile_width: int = 320
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Returns one picture (RGB) that shows the pictures of all cameras, with the cameras' names and codes of faults."""
    tile_height = tile_width * 3 // 4
    columns = math.ceil(math.sqrt(len(names)))
    rows = math.ceil(len(names) / columns)
    sheet = np.full((rows * (tile_height + 24), columns * tile_width, 3), 24, np.uint8)
    for index, name in enumerate(names):
        top, left = index // columns * (tile_height + 24), index % columns * tile_width
        if name in images:
            tile = _fit(images[name], tile_width, tile_height)
            sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
        codes = " ".join(sorted({fault.code for fault in faults if fault.camera == name}))
        colour = (255, 120, 90) if any(f.camera == name and f.is_error for f in faults) else (230, 230, 230)
        where = (left + 6, top + tile_height + 17)
        cv2.putText(sheet, f"{name} {codes}", where, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    return sheet


def _fit(image: ImageRgb, width: int, height: int) -> UInt8[np.ndarray, "_ _ 3"]:
    factor = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _row(name: str, session: RigSession, shot: Shot) -> tuple[str, ...]:
    state = session.states().get(name)
    image, measured = shot.images.get(name), shot.checks.get(name)
    sync = next((line for line in shot.certificate.cameras if line.camera == name), None)
    faults = [f"{fault.code}: {fault.detail}" for fault in shot.faults if fault.camera == name]
    last_seen = "never"
    if state is not None and state.last_seen_s is not None:
        last_seen = f"{time.monotonic() - state.last_seen_s:.1f} s ago"
    return (
        name,
        "yes" if state is not None and state.opened else "no",
        "-" if image is None else f"{image.shape[1]} x {image.shape[0]}",
        "-" if state is None or state.period_s is None else f"{1 / state.period_s:.1f}",
        "-" if measured is None else f"{measured.exposure.mean / 2.55:.0f} %",
        "-" if measured is None or measured.blur_px is None else f"{measured.blur_px:.1f} px",
        "-" if sync is None else sync.status if sync.skew_s is None else f"{sync.skew_s * 1000:+.1f} ms",
        last_seen,
        "; ".join(faults) or "ok",
    )


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
