"""``report.json`` of a result (format ``eigenhead-report/1``): everything that a program may want to know of it."""

import math
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, TypedDict

import numpy as np

from pipeline.dense.part_votes import PART_NAMES
from pipeline.evidence.camera_metrics import CameraFigures
from pipeline.evidence.expression import Posable
from pipeline.imaging.silhouette import ViewQuality
from pipeline.results.bust import Bust
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import document_from_settings
from pipeline.templates.header import TemplateHeader
from pipeline.texture.chart_colours import ChartColours
from pipeline.texture.light import HARMONICS, Light
from rig.geometry import Similarity
from rig.mesh import boundary_edges

FORMAT = "eigenhead-report/1"


ON_CHART, MEAN_ONE = "the chart's white is white", "the mean over the sphere is 1 in each channel"


class ViewReport(TypedDict):
    """How far a camera's silhouette was to be trusted."""

    usable: bool
    contrast: float | None
    cut_off: list[str]
    components: int
    holes: int
    warnings: list[str]
    figures: dict[str, object]


class CameraReport(TypedDict):
    """``camera_shift``: rotation (rad) and translation (mm), left perturbation of camera_from_world."""

    used: bool
    iou: float | None
    contour_rms_px: float | None
    excluded_share: float | None
    samples: int
    xor_cost: float | None
    xor_cost_start: float | None
    camera_shift: list[float] | None
    view: ViewReport | None


class WarningReport(TypedDict):
    code: str
    message: str


class NamedModel(TypedDict):
    name: str
    sha256: str


class Measured(TypedDict):
    """In mm, with its standard deviation where the solver tells one."""

    value: float
    std: float | None


class Placed(TypedDict):
    """A landmark in the world (mm), with its standard deviations along the world's axes where the solver tells them."""

    position: list[float]
    std: list[float] | None


class ExpressionReport(TypedDict):
    """What the face does: the model's name, the same in words, a weight from 0 to 1 and its standard deviation."""

    name: str
    words: str
    weight: float
    std: float | None


class MorphsReport(TypedDict):
    """Of posed.glb: the weights that give the head as photographed, and those of Apple's names that move nothing
    because the model has no counterpart."""

    weights: dict[str, float]
    without_counterpart: list[str]


class TemplateReport(TypedDict):
    """Of head-NAME.obj: whose vertex order it has. ``sha256`` is of the mesh's file; ``registration``: the figures of
    ``eigenhead template add``."""

    name: str
    source: str
    sha256: str
    registration: dict[str, float]


class SimilarityReport(TypedDict):
    """x_world = scale (rotation x_head + translation), mm: the paper's form (section 4.2), in which the scale holds for
    the translation, too."""

    scale: float
    rotation: list[list[float]]
    translation: list[float]


class BustReport(TypedDict):
    """Of the whole visible surface; ``closed``: every edge has two faces."""

    spacing_mm: float
    vertices: int
    faces: int
    seen_share: float
    closed: bool
    parts: dict[str, float]
    quality: dict[str, float | None]
    filled: int


class Report(TypedDict):
    """``report.json``."""

    format: str
    version: str
    model: NamedModel
    method: str
    detail: dict[str, str]
    front: str
    cameras: dict[str, CameraReport]
    pictures: dict[str, str]
    coefficients: list[float]
    expression: list[ExpressionReport]
    morphs: MorphsReport | None
    template: TemplateReport | None
    world_from_head: SimilarityReport
    landmarks: dict[str, Placed]
    measurements: dict[str, Measured]
    quality: dict[str, float | None]
    texture: dict[str, object]
    bust: BustReport | None
    evaluations: int
    stopped_because: str
    seconds: dict[str, float]
    settings: dict[str, object]
    inputs: dict[str, str]
    warnings: list[WarningReport]


def report_document(result: Reconstruction, template: TemplateHeader | None = None) -> Report:
    """The decoded report: JSON types only, every number finite (what is not known is null). ``template``: the one in
    whose order the head was written, too."""
    filled = int(np.count_nonzero(result.views == 0))
    document = {
        "format": FORMAT,
        "version": version("eigenhead"),
        "model": {"name": result.model_name, "sha256": result.model_sha256},
        "method": result.fit.method,
        "detail": {"level": result.detail.level, "reason": result.detail.reason},
        "front": result.front,
        "cameras": {name: _camera(result, name, figures) for name, figures in result.cameras.items()},
        "pictures": dict(result.pictures),  # by camera, the name under which its own is filed
        "coefficients": np.delete(result.fit.coefficients, np.asarray(result.posed, int)),
        "expression": [
            {"name": each.name, "words": each.words, "weight": each.weight, "std": each.std}
            for each in result.expression
        ],
        "morphs": None if result.posable is None else _morphs(result.posable),
        "template": None if template is None else _template(template),
        "world_from_head": similarity_document(result.fit.world_from_head),
        "landmarks": {k: {"position": p.position_mm, "std": p.std_mm} for k, p in result.landmarks.items()},
        "measurements": {k: {"value": m.value_mm, "std": m.std_mm} for k, m in result.measurements.items()},
        "quality": {"median": np.median(result.quality_mm), "max": result.quality_mm.max()},
        "texture": {
            "vertices": len(result.views),
            "filled": filled,
            "gains": result.gains,
            "chart": None if result.chart is None else _chart(result.chart),
            "light": None if result.albedo is None else _light(result.albedo.light),
        },
        "bust": None if result.bust is None else _bust(result.bust),
        "evaluations": result.fit.evaluations,
        "stopped_because": result.fit.stopped_because,
        "seconds": {"total": sum(result.seconds.values())} | dict(result.seconds),
        "settings": document_from_settings(result.settings),
        "inputs": dict(result.digests),
        "warnings": [{"code": w.code, "message": w.message} for w in result.warnings],
    }
    return _plain(document)


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


def similarity_document(transform: Similarity) -> SimilarityReport:
    """The paper's form ``x_world = s (R x_head + t)``: its translation is ours divided by the scale."""
    translation = transform.translation / transform.scale
    return {
        "scale": transform.scale,
        "rotation": transform.rotation.tolist(),
        "translation": translation.tolist(),
    }


def _morphs(posable: Posable) -> dict[str, object]:
    used = {name: weight for name, weight in posable.weights.items() if weight}
    return {"weights": used, "without_counterpart": list(posable.missing)}


def _template(template: TemplateHeader) -> dict[str, object]:
    return {
        "name": template.name,
        "source": template.source,
        "sha256": template.source_sha256,
        "registration": template.figures,
    }


def _bust(bust: Bust) -> dict[str, object]:
    surface = bust.surface
    return {
        "spacing_mm": bust.spacing_mm,
        "vertices": len(bust.views),
        "faces": len(surface.mesh_world.faces),
        "seen_share": np.mean(surface.seen),
        "closed": len(boundary_edges(surface.mesh_world.faces)) == 0,
        "parts": {name: np.mean(surface.part == code) for code, name in enumerate(PART_NAMES)},
        "quality": {"median_seen": np.median(surface.deviation_mm[surface.seen]), "max": surface.deviation_mm.max()},
        "filled": int(np.count_nonzero(bust.views == 0)),
    }


def _camera(result: Reconstruction, name: str, figures: CameraFigures) -> dict[str, object]:
    silhouette = result.silhouettes.get(name)
    shift = result.fit.camera_shift.get(name)
    return {
        "used": figures.used,
        "iou": figures.iou,
        "contour_rms_px": figures.contour_rms_px,
        "excluded_share": figures.excluded_share,
        "samples": figures.samples,
        "xor_cost": figures.xor_cost,
        "xor_cost_start": figures.xor_cost_start,
        "camera_shift": shift,  # rotation (rad) and translation (mm), left perturbation of camera_from_world
        "view": None if silhouette is None else _quality(silhouette.quality),
    }


def _quality(quality: ViewQuality) -> dict[str, object]:
    return {
        "usable": quality.usable,
        "contrast": quality.contrast,
        "cut_off": list(quality.cut_off),
        "components": quality.components,
        "holes": quality.holes,
        "warnings": list(quality.warnings),
        "figures": quality.figures,
    }


def _plain(value: Any) -> Any:
    """NumPy to JSON types; what is not finite becomes null, because JSON has no word for it."""
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
