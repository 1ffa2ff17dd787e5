"""Computes the skin's colour at each vertex from a uniform tone, blotches, and features at landmarks."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rig.studio.scene.anatomy import Anatomy, Landmarks

Vertices = Float[np.ndarray, "v 3"]
Vector = Float[np.ndarray, " 3"]

BROW = np.array([0.035, 0.022, 0.015])
LIP = np.array([0.40, 0.13, 0.12])
DRY = 0.25  # oil of skin beside the oily zones


def skin_paint(
    vertices: Vertices,
    body: Anatomy,
    tone: tuple[float, float, float],
    stubble: float,
    rng: np.random.Generator,
    *,
    closed: Mapping[str, float] | None = None,
    eyeballs: bool = False,
) -> Float[np.ndarray, "v 4"]:
    """Computes the linear albedo of the skin at each vertex (head frame, mm) and, as a fourth number, the strength of
    its fine structure. ``closed`` is the degree (0 to 1) to which each eye is closed. With ``eyeballs``, no eyes are
    painted on the skin."""
    paint = np.ones((len(vertices), 4))
    paint[:, :3] = np.array(tone) * (1 + _blotches(vertices, rng) * (0.5, 1.0, 1.0))
    if body.landmarks:
        _blush(paint, vertices, body.landmarks)
        _beard(paint, vertices, body.landmarks, stubble)
        _mouth(paint, vertices, body.landmarks)
        for side in ("right", "left"):
            _eye(paint, vertices, body.landmarks, side, (closed or {}).get(side, 0.0), eyeballs=eyeballs)
    paint[:, :3] = np.maximum(paint[:, :3], 0.004)
    return paint


def oily_zones(vertices: Vertices, body: Anatomy) -> Float[np.ndarray, " v"]:
    """Returns the oiliness (0 to 1) of the skin at each vertex. The skin is oiliest on forehead, nose, cheeks and chin.
    Without landmarks, the skin's oiliness is constant."""
    marks = body.landmarks
    if not marks:
        return np.full(len(vertices), DRY)
    forehead = marks["glabella"] + (0.0, 28.0, -4.0)
    cheeks = [
        (marks[f"exocanthion_{side}"] + marks[f"cheilion_{side}"]) / 2 + (-4.0 * sign, 8.0, 0.0)
        for side, sign in (("right", -1), ("left", 1))
    ]
    zones = [(forehead, 28.0), (marks["pronasale"], 16.0), (marks["gnathion"] + (0.0, 12.0, 6.0), 14.0)]
    zones += [(cheek, 16.0) for cheek in cheeks]
    apart = np.array([np.exp(-0.5 * ((vertices - at) ** 2).sum(axis=1) / size**2) for at, size in zones])
    return DRY + (1.0 - DRY) * apart.max(axis=0)


def _blotches(vertices: Vertices, rng: np.random.Generator) -> Float[np.ndarray, "v 1"]:
    """Returns random blotches at each vertex: a sum of waves of 15 to 60 mm with a standard deviation of about 0.06."""
    waves = rng.normal(0, 1, (24, 3))
    waves *= (2 * np.pi / rng.uniform(15, 60, (24, 1))) / np.linalg.norm(waves, axis=1, keepdims=True)
    return 0.06 * np.sin(vertices @ waves.T + rng.uniform(0, 2 * np.pi, 24)).sum(axis=1, keepdims=True) / np.sqrt(12)


def _mix(paint: Float[np.ndarray, "v 4"], share: Float[np.ndarray, " v"], colour: Vector) -> None:
    paint[:, :3] += share[:, None] * (colour - paint[:, :3])


def smoothstep(low: float, high: float, x: Float[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
    """Returns a smooth step from 0 where ``x`` is ``low`` to 1 where ``x`` is ``high``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _blush(paint: Float[np.ndarray, "v 4"], vertices: Vertices, marks: Landmarks) -> None:
    for side, sign in (("right", -1), ("left", 1)):
        cheek = (marks[f"exocanthion_{side}"] + marks[f"cheilion_{side}"]) / 2 + (8 * sign, -2, 0)
        share = np.exp(-((vertices - cheek) ** 2).sum(axis=1) / 500)
        paint[:, 1:3] *= 1 - 0.22 * share[:, None]
    nose = np.exp(-((vertices - marks["pronasale"]) ** 2).sum(axis=1) / 260)
    paint[:, 1:3] *= 1 - 0.15 * nose[:, None]


def _beard(paint: Float[np.ndarray, "v 4"], vertices: Vertices, marks: Landmarks, stubble: float) -> None:
    x, y, z = vertices.T
    mouth, chin = marks["stomion"], marks["gnathion"]
    share = smoothstep(14, 2, y - mouth[1] - 0.004 * (x - mouth[0]) ** 2) * smoothstep(-75, -45, z - chin[2])
    share *= smoothstep(-38, -14, y - chin[1]) * stubble
    paint[:, :3] *= 1 - 0.42 * share[:, None]
    paint[:, 3] += 1.6 * share


def _mouth(paint: Float[np.ndarray, "v 4"], vertices: Vertices, marks: Landmarks) -> None:
    x, y, z = vertices.T
    right, left, line = marks["cheilion_right"], marks["cheilion_left"], marks["stomion"]
    half = (left[0] - right[0]) / 2
    across = (x - (left[0] + right[0]) / 2) / half
    bow = np.maximum(1 - across**2, 0)
    top = line[1] + (marks["labiale_superius"][1] - line[1]) * bow * (1 - 0.25 * np.exp(-60 * across**2)) + 0.5
    bottom = line[1] + (marks["labiale_inferius"][1] - line[1]) * bow - 3.0 * bow
    inside = np.minimum(np.minimum(top - y, y - bottom), half * (1 - np.abs(across)))
    front = z > min(right[2], left[2]) - 12
    _mix(paint, 0.75 * front * smoothstep(-0.9, 0.9, inside), LIP)
    seam = np.exp(-(((y - line[1]) / 1.2) ** 2)) * (np.abs(across) < 0.95) * front
    paint[:, :3] *= 1 - 0.55 * seam[:, None]


def _eye(
    paint: Float[np.ndarray, "v 4"], vertices: Vertices, marks: Landmarks, side: str, closed: float, *, eyeballs: bool
) -> None:
    """Paints a brow, and either an eye or only lashes, on the skin of one side."""
    x, y, z = vertices.T
    outer, inner = marks[f"exocanthion_{side}"], marks[f"endocanthion_{side}"]
    span = outer[0] - inner[0]
    lift = 0.62 * (marks["glabella"][1] - (outer[1] + inner[1]) / 2)
    along = np.clip(
        (x - inner[0] + 0.12 * span) / (1.42 * span), -0.2, 1.2
    )  # 0 at the inner end of the brow, 1 outside
    arch = outer[1] + lift * (1.0 + 1.2 * along * (1 - along) * 1.25 - 0.2 * along)
    width = 4.4 - 2.8 * np.clip(along, 0, 1)
    inside = smoothstep(-0.06, 0.06, along) * smoothstep(1.06, 0.94, along) * (z > outer[2] - 18)
    brow = inside * smoothstep(1.0, 0.4, np.abs(y - arch) / width)
    _mix(paint, 0.85 * brow, BROW)
    paint[:, 3] += 3.0 * brow
    if eyeballs:
        _lashes(paint, eye_gap(vertices, inner, outer, closed))
    else:
        _open_eye(paint, vertices, inner, outer, closed)


@dataclass(frozen=True, slots=True, eq=False)
class EyeGap:
    """Holds the position of each vertex relative to the gap between two lids. The position along the gap is 0 at the
    inner corner and 1 at the outer corner. The distance from its middle line and half its height are in mm."""

    along: Float[np.ndarray, " v"]
    off: Float[np.ndarray, " v"]
    height: Float[np.ndarray, " v"]
    bow: Float[np.ndarray, " v"]
    here: Bool[np.ndarray, " v"]


def eye_gap(vertices: Vertices, inner: Vector, outer: Vector, closed: float) -> EyeGap:
    """Computes positions relative to the gap between the lids of an eye. As ``closed`` rises from 0 to 1, the upper lid
    moves down to the lower lid."""
    x, y, z = vertices.T
    along = np.clip((x - inner[0]) / (outer[0] - inner[0]), 0, 1)
    bow = 4 * along * (1 - along)
    off = y - (inner[1] + along * (outer[1] - inner[1]) + 1.4 * bow) + 4.0 * bow * closed
    here = (along > 0.02) & (along < 0.98) & (z > outer[2] - 14)
    return EyeGap(along, off, 4.0 * bow * (1.0 - closed), bow, here)


def _open_eye(paint: Float[np.ndarray, "v 4"], vertices: Vertices, inner: Vector, outer: Vector, closed: float) -> None:
    """Paints white, iris and pupil between the lids, and the upper lashes, on the skin."""
    x, y, _ = vertices.T
    gap = eye_gap(vertices, inner, outer, closed)
    opening = gap.here * smoothstep(0.6, -0.6, np.abs(gap.off) - gap.height) * (closed < 1.0)
    _mix(paint, opening, np.array([0.44, 0.40, 0.38]))
    paint[:, 3] *= 1 - 0.8 * opening
    middle = (inner + outer) / 2 + (0, 1.8, 0)
    radius = np.hypot(x - middle[0], y - middle[1])
    _mix(paint, opening * smoothstep(6.0, 5.0, radius), np.array([0.09, 0.06, 0.035]))
    _mix(paint, opening * smoothstep(2.6, 1.8, radius), np.array([0.008, 0.008, 0.008]))
    _lashes(paint, gap)


def _lashes(paint: Float[np.ndarray, "v 4"], gap: EyeGap) -> None:
    lash = (
        gap.here
        * smoothstep(1.5, 0.5, np.abs(gap.off - gap.height - 0.2 * gap.bow))
        * smoothstep(0.0, 0.15, gap.along)
        * smoothstep(1.0, 0.9, gap.along)
    )
    paint[:, :3] *= 1 - 0.75 * lash[:, None]
