"""The eyes of ``report.json``: irises and gaze, or why an eye is not seen."""

from collections.abc import Mapping

from jaxtyping import Float
from numpy import ndarray, sqrt

from pipeline.evidence.gaze import angles_deg
from pipeline.faces.irises import Iris, UnseenEye
from pipeline.results.report_types import EyeReport, GazeReport
from rig.geometry import Similarity


def eyes_document(eyes: Mapping[str, Iris | UnseenEye], world_from_head: Similarity) -> dict[str, EyeReport]:
    """Describes the eyes by side."""
    return {side: _eye(eye, world_from_head) for side, eye in eyes.items()}


def _eye(eye: Iris | UnseenEye, world_from_head: Similarity) -> EyeReport:
    if isinstance(eye, UnseenEye):
        return {
            "seen": False,
            "cause": eye.cause,
            "iris": None,
            "radius": None,
            "gaze": None,
            "std_deg": None,
            "rig": None,
            "face": None,
            "views": [],
        }
    return {
        "seen": True,
        "cause": None,
        "iris": {"position": eye.centre.tolist(), "std": eye.centre_std_mm.tolist()},
        "radius": {"value": eye.radius_mm, "std": float(sqrt(eye.covariance[6, 6]))},
        "gaze": eye.gaze.tolist(),
        "std_deg": eye.gaze_std_deg,
        "rig": _direction(eye.gaze),
        "face": _direction(world_from_head.rotation.T @ eye.gaze),
        "views": list(eye.views),
    }


def _direction(gaze: Float[ndarray, " 3"]) -> GazeReport:
    azimuth, elevation = angles_deg(gaze)
    return {"azimuth_deg": azimuth, "elevation_deg": elevation}
