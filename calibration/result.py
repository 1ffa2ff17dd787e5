"""Defines the result of a calibration: the rig with its covariances, residuals and checks."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.adjustment.intrinsics import Lens
from calibration.adjustment.state import INTRINSICS, rms
from calibration.adjustment.timing import TimeOffsets
from calibration.board.board import Board
from calibration.quality.checks import CameraEvidence, Check, Verdict, judge
from calibration.quality.outliers import Dropped
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.formats.cameras.cameras_json import document_from_rig
from rig.messages.message import Message, compose, documents_of, message_of, texts_of
from rig.rig import Rig

CELLS = (4, 3)  # of a picture, across and down


class CalibrationRefused(EigenheadError):
    """Reports that the pictures were readable but determine no usable rig. The report page shows ``calibration``."""

    def __init__(self, reasons: Iterable[Message | str], calibration: "Calibration | None" = None) -> None:
        self.reasons = tuple(message_of(reason) for reason in reasons)
        self.calibration = calibration
        super().__init__(compose("calibration-refused", reasons=self.reasons))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Calibration:
    """Holds a calibrated rig. Covariances are in the gauge of ``calibration.adjustment.gauge``.

    Attributes:
        rig: the cameras, each with the covariance of its pose.
        pose_sigma_px: the effect of that covariance on each camera's image of the subject, uncertain lenses included.
        intrinsics_sigma: standard deviations of fx fy cx cy k1 k2 p1 p2 k3, by camera.
        misses: numbers, pixels and residuals (projected minus detected, px) of the used corners of each view.
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

    def figures(self) -> dict[str, Any]:
        """Returns the numbers that ``calibrate --json`` prints. ``sync_px`` is the corner noise that all cameras share;
        a large value suggests that they were not simultaneous. Each camera has its reprojection error (RMS, px) in the
        joint solution and in its separate calibration, among others."""
        everything = np.concatenate([miss for _, _, miss in self.misses.values()])
        cameras = {}
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
        """Returns the fraction of cells in a grid over the picture that contain a corner."""
        size = (camera.intrinsics.width, camera.intrinsics.height)
        pixels = np.concatenate(
            [observed for (name, _), (_, observed, _) in self.misses.items() if name == camera.name]
        )
        cells = np.clip((pixels / size * CELLS).astype(int), 0, np.array(CELLS) - 1)
        return len(np.unique(cells, axis=0)) / (CELLS[0] * CELLS[1])

    def verdict(self) -> Verdict:
        """Returns the verdict on the calibration: good, usable or poor, with possible improvements."""
        cameras = self.figures()["cameras"]
        evidence = {
            name: CameraEvidence(c["views"], c["focal_share"], c["pose_sigma_px"], c["covered"])
            for name, c in cameras.items()
        }
        return judge(evidence, self.checks)

    def document(self) -> dict[str, Any]:
        """Returns the content of ``calibration.json``: everything but the residuals. ``passed`` is null for a check
        that lacked data; ``camera`` is null for a shot that was excluded as a whole."""
        names = self.rig.names
        offsets = None
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


def _check_document(check: Check) -> dict[str, Any]:
    return {
        "name": check.name,
        "passed": check.passed,
        "detail": check.detail.text,
        "advice": "" if check.advice is None else check.advice.text,
        "detail_message": check.detail.document(),
        "advice_message": None if check.advice is None else check.advice.document(),
    }
