"""Defines the result of a calibration from a scene: the rig with its covariances, its scale, and excluded views. The
module also judges the calibration with the limits of a board calibration, and writes its report as one HTML page."""

from dataclasses import dataclass
from html import escape
from typing import Any

from calibration.adjustment.state import rms
from calibration.quality.checks import POSE_GOOD_PX, POSE_POOR_PX, Verdict
from calibration.report import STYLE, table, write_list
from calibration.scene.covariance import Uncertainty
from calibration.scene.scale import Scale
from calibration.scene.structure import Structure
from rig.formats.cameras.cameras_json import document_from_rig
from rig.messages.message import Message, compose, documents_of, texts_of
from rig.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class SceneCalibration:
    """Holds a rig calibrated from photographs of a scene, in the world frame (mm).

    Attributes:
        rig: the cameras.
        structure: the same cameras with their points.
        uncertainty: how precisely the cameras are known.
        scale: how the unit became millimetres.
        front: the camera that the subject faces.
        left_out: views that could not be joined to the others, and why.
        features: number of keypoints in each view.
        matched: number of keypoints, over all views, that were found in another view too.
        refinement: how silhouettes changed the poses, if there were masks.
    """

    rig: Rig
    structure: Structure
    uncertainty: Uncertainty
    scale: Scale
    front: str
    left_out: dict[str, Message]
    features: dict[str, int]
    matched: int
    warnings: tuple[Message, ...]
    refinement: Message | None = None

    def absences(self) -> list[Message]:
        """Returns a message for every camera that structure from motion left out, with the reason."""
        return [compose("located", where=name, fault=why) for name, why in self.left_out.items()]

    def figures(self) -> dict[str, Any]:
        """Returns the numbers that ``calibrate --from scene --json`` prints. ``used_share`` is the fraction of matched
        keypoints that the solution uses. ``points`` is the number of a camera's keypoints that the solution uses."""
        misses = self.structure.residuals()
        cameras = {}
        for index, camera in enumerate(self.rig):
            of_camera = self.structure.camera_of == index
            cameras[camera.name] = {
                "rms_px": rms(misses[of_camera]),
                "features": self.features[camera.name],
                "points": int(of_camera.sum()),
                "pose_sigma_px": float(self.uncertainty.pose_sigma_px[index]),
                "focal_px": camera.intrinsics.fx,
                "focal_sigma_px": float(self.uncertainty.focal_sigma_px[index]),
            }
        return {
            "rms_px": rms(misses),
            "used_share": len(misses) / max(1, self.matched),
            "noise_px": self.uncertainty.noise_px,
            "points": len(self.structure.points),
            "observations": len(misses),
            "cameras": cameras,
        }

    def document(self) -> dict[str, Any]:
        """Returns the content of ``calibration.json``, without points and residuals."""
        return {
            "figures": self.figures(),
            "front": self.front,
            "lenses": "one" if self.structure.one_lens else "each",
            "scale": {
                "source": self.scale.source,
                "assumed": self.scale.assumed,
                "told": self.scale.provenance.text,
                "share_sigma": self.scale.share,
            },
            "left_out": {name: f"{name}: {why}" for name, why in self.left_out.items()},
            "refinement": None if self.refinement is None else self.refinement.text,
            "warnings": texts_of(self.warnings),
            "warning_messages": documents_of(self.warnings),
            "rig": document_from_rig(self.rig),
        }


def judge_scene(calibration: SceneCalibration) -> Verdict:
    """Judges a calibration by its worst camera, and at best as usable with an assumed scale or an excluded view."""
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


def scene_page(calibration: SceneCalibration) -> str:
    """Returns the report of a calibration as HTML."""
    figures, scale = calibration.figures(), calibration.scale
    mark = "bad" if scale.assumed else "good"
    total = len(calibration.rig) + len(calibration.left_out)
    summary = (
        f"{len(calibration.rig)} of {total} views joined over {figures['points']} points of the scene, "
        f"2D residual RMS <b>{figures['rms_px']:.3f} px</b>. Front camera: {escape(calibration.front)} (a guess unless "
        "it was named)."
    )
    scale_line = (
        f"Scale: <span class='{mark}'>{escape(scale.provenance.text)}</span>, good to {100 * scale.share:.2g} %."
    )
    refined = "" if calibration.refinement is None else f"<p>Silhouettes: {escape(calibration.refinement.text)}.</p>"
    head = ("camera", "points", "RMS px", "uncertainty at the subject px", "focal length px", "centre mm")
    rows = [
        (
            name,
            f"{row['points']} of {row['features']}",
            f"{row['rms_px']:.3f}",
            f"{row['pose_sigma_px']:.3f}",
            f"{row['focal_px']:.1f} &plusmn; {row['focal_sigma_px']:.1f}",
            ", ".join(f"{value:.1f}" for value in calibration.rig[name].centre_world),
        )
        for name, row in figures["cameras"].items()
    ]
    return "\n".join(
        [
            "<!doctype html><html lang='en'><meta charset='utf-8'><title>Calibration from the scene</title>",
            f"<style>{STYLE}</style><h1>Calibration from the scene</h1><p>{summary}</p><p>{scale_line}</p>{refined}",
            write_list("Views that did not join", calibration.absences()),
            write_list("Warnings", calibration.warnings),
            "<h2>Cameras</h2>",
            table(head, rows),
            "</html>",
        ]
    )
