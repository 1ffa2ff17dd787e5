"""Defines the expressions of a head model: displacements that are added to the identity, each with a weight from 0 to
1.

A head is ``mean + sum_m z_m modes_m + sum_e w_e shapes_e``: the identity coefficients z are Gaussian, the expressions
are blendshapes with weights w. Expressions keep the names that they have in the model's source. Other programs use
Apple's 52 names (https://developer.apple.com/documentation/arkit/arfaceanchor/blendshapelocation); ``arkit_parts`` maps
Apple's names to a model's blendshapes."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from rig.errors import InputError
from rig.text import suggest

_PAIRS = {"Smile": "mouthSmile", "Stretch": "mouthStretch", "Press": "mouthPress", "LowerDown": "mouthLowerDown",
          "UpperUp": "mouthUpperUp"}  # fmt: skip
MIN_MM = 0.1  # a shape that moves the skin by less is none: pupils, the tongue
SPARSE_MM = 0.004  # what is left out of a file: what float16 loses of a centimetre

BLINKS = {"eyeBlinkRight": "right", "eyeBlinkLeft": "left", "eye-right-closure": "right", "eye-left-closure": "left"}
_SIDED = (
    "browDown", "browOuterUp", "cheekSquint", "eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp",
    "eyeSquint", "eyeWide", "mouthDimple", "mouthFrown", "mouthLowerDown", "mouthPress", "mouthSmile", "mouthStretch",
    "mouthUpperUp", "noseSneer",
)  # fmt: skip
_WHOLE = (
    "browInnerUp", "cheekPuff", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose", "mouthFunnel",
    "mouthLeft", "mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper",
    "tongueOut",
)  # fmt: skip
ARKIT = tuple(sorted([*_WHOLE, *(f"{name}{side}" for name in _SIDED for side in ("Left", "Right"))]))


@dataclass(frozen=True, slots=True, eq=False)
class Expressions:
    """Holds the expressions of a model as displacements (mm, head frame) of the vertices of its coarsest mesh, the
    cage. The arrays are read-only."""

    names: tuple[str, ...]
    shapes: Float32[np.ndarray, "E V0 3"]  # mm at weight 1

    def __len__(self) -> int:
        return len(self.names)

    def moved(self, weights: Mapping[str, float]) -> Float[np.ndarray, "V0 3"]:
        """Returns the displacement of each vertex of the coarsest mesh, the cage (mm), for weights indexed by
        expression name. Raises KeyError for an unknown expression."""
        out = np.zeros(self.shapes.shape[1:])
        for name, weight in weights.items():
            if name not in self.names:
                raise KeyError(name)
            out += weight * self.shapes[self.names.index(name)]
        return out


def no_expressions(vertices: int) -> Expressions:
    """Returns an empty set of expressions for a mesh with this many vertices."""
    return Expressions((), np.zeros((0, vertices, 3), np.float32))


def visible(expressions: Expressions) -> Expressions:
    """Returns the expressions that move at least one vertex of the skin by ``MIN_MM`` or more."""
    kept = np.linalg.norm(expressions.shapes, axis=2).max(axis=1) >= MIN_MM if len(expressions) else np.zeros(0, bool)
    names = tuple(name for name, keep in zip(expressions.names, kept, strict=True) if keep)
    return Expressions(names, expressions.shapes[kept])


def plain_name(name: str) -> str:
    """Returns the name of an expression in Apple's spelling: ``mouthSmile_L`` becomes ``mouthSmileLeft``."""
    return re.sub(r"_([LR])$", lambda side: "Left" if side[1] == "L" else "Right", name)


def words(name: str) -> str:
    """Returns the name of an expression in plain words: ``mouthSmile_L`` becomes ``mouth smile left``."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", plain_name(name))
    return re.sub(r"[-_ ]+", " ", spaced).strip().lower()


def arkit_parts(names: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Returns, for each of Apple's 52 names, the indices of the model's blendshapes that together correspond to it;
    empty if there is none. Most of Apple's names have exactly one blendshape, of the same name. A model may instead
    have two blendshapes for one name, left and right (ICT-FaceKit's cheekPuff_L and cheekPuff_R)."""
    known = {plain_name(name): k for k, name in enumerate(names)}
    found = {}
    for name in ARKIT:
        sides = [known[f"{name}{side}"] for side in ("Left", "Right") if f"{name}{side}" in known]
        found[name] = (known[name],) if name in known else tuple(sides) if len(sides) == 2 else ()
    return found


def weights_from_text(texts: Sequence[str], names: tuple[str, ...]) -> dict[str, float]:
    """Parses texts such as ``mouthSmile_L=0.5``, and returns the weights by the model's expression names. The texts may
    also use Apple's names of expressions. Raises InputError that lists every fault of the texts."""
    known = {plain_name(name): name for name in names} | {name: name for name in names}
    found, faults = {}, []
    for text in texts:
        name, _, amount = text.partition("=")
        try:
            weight = float(amount)
        except ValueError:
            weight = np.nan
        if not 0.0 <= weight <= 1.0:
            faults.append(f"{text}: give NAME=WEIGHT, the weight from 0 to 1")
        elif name not in known:
            near = suggest(name, known, most=3)
            faults.append(f"{name}: the model has no such expression; " + (f"near are {', '.join(near)}" if near else
                          "`eigenhead model info` lists them"))  # fmt: skip
        else:
            found[known[name]] = weight
    if faults:
        raise InputError("expression", faults)
    return found


def closed_lids(weights: Mapping[str, float]) -> dict[str, float]:
    """Returns how far the blink weights close each eye (``right``, ``left``), from 0 (open) to 1 (closed)."""
    found: dict[str, float] = dict.fromkeys(("right", "left"), 0.0)
    for name, weight in weights.items():
        side = BLINKS.get(plain_name(name))
        if side:
            found[side] = min(1.0, found[side] + weight)
    return found


def packed(expressions: Expressions) -> dict[str, np.ndarray]:
    """Packs expressions into the arrays of a model file: only the vertices that each expression moves, in float16
    (error 0.004 mm for a displacement of 1 cm)."""
    moved = np.abs(expressions.shapes).max(axis=2) > SPARSE_MM
    return {
        "expression_counts": moved.sum(axis=1).astype(np.int32),
        "expression_vertices": np.nonzero(moved)[1].astype(np.uint32),
        "expression_moves": expressions.shapes[moved].astype(np.float16),
    }


def unpacked(names: list[str], arrays: Mapping[str, np.ndarray], vertices: int) -> Expressions:
    """Returns the expressions from arrays made by ``packed``, for a mesh with this many vertices. Raises ValueError if
    the arrays do not fit each other."""
    counts, rows, moves = (arrays[f"expression_{part}"] for part in ("counts", "vertices", "moves"))
    if len(counts) != len(names) or counts.sum() != len(rows) or moves.shape != (len(rows), 3):
        raise ValueError("its expressions' arrays do not fit each other")
    if (len(rows) and rows.max() >= vertices) or not np.isfinite(moves).all():
        raise ValueError("an expression moves a vertex that is not there, or nowhere")
    shapes = np.zeros((len(names), vertices, 3), np.float32)
    shapes[np.repeat(np.arange(len(names)), counts), rows] = moves
    return Expressions(tuple(names), shapes)


def _mixture(**weights: float) -> dict[str, float]:
    """Returns weights by Apple's names; a name in ``_PAIRS`` stands for the left and the right expression."""
    out = {}
    for name, weight in weights.items():
        both = [f"{_PAIRS[name]}{side}" for side in ("Left", "Right")] if name in _PAIRS else [name]
        out |= dict.fromkeys(both, weight)
    return out


# The 15 shapes of speech by the names of Oculus Lipsync, as mixtures of Apple's shapes:
# https://developers.meta.com/horizon/documentation/unity/audio-ovrlipsync-viseme-reference. No source says how they are
# made of Apple's; the weights are this project's own, after the pictures there.
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
    """Returns the displacement of a weighted sum of blendshapes; missing blendshapes contribute nothing."""
    out = np.zeros_like(next(iter(shapes.values())))
    for name, weight in mixture.items():
        if name in shapes:
            out += weight * shapes[name]
    return out
