"""The mouth's 15 shapes of speech by the names of Oculus Lipsync, as mixtures of Apple's shapes.

The names and what each stands for: https://developers.meta.com/horizon/documentation/unity/audio-ovrlipsync-viseme-reference.
No source says how they are made of Apple's; the weights here are this project's own, after the pictures there.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

_PAIRS = {"Smile": "mouthSmile", "Stretch": "mouthStretch", "Press": "mouthPress", "LowerDown": "mouthLowerDown",
          "UpperUp": "mouthUpperUp"}  # fmt: skip


def _mixture(**weights: float) -> dict[str, float]:
    """Returns weights by Apple's names; a name of ``_PAIRS`` stands for both sides."""
    out = {}
    for name, weight in weights.items():
        both = [f"{_PAIRS[name]}{side}" for side in ("Left", "Right")] if name in _PAIRS else [name]
        out |= dict.fromkeys(both, weight)
    return out


VISEMES: Mapping[str, Mapping[str, float]] = {
    "viseme_sil": {},
    "viseme_PP": _mixture(Press=0.5, mouthRollLower=0.3, mouthRollUpper=0.2),
    "viseme_FF": _mixture(mouthRollLower=0.5, UpperUp=0.3, jawOpen=0.04),
    "viseme_TH": _mixture(jawOpen=0.12, tongueOut=0.4, LowerDown=0.2, UpperUp=0.1),
    "viseme_DD": _mixture(jawOpen=0.1, LowerDown=0.3, UpperUp=0.15),
    "viseme_kk": _mixture(jawOpen=0.18, LowerDown=0.2, Stretch=0.15),
    "viseme_CH": _mixture(mouthFunnel=0.6, jawOpen=0.06),
    "viseme_SS": _mixture(Stretch=0.3, LowerDown=0.3, UpperUp=0.15, jawOpen=0.03),
    "viseme_nn": _mixture(jawOpen=0.08, LowerDown=0.2, UpperUp=0.1),
    "viseme_RR": _mixture(mouthFunnel=0.35, mouthPucker=0.25, jawOpen=0.08),
    "viseme_aa": _mixture(jawOpen=0.6, LowerDown=0.1),
    "viseme_E": _mixture(jawOpen=0.25, Stretch=0.35, Smile=0.15),
    "viseme_I": _mixture(jawOpen=0.15, Smile=0.35, Stretch=0.25),
    "viseme_O": _mixture(jawOpen=0.35, mouthFunnel=0.55),
    "viseme_U": _mixture(mouthPucker=0.65, mouthFunnel=0.25, jawOpen=0.1),
}


def mixed(shapes: Mapping[str, Float[np.ndarray, "v 3"]], mixture: Mapping[str, float]) -> Float[np.ndarray, "v 3"]:
    """Returns the displacement of a mixture; shapes that are not there move nothing."""
    out = np.zeros_like(next(iter(shapes.values())))
    for name, weight in mixture.items():
        if name in shapes:
            out += weight * shapes[name]
    return out
