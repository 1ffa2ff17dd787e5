"""Implements the tasks of a calibration, which run in a child process: they unpack an archive of pictures and compute a
rig with its report.

A folder with board.toml shows a calibration board; any other shows a scene.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rig.errors import InputError
from rig.files import sha256_of, write_atomically
from rig.formats.cameras.cameras_json import read_rig, write_rig
from rig.formats.cameras.scale_json import read_scale
from rig.formats.captures.archive import ArchiveLimits, extract_archive
from rig.formats.captures.capture_folder import capture_root
from rig.messages.message import compose, documents_of, texts_of
from rig.progress import Progress
from server.storage.records import JsonObject
from server.tasks.child import WorkerContext
from server.tasks.photographs import SCALE, check_sizes

BOARD = "board.toml"
STAGES_S = {"detection": 0.055, "lenses": 0.03, "pose graph": 0.005, "bundle": 0.03, "checks": 0.02}
"""Seconds a picture of each stage, in their order: 104 pictures of 640 x 480 from four cameras on a busy machine."""
SCENE_STAGES_S = {"features": 0.5, "matches": 1.0, "structure": 0.65, "scale": 0.05}
"""The same of a scene: thirty photographs of 1024 x 768 take 67 s together; how they divide is a guess, which the pace
of the work corrects. Matching goes by pairs, so that more of them take longer."""


def expected(folder: Path) -> dict[str, float]:
    """Estimates the seconds of each stage of a calibration from the number of pictures, before it begins. Larger
    pictures take longer than this estimate."""
    pictures = sum(path.is_file() for path in (folder / "images").rglob("*"))
    stages = STAGES_S if is_of_board(folder) else SCENE_STAGES_S
    return {stage: took * pictures for stage, took in stages.items()}


def is_of_board(folder: Path) -> bool:
    """Returns whether the pictures in a folder show a calibration board."""
    return (folder / BOARD).is_file()


def ingest_pictures(
    context: WorkerContext,
    report: Progress,
    *,
    archive: str,
    folder: str,
    limits: ArchiveLimits,
    image_pixels: int,
    scene: bool,
) -> None:
    """Unpacks an archive of board.toml and IMAGES/ into ``folder``, or of photographs of a ``scene``, with scale.json
    if there is one, and checks them. Raises InputError naming every fault."""
    target = Path(folder)
    unpacked = target.with_name(target.name + ".unpacked")
    extract_archive(Path(archive), unpacked, limits)
    root = capture_root(unpacked)
    files = _scene_pictures(root, image_pixels) if scene else _board_pictures(root)
    for camera, shots in files.items():
        (target / "images" / camera).mkdir(parents=True)
        for shot, path in shots.items():
            path.rename(target / "images" / camera / f"{shot}{path.suffix}")
    beside = SCALE if scene else BOARD
    if (root / beside).is_file():
        (root / beside).rename(target / beside)
    check_scale(target)
    shutil.rmtree(unpacked)


def _scene_pictures(root: Path, image_pixels: int) -> Mapping[str, Mapping[str, Path]]:
    """Returns the photographs of a scene by camera and shot. Raises InputError."""
    from calibration.scene.photographs import find_photographs

    found = find_photographs(root)
    check_sizes((path for shots in found.files.values() for path in shots.values()), image_pixels)
    return found.files


def _board_pictures(root: Path) -> Mapping[str, Mapping[str, Path]]:
    """Returns the pictures of a board by camera and shot. Raises InputError for a missing or wrong board.toml."""
    from calibration.board.board import read_board
    from calibration.board.picture_files import list_pictures

    if not (root / BOARD).is_file():
        raise InputError("archive", [compose("no-board-toml")])
    read_board(root / BOARD)
    return list_pictures(next((root / name for name in ("IMAGES", "images") if (root / name).is_dir()), root))


def forget_scene(folder: Path) -> None:
    """Removes the photographs of a scene once the calibration has ended, since they may show a person and only captures
    can be erased on request. Does nothing for pictures of a board."""
    if not is_of_board(folder):
        shutil.rmtree(folder / "images", ignore_errors=True)


def check_scale(folder: Path) -> None:
    """Raises InputError for a scale.json that does not fit the photographs beside it. Does nothing without one."""
    if (folder / SCALE).is_file():
        read_scale(folder / SCALE, [path.name for path in (folder / "images").iterdir()])


def calibrate_folder(
    context: WorkerContext,
    report: Progress,
    *,
    folder: str,
    result: str,
    previous: str | None,
    cache: str,
    front: str | None,
) -> JsonObject:
    """Calibrates from the board pictures or photographs in ``folder`` and writes cameras.json, calibration.json and
    report.html to ``result``.

    ``previous``: the last cameras.json, with which the result is compared; ``cache``: folder of detected corners;
    ``front``: the camera that the subject faces (None: guessed). Returns the outcome for the calibration's record.
    Raises InputError, which also states the reasons if checks refuse the result.
    """
    if not is_of_board(Path(folder)):
        return _calibrate_scene(report, Path(folder), Path(result), front)
    from calibration.board.board import read_board
    from calibration.calibrate import calibrate
    from calibration.report import report_page
    from calibration.result import CalibrationRefused

    known = None if previous is None else read_rig(Path(previous))
    try:
        found = calibrate(
            Path(folder) / "images",
            read_board(Path(folder) / BOARD),
            front=front,
            previous=known,
            cache=Path(cache),
            report=report,
        )
    except CalibrationRefused as error:
        raise InputError("calibration", error.reasons) from error
    write_atomically(Path(result) / "report.html", report_page(found).encode())
    write_rig(found.rig, Path(result) / "cameras.json")
    return _outcome(found.document(), Path(result))


def _calibrate_scene(report: Progress, folder: Path, result: Path, front: str | None) -> JsonObject:
    from calibration.result import CalibrationRefused
    from calibration.scene.result import judge_scene, scene_page
    from calibration.scene.scene import calibrate_scene

    scale = folder / SCALE
    try:
        found = calibrate_scene(folder / "images", scale=scale if scale.is_file() else None, front=front, report=report)
    except CalibrationRefused as error:
        raise InputError("calibration", error.reasons) from error
    verdict = judge_scene(found)
    write_atomically(result / "report.html", scene_page(found).encode())
    write_rig(found.rig, result / "cameras.json")
    missing = {"missing": texts_of(verdict.missing), "missing_messages": documents_of(verdict.missing)}
    return _outcome({"verdict": verdict.word, **missing, **found.document()}, result)


def _outcome(document: Mapping[str, Any], result: Path) -> JsonObject:
    """Writes calibration.json beside cameras.json in ``result``. Returns the fields for the calibration's record."""
    write_atomically(result / "calibration.json", json.dumps(document, indent=1).encode())
    kept = ("verdict", "missing", "missing_messages", "figures", "warnings", "warning_messages", "front")
    beside = {"checks": [*document.get("checks", ())], "sha256": sha256_of(result / "cameras.json")}
    return {name: document[name] for name in kept} | beside
