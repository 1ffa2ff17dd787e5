"""Builds ``report.json`` of a result (format ``eigenhead-report/1``) for other programs."""

import math
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.evidence.camera_metrics import CameraFigures
from pipeline.evidence.expression import BlendshapeRig
from pipeline.evidence.pose import angles_deg
from pipeline.faces.detection import FaceDetection
from pipeline.faces.irises import Iris, UnseenEye
from pipeline.faces.subject import SubjectFaces
from pipeline.imaging.silhouette import Silhouette, ViewQuality
from pipeline.part_labels.votes import PART_NAMES
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.report_types import (
    FORMAT,
    BustReport,
    CameraReport,
    EyeReport,
    FaceReport,
    GazeReport,
    MorphsReport,
    Report,
    SetsReport,
    SimilarityReport,
    SkinReport,
    SpecularReport,
    TextureReport,
    ViewReport,
)
from pipeline.settings import document_from_settings
from pipeline.stages.bust import Bust
from pipeline.stages.texturing import Texturing
from pipeline.texturing.chart_colours import ChartColours
from pipeline.texturing.light import HARMONICS, Light
from pipeline.texturing.pores.relief import LONGEST_MM, SHORTEST_MM
from pipeline.texturing.pores.skin_maps import MID_CODE, MM_PER_CODE, SkinMaps
from pipeline.texturing.sets.specular import NORMAL_SHARE
from pipeline.texturing.sets.texture_sets import SetTextures
from rig.formats.meshes.glb import ROUGHNESS
from rig.geometry import Similarity
from rig.mesh import boundary_edges
from rig.messages.message import documents_of, texts_of

ON_CHART, MEAN_ONE = "the chart's white is white", "the mean over the sphere is 1 in each channel"


def report_document(result: Reconstruction) -> Report:
    """Returns the report as JSON types. All numbers are finite; unknown numbers are None."""
    head, evidence, refined = result.head, result.evidence, result.refined
    document: Report = {
        "format": FORMAT,
        "version": version("eigenhead"),
        "model": {"name": result.model_name, "sha256": result.model_sha256},
        "method": head.fit.method,
        "detail": {
            "level": refined.detail.level,
            "reason": refined.detail.reason.text,
            "reason_message": refined.detail.reason.document(),
        },
        "cranium": head.cranium,
        "front": result.alignment.front,
        "pose": {
            "method": result.pose.method,
            "rival": result.pose.rival,
            "off": dict(result.pose.off),
            "doubtful": result.pose.doubtful,
        },
        "faces": {} if result.faces.subject is None else _faces(result.faces.subject, evidence.cameras),
        "cameras": {
            name: _camera(figures, head.fit.camera_shift.get(name), result.views.silhouettes.get(name))
            for name, figures in evidence.cameras.items()
        },
        "pictures": dict(result.views.assignment),
        "coefficients": np.delete(head.fit.coefficients, np.asarray(head.model.posed, int)).tolist(),  # no expressions
        "expression": [
            {"name": each.name, "words": each.words, "weight": each.weight, "std": each.std}
            for each in evidence.expression
        ],
        "morphs": None if evidence.blendshape_rig is None else _morphs(evidence.blendshape_rig),
        "template": None,
        "world_from_head": similarity_document(head.fit.world_from_head),
        "landmarks": {
            name: {"position": mark.position_mm.tolist(), "std": None if mark.std_mm is None else mark.std_mm.tolist()}
            for name, mark in evidence.landmarks.items()
        },
        "measurements": {
            name: {"value": length.value_mm, "std": length.std_mm} for name, length in evidence.measurements.items()
        },
        "eyes": eyes_document(result.faces.eyes, head.fit.world_from_head),
        "quality": {"median": float(np.median(refined.deviation_mm)), "max": float(refined.deviation_mm.max())},
        "texture": _texture(result.texturing),
        "bust": None if result.bust is None else _bust(result.bust),
        "evaluations": head.fit.evaluations,
        "stopped_because": head.fit.termination_reason,
        "seconds": {"total": sum(result.seconds.values())} | dict(result.seconds),
        "device": result.device,
        "settings": document_from_settings(result.settings),
        "inputs": dict(result.digests),
        "warnings": documents_of(result.warnings),
    }
    if result.hair is not None:
        shell = result.hair.shell
        document["hair"] = {"covered_share": shell.covered, "highest_mm": float(shell.height_mm.max())}
    if result.scale_sigma:
        document["scale_sigma"] = result.scale_sigma
    return _plain(document)


def _camera(
    figures: CameraFigures, shift: Float[np.ndarray, " 6"] | None, silhouette: Silhouette | None
) -> CameraReport:
    return {
        "used": figures.used,
        "iou": figures.iou,
        "contour_rms_px": figures.contour_rms_px,
        "excluded_share": figures.excluded_share,
        "samples": figures.samples,
        "xor_cost": figures.xor_cost,
        "xor_cost_start": figures.xor_cost_start,
        "camera_shift": None if shift is None else shift.tolist(),
        "view": None if silhouette is None else _view(silhouette.quality),
    }


def _faces(subject: SubjectFaces, cameras: Iterable[str]) -> dict[str, FaceReport]:
    seen = {} if subject.matched is None else subject.matched.detections
    return {name: _face(seen.get(name)) for name in cameras}


def _face(face: FaceDetection | None) -> FaceReport:
    if face is None:
        return {"found": False, "box_px": None, "roll_deg": None, "landmarks": 0, "score": None}
    return {
        "found": True,
        "box_px": face.box_px.tolist(),
        "roll_deg": face.roll_deg,
        "landmarks": len(face.landmarks_px),
        "score": face.score,
    }


def _view(quality: ViewQuality) -> ViewReport:
    return {
        "usable": quality.usable,
        "contrast": quality.contrast,
        "cut_off": list(quality.cut_off),
        "components": quality.components,
        "holes": quality.holes,
        "warnings": texts_of(quality.warnings),
        "warning_messages": documents_of(quality.warnings),
        "figures": dict(quality.figures),
    }


def _morphs(blendshape_rig: BlendshapeRig) -> MorphsReport:
    used = {name: weight for name, weight in blendshape_rig.weights.items() if weight}
    return {"weights": used, "without_counterpart": list(blendshape_rig.missing)}


def similarity_document(transform: Similarity) -> SimilarityReport:
    """Returns the similarity in the paper's form ``x_world = s (R x_head + t)``, where t is the translation of
    ``transform`` divided by its scale."""
    translation = transform.translation / transform.scale
    return {"scale": transform.scale, "rotation": transform.rotation.tolist(), "translation": translation.tolist()}


def _texture(texturing: Texturing) -> TextureReport:
    vertices = texturing.vertices
    return {
        "vertices": len(vertices.views),
        "filled": int(np.count_nonzero(vertices.views == 0)),
        "gains": dict(vertices.gains),
        "chart": None if texturing.chart is None else _chart(texturing.chart),
        "light": None if texturing.albedo is None else _light(texturing.albedo.light),
        "skin": None if texturing.skin is None else skin_document(texturing.skin),
        "sets": None if texturing.sets is None else _sets(texturing.sets),
    }


def _sets(sets: SetTextures) -> SetsReport:
    size = max(len(atlas.image) for atlas in sets.atlases.values())
    specular: SpecularReport | None = None
    if (found := sets.specular) is not None:
        specular = {
            "exposure": dict(found.exposure),
            "negative": found.negative,
            "strength_one": NORMAL_SHARE,
            "roughness": ROUGHNESS,
        }
    return {"names": [*sets.atlases], "size": size, "specular": specular}


def skin_document(maps: SkinMaps) -> SkinReport:
    """Returns the report's entry about the skin's displacement and normal maps."""
    return {
        "size": len(maps.displacement),
        "mm_per_code": MM_PER_CODE,
        "mid_code": MID_CODE,
        "direction": "along the interpolated normals of head.ply, outwards",
        "normals": "glTF: x along the tangent, y up in the image, z along the normal",
        "longest_mm": LONGEST_MM,
        "shortest_mm": SHORTEST_MM,
        "repeated": list(maps.repeated),
        "views": list(maps.views),
    }


def _chart(chart: ChartColours) -> dict[str, object]:
    return {
        "cameras": {name: {"matrix": each.matrix, "off": each.off} for name, each in chart.cameras.items()},
        "frame": "world",
        "normal": chart.normal_world,
    }


def _light(light: Light) -> dict[str, object]:
    return {
        "frame": "world",
        "harmonics": HARMONICS,
        "coefficients": light.coefficients.T,  # a row a channel: red, green, blue
        "convention": ON_CHART if light.on_chart else MEAN_ONE,
        "residual": light.residual,
    }


def _bust(bust: Bust) -> BustReport:
    surface = bust.surface
    return {
        "spacing_mm": bust.spacing_mm,
        "vertices": len(bust.views),
        "faces": len(surface.mesh_world.faces),
        "seen_share": float(np.mean(surface.seen)),
        "closed": len(boundary_edges(surface.mesh_world.faces)) == 0,
        "parts": {name: float(np.mean(surface.part == code)) for code, name in enumerate(PART_NAMES)},
        "quality": {
            "median_seen": float(np.median(surface.deviation_mm[surface.seen])),
            "max": float(surface.deviation_mm.max()),
        },
        "filled": int(np.count_nonzero(bust.views == 0)),
        "flipped": surface.faults.turned,
        "folded": surface.faults.folded,
        "crossing": surface.faults.crossing,
        "face_silent_share": bust.shaped.face_silent_share,
        "guessed_share": bust.shaped.guessed_share,
    }


def _plain(value: Any) -> Any:
    """Converts a nested document to JSON types; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def eyes_document(eyes: Mapping[str, Iris | UnseenEye], world_from_head: Similarity) -> dict[str, EyeReport]:
    """Returns the report's entry about each eye, by side."""
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
        "radius": {"value": eye.radius_mm, "std": float(np.sqrt(eye.covariance[6, 6]))},
        "gaze": eye.gaze.tolist(),
        "std_deg": eye.gaze_std_deg,
        "rig": _direction(eye.gaze),
        "face": _direction(world_from_head.rotation.T @ eye.gaze),
        "views": list(eye.views),
    }


def _direction(gaze: Float[np.ndarray, " 3"]) -> GazeReport:
    azimuth, elevation = angles_deg(gaze)
    return {"azimuth_deg": azimuth, "elevation_deg": elevation}
