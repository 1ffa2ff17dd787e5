"""Declares the types of ``report.json`` (format ``eigenhead-report/1``), which other programs read."""

from typing import NotRequired, TypedDict

from rig.messages.message import MessageDocument

FORMAT = "eigenhead-report/1"


class ViewReport(TypedDict):
    """Describes the quality of a camera's silhouette."""

    usable: bool
    contrast: float | None
    cut_off: list[str]
    components: int
    holes: int
    warnings: list[str]
    warning_messages: NotRequired[list[MessageDocument]]  # not in files of earlier versions
    figures: dict[str, object]


class CameraReport(TypedDict):
    """Describes how well the head agrees with one camera's picture. ``camera_shift`` is the correction of the camera's
    pose: rotation (rad) and translation (mm), applied to camera_from_world on the left."""

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
    """Describes the subject's face in a camera's picture; ``found`` is false if no face was found."""

    found: bool
    box_px: list[float] | None
    roll_deg: float | None
    landmarks: int
    score: float | None


class PoseReport(TypedDict):
    """Describes the pose: its method (landmarks, features or silhouettes) and the relative extra cost of the second
    best pose. Also gives the distance between the landmarks of head and picture (relative to the face's size) for each
    camera, and whether the pose is doubtful."""

    method: str
    rival: float | None
    off: dict[str, float | None]
    doubtful: bool


class NamedModel(TypedDict):
    """Describes the head model that was used: its name and the SHA-256 digest of its file."""

    name: str
    sha256: str


class Measured(TypedDict):
    """Describes a measurement in mm with its standard deviation; ``std`` is null if the solver computes none."""

    value: float
    std: float | None


class Placed(TypedDict):
    """Describes a landmark's position (world frame, mm) with its standard deviations along the world's axes; ``std`` is
    null if the solver computes none."""

    position: list[float]
    std: list[float] | None


class GazeReport(TypedDict):
    """Describes the direction of a gaze as azimuth and elevation (degrees) in one frame."""

    azimuth_deg: float
    elevation_deg: float


class EyeReport(TypedDict):
    """Describes an eye. ``seen`` is false if its iris was not found; ``cause`` then gives the reason (``closed``,
    ``few-views``, ``coarse``: too few pixels, ``unclear``: no clear border of the iris), and all other fields are null.

    ``iris`` is the centre of the iris' border (world frame, mm), ``radius`` its radius (mm). ``gaze`` is the unit
    vector of the optical axis (world frame), ``std_deg`` its standard deviation in each direction. ``rig`` gives
    azimuth (from z towards x) and elevation (towards y) in the world frame, ``face`` in the head frame (to the
    subject's left, up)."""

    seen: bool
    cause: str | None
    iris: Placed | None
    radius: Measured | None
    gaze: list[float] | None
    std_deg: float | None
    rig: GazeReport | None
    face: GazeReport | None
    views: list[str]


class ExpressionReport(TypedDict):
    """Describes one facial expression: its name in the model, its name in plain words, its weight from 0 to 1, and the
    weight's standard deviation."""

    name: str
    words: str
    weight: float
    std: float | None


class MorphsReport(TypedDict):
    """Describes the morph targets of posed.glb: their weights for the head as photographed, and Apple's names without
    counterpart in the model, whose targets are zero."""

    weights: dict[str, float]
    without_counterpart: list[str]


class TemplateReport(TypedDict):
    """Describes the template mesh whose vertex order head-NAME.obj has. ``sha256`` is the digest of the mesh's file.
    ``registration`` has the figures that ``eigenhead template add`` printed; ``flame`` has the figures of the FLAME
    model's fit, if there is one."""

    name: str
    source: str
    sha256: str
    registration: dict[str, float]
    flame: NotRequired[dict[str, float]]


class SimilarityReport(TypedDict):
    """Describes x_world = scale (rotation x_head + translation), mm, the paper's form (section 4.2). The scale also
    applies to the translation."""

    scale: float
    rotation: list[list[float]]
    translation: list[float]


class HairReport(TypedDict):
    """Describes head_hair.ply: the fraction of the bust's hair within 2 mm of it, and its largest height above the skin
    (mm)."""

    covered_share: float
    highest_mm: float


class BustReport(TypedDict):
    """Describes the bust, the whole visible surface. ``closed`` is true if every edge has two faces. ``flipped`` and
    ``crossing`` count triangles, ``folded`` counts edges. ``face_silent_share`` is the fraction of the face's vertices
    that no depth map supports; ``guessed_share`` is the fraction that the head did not measure either."""

    spacing_mm: float
    vertices: int
    faces: int
    seen_share: float
    closed: bool
    parts: dict[str, float]
    quality: dict[str, float | None]
    filled: int
    flipped: int
    folded: int
    crossing: int
    face_silent_share: float
    guessed_share: float


class SkinReport(TypedDict):
    """Describes the maps in texture/. One code of the displacement map is ``mm_per_code`` along the normal of head.ply;
    ``mid_code`` means no displacement. ``repeated`` is the fraction of the shading's power that two disjoint sets of
    views share, by octave of wavelength, the longest first."""

    size: int
    mm_per_code: float
    mid_code: int
    direction: str
    normals: str
    longest_mm: float
    shortest_mm: float
    repeated: list[float]
    views: list[str]


class SpecularReport(TypedDict):
    """Describes texture/specular: each camera's exposure ratio (parallel to crossed picture), the ratio of negative to
    positive light before clipping, the reflectance at specular strength 1 in head.glb, and the material's assumed
    roughness."""

    exposure: dict[str, float]
    negative: float
    strength_one: float
    roughness: float


class SetsReport(TypedDict):
    """Describes the textures of further sets of photographs: their names and size (texels). ``specular`` is null unless
    crossed and parallel polarised pictures exist."""

    names: list[str]
    size: int
    specular: SpecularReport | None


class TextureReport(TypedDict):
    """Describes the head's colours. ``filled`` counts the vertices whose colour was interpolated; ``gains`` are factors
    of linear RGB, by camera."""

    vertices: int
    filled: int
    gains: dict[str, object]
    chart: dict[str, object] | None
    light: dict[str, object] | None
    skin: NotRequired[SkinReport | None]  # not in files of earlier versions
    sets: NotRequired[SetsReport | None]  # not in files of earlier versions


class DetailReport(TypedDict):
    """Describes the level of detail that the fit reached, and the reason."""

    level: str
    reason: str
    reason_message: NotRequired[MessageDocument]  # not in files of earlier versions


class Report(TypedDict):
    """Describes the whole ``report.json`` of a result."""

    format: str
    version: str
    model: NamedModel
    method: str
    detail: DetailReport
    cranium: NotRequired[str | None]  # what makes its outline: hair, cap or bald; not in files of earlier versions
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
    eyes: NotRequired[dict[str, EyeReport]]  # not in files of earlier versions
    quality: dict[str, float | None]
    texture: TextureReport
    bust: BustReport | None
    hair: NotRequired[HairReport]  # where head_hair.ply was asked for
    scale_sigma: NotRequired[float]  # where the cameras' scale has one (cameras.json); all deviations include it
    evaluations: int
    stopped_because: str
    seconds: dict[str, float]
    device: NotRequired[str]  # not in files of earlier versions
    settings: dict[str, object]
    inputs: dict[str, str]
    warnings: list[MessageDocument]


class AddedReport(TypedDict, total=False):
    """Declares the report's fields that application writers fill in; they are None without such writers."""

    template: TemplateReport
