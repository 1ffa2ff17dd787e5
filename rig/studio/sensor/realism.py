"""Adds, by name, what real photographs of skin have and the plain studio's lack: smooth and oily skin, light that
spreads in it, a colour filter before the sensor, JPEG."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from rig.errors import InputError
from rig.messages.message import compose
from rig.studio.sensor.preset import Preset

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
    """Returns the preset with the named changes of ``REALISM``. Raises InputError for an unknown name."""
    if unknown := [name for name in names if name not in REALISM]:
        raise InputError("realism", [compose("none-of", value=name, known=[*REALISM]) for name in unknown])
    for name in names:
        preset = REALISM[name](preset)
    return preset


def realism_names(text: str | None) -> tuple[str, ...]:
    """Reads the names in ``NAME[,NAME]``; ``all`` stands for all of ``REALISM``, None for none."""
    return tuple(REALISM) if text == "all" else tuple(text.split(",")) if text else ()
