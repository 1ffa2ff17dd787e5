"""The types of ``report.json``, format ``eigenhead-report/1``: what programs rely on."""

from typing import NotRequired, TypedDict

from rig.messages.message import MessageDocument

FORMAT = "eigenhead-report/1"


class ViewReport(TypedDict):
    """How far a camera's silhouette was to be trusted."""

    usable: bool
    contrast: float | None
    cut_off: list[str]
    components: int
    holes: int
    warnings: list[str]
    warning_messages: NotRequired[list[MessageDocument]]  # not in files of earlier versions
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


class FaceReport(TypedDict):
    """The subject's face in a camera's picture; ``found`` is false where none was."""

    found: bool
    box_px: list[float] | None
    roll_deg: float | None
    landmarks: int
    score: float | None


class PoseReport(TypedDict):
    """What the pose came from (landmarks, features or silhouettes), how much more the best other pose costs (a share),
    by camera how far the head's landmarks lie from the found ones (by the face's size), and whether it is in doubt."""

    method: str
    rival: float | None
    off: dict[str, float | None]
    doubtful: bool


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


class TextureReport(TypedDict):
    """``filled``: vertices that no photograph coloured; ``gains``: linear RGB, by camera."""

    vertices: int
    filled: int
    gains: dict[str, object]
    chart: dict[str, object] | None
    light: dict[str, object] | None


class DetailReport(TypedDict):
    """How deep the fit went, and why no deeper or why so deep."""

    level: str
    reason: str
    reason_message: NotRequired[MessageDocument]  # not in files of earlier versions


class Report(TypedDict):
    """``report.json``."""

    format: str
    version: str
    model: NamedModel
    method: str
    detail: DetailReport
    front: str
    pose: PoseReport
    faces: dict[str, FaceReport]
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
    texture: TextureReport
    bust: BustReport | None
    evaluations: int
    stopped_because: str
    seconds: dict[str, float]
    device: NotRequired[str]  # not in files of earlier versions
    settings: dict[str, object]
    inputs: dict[str, str]
    warnings: list[MessageDocument]
