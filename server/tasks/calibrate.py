"""What a calibration runs in a child process: an archive of board pictures in, a rig and its report out."""

import hashlib
import json
import shutil
from pathlib import Path

from rig.atomic_write import write_atomically
from rig.errors import InputError
from rig.formats.archive import ArchiveLimits, extract_archive
from rig.formats.capture_folder import capture_root
from server.storage.records import CalibrationOutcome
from server.tasks.child import Bench, Report

STAGES_S = {"detection": 0.055, "lenses": 0.03, "pose graph": 0.005, "bundle": 0.03, "checks": 0.02}
"""Seconds a picture of each stage, in their order: 104 pictures of 640 x 480 from four cameras on a busy machine."""


def expected(folder: Path) -> dict[str, float]:
    """Seconds of each stage of a calibration, before it has begun: larger pictures take longer, which its own pace soon
    tells."""
    pictures = sum(path.is_file() for path in (folder / "images").rglob("*"))
    return {stage: took * pictures for stage, took in STAGES_S.items()}


def ingest_board_pictures(bench: Bench, report: Report, *, archive: str, folder: str, limits: ArchiveLimits) -> None:
    """Unpacks board.toml and IMAGES/ into ``folder`` and looks at both. Raises InputError."""
    from calibration.board.board import read_board
    from calibration.board.detection import list_pictures

    target = Path(folder)
    unpacked = target.with_name(target.name + ".unpacked")
    extract_archive(Path(archive), unpacked, limits)
    root = capture_root(unpacked)
    if not (root / "board.toml").is_file():
        raise InputError("archive", ["holds no board.toml beside IMAGES/"])
    read_board(root / "board.toml")
    pictures = next((root / name for name in ("IMAGES", "images") if (root / name).is_dir()), root)
    for camera, shots in list_pictures(pictures).items():
        (target / "images" / camera).mkdir(parents=True)
        for path in shots.values():
            path.rename(target / "images" / camera / path.name)
    (root / "board.toml").rename(target / "board.toml")
    shutil.rmtree(unpacked)


def calibrate_folder(
    bench: Bench, report: Report, *, folder: str, result: str, previous: str | None, cache: str, front: str | None
) -> CalibrationOutcome:
    """``calibrate()`` and its files; returns what the record shows."""
    from calibration.board.board import read_board
    from calibration.calibrate import calibrate
    from calibration.report import write_report
    from calibration.result import CalibrationRefused, write_calibration
    from rig.formats.cameras_json import read_rig

    known = None if previous is None else read_rig(Path(previous))
    try:
        found = calibrate(
            Path(folder) / "images",
            read_board(Path(folder) / "board.toml"),
            front=front,
            previous=known,
            cache=Path(cache),
            report=report,
        )
    except CalibrationRefused as error:
        raise InputError("calibration", error.reasons) from error
    document = found.document()
    write_report(found, Path(result) / "report.html")
    write_calibration(found, Path(result) / "cameras.json")
    write_atomically(Path(result) / "calibration.json", json.dumps(document, indent=1).encode())
    digest = hashlib.sha256((Path(result) / "cameras.json").read_bytes()).hexdigest()
    return {
        "verdict": document["verdict"],
        "missing": document["missing"],
        "figures": document["figures"],
        "checks": [*document["checks"]],
        "warnings": document["warnings"],
        "front": document["front"],
        "sha256": digest,
    }
