"""Defines all settings that a user can change, with their defaults. Unknown keys of a settings document are refused;
keys of the previous version are read with a warning."""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pipeline.warnings import WARNING_CODES
from rig.colour_space import COLOUR_NAMES, srgb_from_text
from rig.errors import InputError
from rig.messages.message import Message, compose
from rig.typed_tables import read_fields

PHOTO_LEVELS = (None, "photo", "fine", "pores")  # of detail: those that look inside the outline
FINE_LEVELS = (None, "fine", "pores")  # and those that draw the head to the dense surface
THICKNESS_RANGE_MM = (0.0, 10.0)  # thicker is hair under a cap, not known to the millimetre
SPACING_RANGE_MM = (0.5, 3.0)  # finer is below the photographs' pixels, coarser has no lids
FORMATS = ("glb", "ply", "obj", "usdz", "stl", "3mf")
TEXTURE_SIZES = (1024, 2048, 4096, 8192)
TEMPLATE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")  # it becomes part of a file's name
FIXED = {
    "alignment": (),
    "dense": (),
    "fine": (),
    "parts": (),
    "photo": (),
    "segmentation": (),
    "fitting": (
        *("bare_loss", "bare_px", "bare_share", "expression_median", "feature_noise_px", "landmark_noise_mm"),
        *("modes_first", "scale_spread", "tolerance"),
    ),
    "texture": ("contour_margin_px", "footprint_px", "hidden_mm", "least_facing", "outlier", "selection", "sharpness"),
}  # settings before 0.4.0 whose numbers are constants now: by table, () for all of a table
RETIRED_CODE = "shape-implausible"  # of a warning of 0.4.0
RENAMED = {
    "outputs": {"skin": ("albedo", {"albedo": "glb"}), "delight": ("albedo", {"True": "file"})}
}  # settings before 0.4.0: by table and name, the new name and the new value by the old one


@dataclass(frozen=True, slots=True)
class FaceSettings:
    """Sets whether faces are searched in the photographs."""

    find: bool = True  # false lets outlines alone say where the head is: for subjects whose faces are covered


@dataclass(frozen=True, slots=True)
class FittingSettings:
    """Sets the fit to the outlines (the paper's sections 4.3 and 4.4)."""

    modes: int = 60  # of the eigenheads (section 3.1); lower it where few cameras see the head
    robust_px: float = 1.5  # residual at which an outline counts a quarter; raise it to six times the noise of outlines
    # that are worse than 0.25 px; 3 lets hair at the temples pull
    contour_noise_px: float | None = None  # noise of outlines; null: estimated from the residuals, model misfit
    # included; set it if you know the masks' error
    contour_correlation_px: float | None = None  # its length along the outline; null: estimated; set both or none
    calibration_px: float = 0.2  # prior of a camera without a covariance of its own; raise it to your calibration's
    # reprojection error where that is larger


@dataclass(frozen=True, slots=True)
class CapSettings:
    """Sets colour and thickness of the swim or wig cap that the subject wears."""

    colour: str | None = None  # about its colour, #rrggbb or a name (blue, black, white ...), where one is worn
    thickness_mm: float = 1.0  # 0 to 10: latex and silicone 0.4 to 1, cloth 1 to 1.5; add that of flattened hair


@dataclass(frozen=True, slots=True)
class TextureSettings:
    """Sets how the head is coloured (the paper's section 4.5)."""

    blend: Literal["default", "reference"] = "default"  # reference is the paper's weighted mean, for comparison
    balance: bool = True  # gain and offset of each camera; false where the cameras' colours are calibrated already
    sharpening: float = (
        1.0  # unsharp mask of 1 px where there is detail: 1.2, 2.2 and 0.8 dB on three true heads; 0 for
    )
    # photographs that were sharpened before
    chart: bool = False  # true where clean plates show a colour chart: it says what the colours truly are


@dataclass(frozen=True, slots=True)
class BustSettings:
    """Sets the mesh of the bust, the whole visible surface."""

    spacing_mm: float = 1.5  # of its vertices, 0.5 to 3: three pixels of the usual rig; lower it for closer cameras


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """Sets which surfaces are made, and which optional files are written."""

    surface: Literal["head", "bust", "both", "hair"] = "both"  # one alone saves seconds; hair: head_hair.ply, too
    formats: tuple[str, ...] = ("glb", "ply")  # of the head: name those that you open; head.ply is always written
    image: Literal["jpeg", "webp", "png"] = "jpeg"  # of head.glb's texture; webp is smaller, png loses nothing
    texture_size: int | None = None  # texels; null: about a pixel at the face; give it for an engine's limit
    albedo: Literal["none", "file", "glb"] = "none"  # the texture with its light taken off, to be lit anew: file writes
    # texture/albedo.png, glb also shows it in head.glb
    ply_texture: bool = False  # head.ply names head.png and has texture coordinates, for programs that read no other
    neutral: bool = False  # neutral.glb, the head without its expression, for comparisons and animation
    normal_map: bool = False  # head.glb has 10,000 triangles, and a normal map of the rest, for real-time rendering
    morphs: bool = False  # posed.glb, with morph targets under Apple's 52 names; of a template head-NAME.glb, too
    slicer: bool = False  # landmarks.mrk.json, a point list for 3D Slicer
    template: str | None = None  # head-NAME.obj: the head in the vertex order of a registered template, too

    @property
    def textured(self) -> bool:
        """Returns True if any requested file has a texture."""
        requested = self.ply_texture or self.albedo != "none" or bool({"glb", "obj", "usdz"} & set(self.formats))
        return self.surface != "bust" and requested


@dataclass(frozen=True, slots=True)
class Settings:
    """Holds all settings of one reconstruction."""

    method: Literal["contour", "simplex"] = "contour"  # simplex is the paper's own solver, for comparison: it is slower
    detail: Literal["span", "kernel", "photo", "fine", "pores"] | None = None  # null: fine where the photographs carry
    # it; name a coarser one for speed, and pores for maps of the skin's relief, too
    front: str | None = None  # the camera that the subject faces; name it where the guess from the camera fan is wrong
    exchanged_pictures: Literal["repair", "refuse"] = "repair"  # what is done when cameras hold each other's pictures;
    # refuse where a mistake in filing must not pass
    anyway: bool = False  # true warns where a check would refuse a head that is still possible; its pose is doubtful
    unexplained_outlines: Literal["refuse", "warn"] = "refuse"  # of a head that explains hardly any of them; warn for
    # subjects with long hair all around
    device: Literal["auto", "cpu", "gl"] = "auto"  # what compares photographs; auto takes a GPU where there is one and
    # the processor is small; cpu where no driver shall change the last digits, gl for any OpenGL
    fail_on: tuple[str, ...] = ()  # codes of warnings (pipeline.warnings.WARNING_CODES) that shall be failures here
    faces: FaceSettings = field(default_factory=FaceSettings)
    fitting: FittingSettings = field(default_factory=FittingSettings)
    cap: CapSettings = field(default_factory=CapSettings)
    texture: TextureSettings = field(default_factory=TextureSettings)
    bust: BustSettings = field(default_factory=BustSettings)
    outputs: OutputSettings = field(default_factory=OutputSettings)
    warnings: tuple[Message, ...] = field(default=(), metadata={"key": False})  # about old keys of the document


def settings_from_document(document: Mapping[str, Any], subject: str = "settings") -> Settings:
    """Converts decoded JSON or TOML to settings. Raises InputError, which names every unknown key and wrong value."""
    faults: list[Message] = []
    document, warnings = _with_present_keys(document)
    settings = replace(read_fields(Settings, document, "", faults), warnings=warnings)
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
    """Converts settings to nested dictionaries, which ``settings_from_document`` can read."""
    return {name: value for name, value in dataclasses.asdict(settings).items() if name != "warnings"}


def _with_present_keys(document: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[Message, ...]]:
    """Removes or renames the keys of earlier versions in a document; returns it with warnings about these keys."""
    present, fixed, warnings = dict(document), [], []
    for table, names in FIXED.items():
        if table in present and not names:
            del present[table]
            fixed.append(table)
        elif isinstance(present.get(table), Mapping):
            fixed += [f"{table}.{name}" for name in names if name in present[table]]
            present[table] = {name: value for name, value in present[table].items() if name not in names}
    for table, names in RENAMED.items():
        for old, (new, meanings) in names.items():
            if isinstance(present.get(table), Mapping) and old in present[table]:
                warnings.append(compose("setting-renamed", setting=f"{table}.{old}", new=f"{table}.{new}"))
                values = dict(present[table])
                if (value := meanings.get(str(values.pop(old)))) is not None:
                    values.setdefault(new, value)
                present[table] = values
    codes = present.get("fail_on")
    if isinstance(codes, list) and RETIRED_CODE in codes:
        present["fail_on"] = [code for code in codes if code != RETIRED_CODE]
        fixed.append(f"fail_on: {RETIRED_CODE}")
    if fixed:
        warnings.append(compose("old-setting", setting=", ".join(fixed)))
    return present, tuple(warnings)
