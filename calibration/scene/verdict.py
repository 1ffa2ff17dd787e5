"""Judges whether a calibration from a scene is worth using for a rig, by the same limits as for a board."""

from calibration.quality.verdict import POSE_GOOD_PX, POSE_POOR_PX, Verdict
from calibration.scene.result import SceneCalibration
from rig.messages.message import Message, compose


def judge_scene(calibration: SceneCalibration) -> Verdict:
    """Judges a calibration by its weakest camera. An assumed scale, or a view that did not join, makes it usable at
    best."""
    sigma = dict(zip(calibration.rig.names, calibration.uncertainty.pose_sigma_px, strict=True))
    poor = [name for name, px in sigma.items() if px > POSE_POOR_PX]
    loose = [name for name, px in sigma.items() if POSE_GOOD_PX < px <= POSE_POOR_PX]
    mild = [_loose(loose, POSE_GOOD_PX)] if loose else []
    if calibration.scale.assumed:
        mild.append(compose("scale-assumed", scale=calibration.scale.provenance))
    mild += calibration.absences()
    severe = [_loose(poor, POSE_POOR_PX)] if poor else []
    return Verdict("poor" if severe else "usable" if mild else "good", (*severe, *mild))


def _loose(names: list[str], pixels: float) -> Message:
    return compose("scene-pose-loose", cameras=names, px=pixels)
