"""Names hair styles, so that a simulated subject can be requested with long or curly hair, a fringe, a beard, or a
cap."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from rig.errors import InputError
from rig.messages.message import compose
from rig.studio.scene.hair import HairStyle
from rig.studio.scene.headwear import TightCap
from rig.studio.scene.subject import Colour, Look

CAP_TONE: Colour = (0.035, 0.06, 0.14)  # navy

SWIM_CAP = TightCap((0.02, 0.10, 0.42))  # blue silicone
WIG_CAP = TightCap((0.018, 0.018, 0.02), folds_mm=2.0, creases=0.5, glossy=False)  # black cloth, badly put on

Change = Callable[[Look], Look]


def _hair(**changes: float | bool) -> Change:
    return lambda appearance: replace(appearance, hair=replace(appearance.hair or HairStyle(), **changes))


def _beard(appearance: Look) -> Look:
    tone = (appearance.hair or HairStyle()).tone
    beard = HairStyle(thickness_mm=13.0, curl_mm=5.0, strands=3500, strand_mm=10.0, stray_mm=1.2, tone=tone)
    return replace(appearance, beard=beard)


def _cap(appearance: Look) -> Look:
    under = (
        replace(appearance.hair, thickness_mm=7.0, fringe_mm=0.0, lumps=0.1, strands=800, stray_mm=0.6)
        if appearance.hair
        else None
    )
    return replace(appearance, hair=under, cap=CAP_TONE)


def _tight(cap: TightCap) -> Change:
    return lambda appearance: replace(appearance, hair=None, cap=None, tight_cap=cap)


HAIRSTYLES: Mapping[str, Change] = MappingProxyType({
    "short": _hair(thickness_mm=12.0, over_ears=False, fringe_mm=0.0),
    "over-ears": _hair(thickness_mm=20.0, over_ears=True, fringe_mm=0.0),
    "long": _hair(thickness_mm=13.0, over_ears=True, fringe_mm=0.0, lumps=0.12, stray_mm=1.6, hanging_mm=150.0),
    "curly": _hair(thickness_mm=22.0, fringe_mm=0.0, lumps=0.2, curl_mm=9.0, strand_mm=14.0),
    "fringe": _hair(thickness_mm=13.0, over_ears=True, fringe_mm=30.0, lumps=0.12),
    "bun": _hair(thickness_mm=6.0, over_ears=False, fringe_mm=0.0, lumps=0.08, strands=1800, bun_mm=33.0),
    "beard": _beard,
    "bald": lambda appearance: replace(appearance, hair=None),
    "cap": _cap,
    "swim-cap": _tight(SWIM_CAP),
    "wig-cap": _tight(WIG_CAP),
    "glasses": lambda appearance: replace(appearance, glasses=True),
})  # fmt: skip
"""What each name changes of a look. Caps and glasses count as clothes in the truth, a beard as hair. Glasses are rims
without panes: the pipeline asks studios for that."""


def restyled(appearance: Look, names: Sequence[str]) -> Look:
    """Returns the look with the named changes of ``HAIRSTYLES`` applied one after the other. Raises InputError for an
    unknown name."""
    if unknown := [name for name in names if name not in HAIRSTYLES]:
        raise InputError("hair", [compose("none-of", value=name, known=[*HAIRSTYLES]) for name in unknown])
    for name in names:
        appearance = HAIRSTYLES[name](appearance)
    return appearance
