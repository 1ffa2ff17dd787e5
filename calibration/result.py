"""Defines the result of a calibration: the rig with its covariances, and the figures and checks behind it."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
from jaxtyping import Float

from calibration.adjustment.intrinsics import Lens
from calibration.adjustment.state import INTRINSICS, rms
from calibration.adjustment.timing import TimeOffsets
from calibration.board.board import Board
from calibration.quality.checks import CameraEvidence, Check, Verdict, Word, judge
from calibration.quality.outliers import Dropped
from rig.atomic_write import write_atomically
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.formats.cameras.cameras_json import CamerasDocument, document_from_rig
from rig.messages.message import Message, MessageDocument, compose, documents_of, message_of, texts_of
from rig.rig import Rig

CELLS = (4, 3)  # of a picture, across and down


class CalibrationRefused(EigenheadError):
    """Reports that the pictures were readable but determine no usable rig. ``calibration`` is there for the report."""

    def __init__(self, reasons: Iterable[Message | str], calibration: "Calibration | None" = None) -> None:
        self.reasons = tuple(message_of(reason) for reason in reasons)
        self.calibration = calibration
        super().__init__(compose("calibration-refused", reasons=self.reasons))


class CameraFigures(TypedDict):
    """Describes how well one camera is calibrated: reprojection errors in the joint solution and with its own lens
    alone (RMS, px), its views and corners, the standard deviations of pose and focal length, and the fraction of the
    picture with corners."""

    rms_px: float
    alone_rms_px: float
    views: int
    corners: int
    pose_sigma_px: float
    focal_sigma_px: float
    focal_share: float
    covered: float


class Figures(TypedDict):
    """Describes the numbers of ``calibrate --json``. ``sync_px`` is the part of the corners' noise that is common to
    all cameras, a sign that they were not simultaneous."""

    rms_px: float
    used_share: float
    corners: int
    sync_px: float
    cameras: dict[str, CameraFigures]


class CheckDocument(TypedDict):
    """Describes the result of one check, and a remedy. ``passed`` is null if there was nothing to check against."""

    name: str
    passed: bool | None
    detail: str
    advice: str
    detail_message: MessageDocument
    advice_message: MessageDocument | None


class DroppedDocument(TypedDict):
    """Describes an excluded view and the reason; ``camera`` is null for a whole shot."""

    shot: str
    camera: str | None
    reason: str
    reason_message: MessageDocument


class OffsetsDocument(TypedDict):
    """Describes the time offset of each camera with its standard deviation, in units of the time between shots, and
    whether the offsets were used."""

    used: bool
    unit: str
    cameras: dict[str, float]
    sigma: dict[str, float]
    rms_without_px: float
    rms_with_px: float


class CalibrationDocument(TypedDict):
    """Describes ``calibration.json``."""

    verdict: Word
    missing: list[str]
    missing_messages: list[MessageDocument]
    figures: Figures
    front: str
    checks: list[CheckDocument]
    dropped: list[DroppedDocument]
    warnings: list[str]
    warning_messages: list[MessageDocument]
    time_offsets: OffsetsDocument | None
    intrinsics_sigma: dict[str, dict[str, float]]
    rig: CamerasDocument


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Calibration:
    """Holds a calibrated rig with its evidence. Covariances are in the gauge of ``calibration.adjustment.gauge``.

    Attributes:
        rig: the cameras, each with the covariance of its pose.
        pose_sigma_px: the size of that covariance at the subject, by camera; the lenses' uncertainty is part of it.
        intrinsics_sigma: standard deviations of fx fy cx cy k1 k2 p1 p2 k3, by camera.
        misses: for each camera and shot, the used corners' numbers, pixels, and projected less detected pixels.
    """

    rig: Rig
    board: Board
    front: str
    intrinsics_sigma: dict[str, Float[np.ndarray, " 9"]]
    pose_sigma_px: dict[str, float]
    misses: dict[tuple[str, str], tuple[np.ndarray, np.ndarray, np.ndarray]]
    detected: int
    lenses: dict[str, Lens]
    sync_px: float
    offsets: TimeOffsets | None
    offsets_used: bool
    dropped: tuple[Dropped, ...]
    checks: tuple[Check, ...]
    warnings: tuple[Message, ...]

    def figures(self) -> Figures:
        """Returns the numbers of ``calibrate --json``."""
        everything = np.concatenate([miss for _, _, miss in self.misses.values()])
        cameras: dict[str, CameraFigures] = {}
        for camera in self.rig:
            residuals = [miss for (name, _), (_, _, miss) in self.misses.items() if name == camera.name]
            cameras[camera.name] = {
                "rms_px": rms(np.concatenate(residuals)),
                "alone_rms_px": self.lenses[camera.name].rms_px,
                "views": len(residuals),
                "corners": int(sum(len(miss) for miss in residuals)),
                "pose_sigma_px": self.pose_sigma_px[camera.name],
                "focal_sigma_px": float(self.intrinsics_sigma[camera.name][0]),
                "focal_share": float(self.intrinsics_sigma[camera.name][0]) / camera.intrinsics.fx,
                "covered": self._covered(camera),
            }
        return {
            "rms_px": rms(everything),
            "used_share": len(everything) / self.detected,
            "corners": len(everything),
            "sync_px": self.sync_px,
            "cameras": cameras,
        }

    def _covered(self, camera: Camera) -> float:
        """Returns the fraction of the picture's cells with at least one corner."""
        size = (camera.intrinsics.width, camera.intrinsics.height)
        pixels = np.concatenate(
            [observed for (name, _), (_, observed, _) in self.misses.items() if name == camera.name]
        )
        cells = np.clip((pixels / size * CELLS).astype(int), 0, np.array(CELLS) - 1)
        return len(np.unique(cells, axis=0)) / (CELLS[0] * CELLS[1])

    def verdict(self) -> Verdict:
        """Judges whether the calibration is usable, and what it lacks."""
        cameras = self.figures()["cameras"]
        evidence = {
            name: CameraEvidence(c["views"], c["focal_share"], c["pose_sigma_px"], c["covered"])
            for name, c in cameras.items()
        }
        return judge(evidence, self.checks)

    def document(self) -> CalibrationDocument:
        """Returns everything but the residuals as JSON types."""
        names = self.rig.names
        offsets: OffsetsDocument | None = None
        if self.offsets is not None:
            offsets = {
                "used": self.offsets_used,
                "unit": "shots",
                "cameras": dict(zip(names, self.offsets.offsets.tolist(), strict=True)),
                "sigma": dict(zip(names, self.offsets.sigma.tolist(), strict=True)),
                "rms_without_px": self.offsets.rms_without_px,
                "rms_with_px": self.offsets.rms_with_px,
            }
        sigma: dict[str, dict[str, float]] = {
            name: {of: value for of, value in zip(INTRINSICS, values.tolist(), strict=True)}
            for name, values in self.intrinsics_sigma.items()
        }
        verdict = self.verdict()
        return {
            "verdict": verdict.word,
            "missing": texts_of(verdict.missing),
            "missing_messages": documents_of(verdict.missing),
            "figures": self.figures(),
            "front": self.front,
            "checks": [_check_document(check) for check in self.checks],
            "dropped": [
                {
                    "shot": drop.shot,
                    "camera": drop.camera,
                    "reason": drop.reason.text,
                    "reason_message": drop.reason.document(),
                }
                for drop in self.dropped
            ],
            "warnings": texts_of(self.warnings),
            "warning_messages": documents_of(self.warnings),
            "time_offsets": offsets,
            "intrinsics_sigma": sigma,
            "rig": document_from_rig(self.rig),
        }


def _check_document(check: Check) -> CheckDocument:
    return {
        "name": check.name,
        "passed": check.passed,
        "detail": check.detail.text,
        "advice": "" if check.advice is None else check.advice.text,
        "detail_message": check.detail.document(),
        "advice_message": None if check.advice is None else check.advice.document(),
    }


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Writes ``cameras.json`` with covariances."""
    write_atomically(path, json.dumps(document_from_rig(calibration.rig), indent=1).encode())
