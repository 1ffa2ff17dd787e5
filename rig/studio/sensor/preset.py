"""Defines the imperfections of the simulated studio, and optional properties of real photographs of skin. Every
benchmark uses ``PRESET``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from rig.errors import InputError
from rig.messages.message import compose


@dataclass(frozen=True, slots=True)
class Preset:
    """Holds the imperfections of the simulated studio. A preset's number whose name states no unit is a fraction of
    full scale or of the light."""

    noise: float = (
        0.015  # sensor noise at mid grey, standard deviation; grows with the light's square root (shot noise)
    )
    light_drift: float = (
        0.02  # between clean plate and shot: of each camera's brightness, and of its slope over the image
    )
    defocus_px: float = 0.7  # standard deviation of the blur
    hair: bool = True
    hairstyle: tuple[str, ...] = ()  # names of ``scene.subject.HAIRSTYLES``, in place of the hair that the seed draws
    clothes: bool = True
    texture: bool = True  # brows, lips, pores, freckles; False paints the skin in one colour
    backdrop_unevenness: float = 1.0  # 0: one flat colour; 1: folds, panels, a gradient
    plates: int = 2  # clean plates a camera: the least from which noise can be told
    exposure_spread: float = 0.06  # between cameras, of brightness
    white_balance_spread: float = 0.03  # between cameras, of each channel
    vignetting: float = 0.12  # light lost in the corner of the image
    pose_spread_deg: float = 5.0  # how the subject holds its head, standard deviation an axis
    pose_spread_mm: float = 8.0
    feature_noise_px: float = 1.5  # of clicked feature points, standard deviation an axis
    rolling_ms: float = 0.0  # from the first row's readout to the last's; 0: all rows at once (global shutter)
    sway_mm_s: float = 20.0  # how fast the subject moves meanwhile, in a direction of its own each time
    samples: int = 4  # coverage samples a pixel
    # What real skin and real cameras do (``REALISM`` has names for it); nothing of it by default.
    pores: float = 1.0  # contrast of pores and freckles, by the painted one
    oil: float = 0.0  # strength of sharp highlights on forehead, nose, cheeks and chin
    scattering_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # over which diffuse red, green and blue light spreads
    read_noise: float = 0.0  # of the sensor without light, share of full scale in linear light
    mosaic: bool = False  # a Bayer filter before the sensor, its gaps filled as cameras do
    jpeg_quality: int | None = None  # of the pictures that a camera hands out; None: not compressed
    polarised: bool = False  # the texture sets cross (without reflections of the skin) and parallel (with them)


PRESET = Preset()
"""Noise 1.5 %, light drift 2 %, defocus 0.7 px, hair, uneven backdrop (issue 2, item 6)."""

Change = Callable[[Preset], Preset]


def _with(**changes: float | bool | tuple[float, float, float]) -> Change:
    return lambda preset: replace(preset, **changes)


REALISM: Mapping[str, Change] = MappingProxyType({
    "smooth": _with(pores=0.15),
    "oily": _with(oil=1.0),
    "scattering": _with(scattering_mm=(3.0, 1.1, 0.6)),
    "mosaic": _with(mosaic=True, read_noise=0.004),
    "jpeg": _with(jpeg_quality=92),
})  # fmt: skip
"""Pores are all but gone in a photograph of 1 px per 0.5 mm; scattering as the path-traced captures have it (Jensen et
al. 2001 measured 3.67, 1.37 and 0.68 mm of mean free path); a read-out noise of one level in mid grey, and JPEG as
cameras write it."""


def made_real(preset: Preset, names: Sequence[str]) -> Preset:
    """Returns the preset with the changes ``names`` of ``REALISM``. Raises InputError for an unknown name."""
    if unknown := [name for name in names if name not in REALISM]:
        raise InputError("realism", [compose("none-of", value=name, known=[*REALISM]) for name in unknown])
    for name in names:
        preset = REALISM[name](preset)
    return preset


def realism_names(text: str | None) -> tuple[str, ...]:
    """Splits ``NAME[,NAME]`` into names. The text ``all`` gives all names of ``REALISM``, and None gives none."""
    return tuple(REALISM) if text == "all" else tuple(text.split(",")) if text else ()
