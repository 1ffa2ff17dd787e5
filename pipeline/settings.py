"""Defines every setting of the pipeline, with its source. Values are frozen; unknown keys of a document are refused."""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.typed_tables import read_fields
from pipeline.warnings import WARNING_CODES
from rig.colour_space import COLOUR_NAMES, srgb_from_text
from rig.errors import InputError
from rig.messages.message import Message, compose

CLICK_NOISE_PX = 1.5  # a person's click; measured on captures rendered by another program
LANDMARK_NOISE_MM = 2.0  # a landmark's place against the same landmark of another head
PHOTO_LEVELS = (None, "photo", "fine", "pores")  # of detail: those that look inside the outline
FINE_LEVELS = (None, "fine", "pores")  # and those that draw the head to the dense surface


@dataclass(frozen=True, slots=True)
class SegmentationSettings:
    """Sets how the background is subtracted (section 5.4). Chosen on two rendered captures, and on planted faults."""

    coarse_columns: int = 256  # decisions are taken there: 16 pixels a decision quarter the noise, and edges stay sharp
    field_share: float = 0.12  # sigma of the illumination field by image width: drift of lamps is smoother than that
    tolerance_levels: float = 0.8  # what a plate is off where nothing happened: 8-bit rounding, bounced light
    tolerance_share: float = 0.006  # the same, by level
    evidence: float = 9.0  # log odds that a pixel must show against the plate: log of the plate's density over that of
    # any colour at all, (2 pi)^-1.5 / 1.2^3 levels^-3 against 64^-3
    smoothness: float = 1.0  # log odds that a neighbour of the same kind is worth
    darkest_shadow: float = 0.55  # a soft shadow leaves this share of the sRGB code (a quarter of the light); less is a
    # dark subject
    shadow_chroma: float = 0.05  # how far its colour may shift, by the light it takes
    band_px: float = 6.0  # half width of the band in which alpha is solved, beyond the coarse level's 4 px
    alpha_blur_px: float = (
        0.7  # an edge blurred by optics and pixel already has that; it halves the noise of the contour
    )
    least_area: float = 0.01  # of the image; a smaller subject is none
    hole_share: float = 0.02  # of the subject: smaller holes that are not quite the plate are filled
    weak_contrast: float = 4.0  # standard deviations between subject and background below which a contour piece is weak
    other_pieces_warned: float = 0.01  # of the subject: foreground not connected to the subject
    other_pieces_unusable: float = 0.15
    weak_share_warned: float = 0.015  # of the contour; 0.003 in 95 % of 66 good views
    weak_share_unusable: float = 0.25
    strange_share_warned: float = 0.003  # of the mask: area that the other cameras say is empty; 0 in 22 good views
    strange_share_unusable: float = 0.01
    missing_share_warned: float = 0.005  # of the mask: area deep inside all the others; 0 in 22 good views
    missing_share_unusable: float = 0.02


@dataclass(frozen=True, slots=True)
class FaceSettings:
    """Sets whether faces are searched in the photographs."""

    find: bool = True  # false: outlines alone say where the head is, unless feature points are given


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """Sets the alignment (section 4.2), and the search that replaces it without feature points."""

    feature_noise_px: float = CLICK_NOISE_PX
    landmark_noise_mm: float = LANDMARK_NOISE_MM


@dataclass(frozen=True, slots=True)
class FittingSettings:
    """Sets the fit to the outlines (sections 4.3 and 4.4)."""

    modes: int = 60  # section 3.1: the first 60 eigenheads are used in fitting
    modes_first: int = 15  # coarse stage of the contour solver; 10 to 20 measured alike
    robust_px: float = 1.5  # last Geman-McClure scale of the contour solver; 3 lets hair at the temples pull
    contour_noise_px: float | None = (
        None  # of a contour; None: estimated from the residuals, misfit of the model included
    )
    contour_correlation_px: float | None = None  # of that noise along the contour; None: estimated
    calibration_px: float = 0.2  # prior of a camera without a covariance of its own (docs/capture-format.md)
    scale_spread: float = 0.01  # prior of log scale: rigs are metric, size is a mode
    feature_noise_px: float = CLICK_NOISE_PX
    landmark_noise_mm: float = LANDMARK_NOISE_MM
    expression_median: float = 0.1  # prior of an expression's weight, heavy-tailed (prior_term)
    bare_px: float = 2.0  # cranium, ears and neck agree with the input to this after a fit to the whole head ...
    bare_share: float = 0.8  # ... over this share of their outline: the head is bare, and all of its rim speaks
    bare_loss: float = 1.25  # and the rim of the face may lose no more than this factor by it
    tolerance: float = 0.05  # predicted fall of the cost at which the contour solver stops: a step of 0.2 sigma


@dataclass(frozen=True, slots=True)
class PartSettings:
    """Sets how pixels are labelled as skin, hair or clothes. Chosen on studio captures and two captures of another
    program."""

    cell_mm: float = 2.2  # of the grid that parts are told on: four pixels of the usual rig
    steps: int = 4  # of expectation and maximisation
    strength: float = 0.7  # of what a cell looks like: colour and structure of neighbours are not independent
    smooth_mm: float = 9.0  # over which neighbours agree
    edge: float = 0.05  # contrast (0 to 1, as displayed) that ends such a neighbourhood


THICKNESS_RANGE_MM = (0.0, 10.0)  # thicker is hair under a cap, not known to the millimetre


@dataclass(frozen=True, slots=True)
class CapSettings:
    """Sets the swim or wig cap that the subject wears, under which the skull lies its thickness deep."""

    colour: str | None = None  # about its colour, #rrggbb or a name: blue, black, white ...; None: no cap
    thickness_mm: float = 1.0  # 0 to 10: latex and silicone 0.4 to 1, cloth 1 to 1.5; flattened hair adds to it


@dataclass(frozen=True, slots=True)
class PhotoSettings:
    """Sets how photographs are compared inside the outline. Chosen on two captures rendered by another program."""

    sample_mm: float = 1.0  # distance of samples on the surface: two pixels of the usual rig
    centre_mm: float = 3.0  # distance of patches
    views_most: int = 5  # a patch is compared between its most frontal views
    least_seen: float = 0.85  # of a patch's weight: a view that sees less of it does not count
    least_correlation: float = 0.6  # a lower peak is silence ...
    least_texture_correlation: float = 0.35  # ... and without shading, where skin has 0.4 to 0.6
    least_share: float = 0.15  # of the patches that must be found again in other views, or photographs are no use
    floor_mm: float = 0.15  # error of an observation that no correlation shows: highlights, the patch's own relief
    rig_scale_spread: float = 2e-4  # what all distances of a calibrated rig may err alike: 0.05 mm on a board of 250
    hidden_mm: float = 1.5  # a nearer surface hides a sample beyond this: a silhouette fit's own error
    contour_margin_px: float = 2.0  # nothing is read nearer to the background
    fine_length_mm: float = 9.0  # of the kernel that photographs add in the face region ...
    fine_amplitude_mm: float = 0.5  # ... and its standard deviation


@dataclass(frozen=True, slots=True)
class FineSettings:
    """Sets how the head is deformed to the measured surface. Chosen on two captures rendered by another program."""

    coarse_length_mm: float = 12.0  # over which a displacement of the nodes fades where nothing is seen
    length_mm: float = 5.0  # the same of the displacement along the normals that follows it
    least_amplitude_mm: float = 0.7  # standard deviation of a displacement, where the fit claims to be better
    cell_mm: float = 0.8  # points nearer than that are one: three quarters of a pixel of the usual rig
    coarse_cell_mm: float = 2.5
    floor_mm: float = 0.05  # error of a point that its deviation does not show
    coarse_floor_mm: float = 0.3  # the nodes' edges are 4 mm long: relief that they cannot follow
    correlation_mm: float = 4.0  # radius within which points err alike: windows of dense matching overlap
    common_mm: float = 0.1  # what points may err alike beyond that: cameras, shading
    shared_error: float = 0.25  # share of a point's deviation by which points beyond that err alike: means over 16 mm
    # are 0.2 to 1 of it off
    views_least: int = 4  # that agree on a point, where eight see it or more: with fewer, beside hair and behind ears,
    # it lies 1 mm too deep. Where fewer see it, half of them; two at least
    hair_off_mm: float = 0.5  # how far beside the skin a point lies that is hair after all
    facing_least: float = 0.35  # cosine between a point's normal and its view: flatter windows smear
    least_share: float = 0.2  # of the face's vertices that the dense surface must show, or it is no use
    draws: int = 24  # of the posterior: its deviation is known to a seventh


@dataclass(frozen=True, slots=True)
class DenseSettings:
    """Sets how depth is measured in every view. Chosen on two rendered captures. Numbers without unit are shares."""

    pixel_mm: float = 0.4  # on the subject; finer photographs are reduced to it, for their noise is below 0.1 mm there
    reach_mm: float = 90.0  # behind the hull's front where the fitted head bounds nothing: hair is 60 mm thick at most
    behind_head_mm: float = 6.0  # the surface may lie that far behind the fitted head: its own error beside the face
    before_head_mm: float = 60.0  # what stands before the fitted head: hair, a beard, a cap's brim
    labels: int = 21  # places along a ray in each of two sweeps: 4.5 mm apart in the deepest room, and 41 are no better
    contrast_levels: float = 30.0  # a pixel that differs by this from its window's middle weighs half
    angle_least_deg: float = 8.0  # between the views of a pair: nearer ones say little about depth
    angle_most_deg: float = 45.0  # farther ones match hair and ears wrongly ...
    angle_widest_deg: float = 65.0  # ... and are asked only where a view has fewer than ``neighbours_least``
    neighbours_least: int = 3
    neighbours_most: int = 5
    match_factor: float = 1.6  # of a match's own standard deviation: samples of a window are not independent
    match_floor_mm: float = 0.1  # error of a match that its window does not show
    worst_mm: float = 2.0  # a depth with a larger standard deviation is not told
    outline_px: float = 1.0  # nothing is told nearer to the background: the edge is blurred over it
    agree_mm: float = 1.5  # two views agree where their surfaces are nearer than that ...
    agree_deviations: float = 3.0  # ... and than this many of their joint standard deviation
    carried: float = 0.5  # share of the information that goes on to the next size, as far as ...
    relief_factor: float = 3.0  # ... this many times the relief about a pixel allows: without it hair and lids blur


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """Sets which photograph a texture's detail comes from. Costs are relative to that of a view that sees nothing."""

    disagreement: float = 0.06  # of the colour's code: a view that differs so much from the others ...
    outlier: float = 2.0  # ... has half of this cost
    smoothness: float = 0.15  # cost of a seam along an edge where views differ by ``disagreement``
    levelling: float = 10.0  # weight of a correction's step along an edge, by one of a departure from the views' mean
    views_most: int = 4  # a place's detail is the mean of so many views ...
    noise_factor: float = 4.0  # ... that differ from the chosen one by no more than this, by the median over the head
    sweeps: int = 8  # of belief propagation


@dataclass(frozen=True, slots=True)
class TextureSettings:
    """Sets how the head is coloured (section 4.5). Chosen by the colour error over the face of rendered captures."""

    blend: Literal["default", "reference"] = "default"  # reference: the paper's weighted mean
    sharpness: float = 1.0  # exponent of normal . viewing direction, as the paper's weight; 2 is 1 dB worse in a view
    # that was kept back: what shines or is shaded in few views is then that of all
    balance: bool = True  # gain and offset of each camera
    contour_margin_px: float = 2.0  # nothing is sampled nearer to the background: 3 sigma of a 0.7 px defocus
    hidden_mm: float = 1.5  # a nearer surface hides a vertex beyond this: a fit's own error, and no nose is thinner
    least_facing: float = 0.15  # cosine: at a flatter angle than 81 degrees a pixel smears over 6 mm
    footprint_px: float = 0.45  # sigma of the sampling window; 0.7 loses 0.3 dB of detail, 0.4 lets 1.5 dB more noise
    sharpening: float = 1.0  # unsharp mask of 1 px where there is detail: 1.2, 2.2 and 0.8 dB on three true heads
    outlier: float = 0.12  # difference from the median of the views, by its level, at which a view counts half
    chart: bool = False  # a colour chart in the clean plates says what the colours truly are
    selection: SelectionSettings = field(default_factory=SelectionSettings)


SPACING_RANGE_MM = (0.5, 3.0)  # finer is below the photographs' pixels, coarser has no lids


@dataclass(frozen=True, slots=True)
class BustSettings:
    """Sets the mesh of the bust, the whole visible surface."""

    spacing_mm: float = 1.5  # of its vertices, 0.5 to 3: three pixels of the usual rig


FORMATS = ("glb", "ply", "obj", "usdz", "stl", "3mf")
TEXTURE_SIZES = (1024, 2048, 4096, 8192)
TEMPLATE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")  # it becomes part of a file's name


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """Sets which surfaces are made, and which files beside those that every result has."""

    surface: Literal["head", "bust", "both", "hair"] = "both"  # head, bust, or both; hair: head_hair.ply, too
    formats: tuple[str, ...] = ("glb", "ply")  # of the head, of FORMATS; head.ply is always written
    image: Literal["jpeg", "webp", "png"] = "jpeg"  # of head.glb's texture
    texture_size: int | None = None  # texels; None: a texel is about a pixel at the face
    delight: bool = False  # texture/albedo.png: the texture with its light taken off
    skin: Literal["photograph", "albedo"] = "photograph"  # what head.glb shows; albedo asks for delight, too
    ply_texture: bool = False  # head.ply names head.png and has texture coordinates
    neutral: bool = False  # neutral.glb, the head without its expression
    normal_map: bool = False  # head.glb has 10,000 triangles, and a normal map of what they leave out
    morphs: bool = False  # posed.glb, with morph targets under Apple's 52 names; of a template head-NAME.glb, too
    slicer: bool = False  # landmarks.mrk.json, a point list for 3D Slicer
    template: str | None = None  # head-NAME.obj: the head in the vertex order of a registered template, too

    @property
    def textured(self) -> bool:
        """Tells whether any file has a texture."""
        requested = self.ply_texture or self.delit or bool({"glb", "obj", "usdz"} & set(self.formats))
        return self.surface != "bust" and requested

    @property
    def delit(self) -> bool:
        """Tells whether the albedo is requested."""
        return self.delight or self.skin == "albedo"


@dataclass(frozen=True, slots=True)
class Settings:
    """Holds all settings of one reconstruction."""

    method: Literal["contour", "simplex"] = "contour"
    detail: Literal["span", "kernel", "photo", "fine", "pores"] | None = None  # None: fine where the photographs carry
    # it; pores: so, too, and maps of the skin's relief
    front: str | None = None  # the camera that the subject faces; None: guessed from the camera fan
    exchanged_pictures: Literal["repair", "refuse"] = "repair"  # what is done when cameras hold each other's pictures
    anyway: bool = False  # refusals that leave any head possible become warnings, and the pose counts as doubtful
    unexplained_outlines: Literal["refuse", "warn"] = "refuse"  # of a head that explains hardly any of them
    device: Literal["auto", "cpu", "gl"] = "auto"  # what compares photographs; auto: a GPU where there is one and the
    # processor is small; gl: any OpenGL
    fail_on: tuple[str, ...] = ()  # codes of warnings (pipeline.warnings.WARNING_CODES) that are failures here
    segmentation: SegmentationSettings = field(default_factory=SegmentationSettings)
    faces: FaceSettings = field(default_factory=FaceSettings)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)
    fitting: FittingSettings = field(default_factory=FittingSettings)
    parts: PartSettings = field(default_factory=PartSettings)
    cap: CapSettings = field(default_factory=CapSettings)
    photo: PhotoSettings = field(default_factory=PhotoSettings)
    fine: FineSettings = field(default_factory=FineSettings)
    dense: DenseSettings = field(default_factory=DenseSettings)
    texture: TextureSettings = field(default_factory=TextureSettings)
    bust: BustSettings = field(default_factory=BustSettings)
    outputs: OutputSettings = field(default_factory=OutputSettings)


def settings_from_document(document: Mapping[str, Any], subject: str = "settings") -> Settings:
    """Returns the settings in decoded JSON or TOML. Raises InputError that names every unknown key and wrong value."""
    faults: list[Message] = []
    settings = read_fields(Settings, document, "", faults)
    unknown = [code for code in settings.fail_on if code not in WARNING_CODES]
    faults += [compose("setting-code-unknown", code=f"{code!r:.80}", known=WARNING_CODES) for code in unknown]
    least, most = SPACING_RANGE_MM
    if not least <= settings.bust.spacing_mm <= most:
        faults.append(compose("setting-spacing-wrong", value=settings.bust.spacing_mm, least=least, most=most))
    strange = [name for name in settings.outputs.formats if name not in FORMATS]
    faults += [compose("setting-format-unknown", format=f"{name!r:.80}", known=FORMATS) for name in strange]
    size = settings.outputs.texture_size
    if size is not None and size not in TEXTURE_SIZES:
        faults.append(compose("setting-texture-size-wrong", size=size, sizes=TEXTURE_SIZES))
    template = settings.outputs.template
    if template is not None and not TEMPLATE_NAME.fullmatch(template):
        faults.append(compose("setting-template-wrong", template=f"{template!r:.60}"))
    if settings.cap.colour is not None and srgb_from_text(settings.cap.colour) is None:
        faults.append(compose("setting-colour-wrong", colour=f"{settings.cap.colour!r:.60}", known=COLOUR_NAMES))
    least, most = THICKNESS_RANGE_MM
    if not least <= settings.cap.thickness_mm <= most:
        faults.append(compose("setting-thickness-wrong", value=settings.cap.thickness_mm, least=least, most=most))
    if faults:
        raise InputError(subject, faults)
    return settings


def document_from_settings(settings: Settings) -> dict[str, object]:
    """Returns settings as nested dictionaries, the form that ``settings_from_document`` reads."""
    return dataclasses.asdict(settings)
