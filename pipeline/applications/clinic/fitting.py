"""Measures a finished head for the fitting of helmets, masks and spectacles, with standard deviations. The module also
chooses the size of a product: it computes the probability of each size from a measure and its standard deviation.

Measures have the names of ISO 7250-1 and ISO 8559-1 where these standards define one (``ISO_NAMES``). Before measuring,
the head is turned until its Frankfurt plane is horizontal (``anatomical_frame``), as people hold their heads:

- The head circumference is the length of a tape along the convex hull of a section without the ears; the section passes
  through glabella and opisthocranion and is horizontal from side to side.
- The nose-bridge width is measured in the horizontal section ``BRIDGE_BELOW_NASION_MM`` below nasion, at the depth
  ``PAD_DEPTH_MM`` behind its front, where the pads of spectacles lie. The splay angle is measured in the same section
  between each flank of the nose and straight ahead. The frontal angle is the angle between each flank of the nose and
  the vertical, computed from the widths at two heights.
- The frame angle (pantoscopic) is the angle between the vertical and the line that touches brow and cheek in front of
  each eye, positive if the lower rim of spectacles comes nearer to the face.

Standard deviations come from ``DRAWS`` random heads: vertices move along their normals by the result's standard
deviation (``quality`` of head.ply), times a smooth random field with the correlation of the head models
(``gaussian_process.SCALES``). The frame angle's standard deviation also contains the error of the Frankfurt plane's
tilt; those of lengths also contain the error of the cameras' scale.

Sizes are read from a TOML file:

    format = "eigenhead-sizes/1"

    [[table]]
    name = "helmet"
    measure = "head_circumference"
    allowance = 6.0                     # added to the measure: padding, hair; 0 without it
    sizes = { S = [520, 550], M = [550, 580], L = [580, 610] }

Limits of a size have the unit of its measure (mm, or degrees); the lower limit belongs to the size."""

import tomllib
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError
from scipy.special import ndtr

from pipeline.applications.clinic.anatomical_frame import frankfurt_axes
from pipeline.applications.clinic.visit import Visit
from pipeline.head_model.gaussian_process import SCALES
from rig.errors import InputError
from rig.messages.message import Message, compose

FORMAT = "eigenhead-sizes/1"
EXAMPLE = f'format = "{FORMAT}", [[table]], name = "cap", measure = "head_length", sizes = {{ S = [180, 190] }}'
KEYS = frozenset({"name", "measure", "sizes", "allowance"})
MIN_STD = 1e-6
ISO_NAMES: Mapping[str, str] = {
    "head_circumference": "head circumference (ISO 7250-1), head girth (ISO 8559-1)",
    "head_length": "head length (ISO 7250-1)",
    "head_breadth": "head breadth (ISO 7250-1)",
    "pupil_distance": "interpupillary distance, far (ISO 13666)",
    "face_height": "face length, nasion to menton (ISO 7250-1)",
}
BRIDGE_BELOW_NASION_MM = 7.0
PAD_DEPTH_MM = 8.0
FLANK_DEPTHS_MM = (4.0, 8.0)
FLANK_HEIGHTS_MM = (5.0, 11.0)  # below nasion
EYE_HALF_WIDTH_MM = 4.0  # of the band before an eye that a frame's rim spans
ABOVE_EYE_MM, BELOW_EYE_MM = 35.0, 40.0
CRANIUM_BEHIND_MM = 40.0  # the ears' line; less is a face without a cranium
SPARE_MM = 15.0  # longer than any edge of a head
LOWEST_MM = 60.0  # below nasion nothing is measured
DRAWS, WAVES = 48, 32

Points = Float[np.ndarray, "_ 3"]


@dataclass(frozen=True, slots=True)
class SizeTable:
    """Holds the limits of each size of a product, in the unit of the measure that decides the size."""

    name: str
    measure: str
    sizes: Mapping[str, tuple[float, float]]
    allowance: float = 0.0


@dataclass(frozen=True, slots=True)
class SizeChoice:
    """Holds the probability that each size of a table fits, and the probability ``none`` that no size fits."""

    table: str
    measure: str
    probabilities: Mapping[str, float]
    none: float

    @property
    def best(self) -> str:
        """Returns the most probable size."""
        return max(self.probabilities, key=lambda size: self.probabilities[size])


def read_size_tables(path: Path, measures: Set[str]) -> list[SizeTable]:
    """Reads a TOML file of size tables, each for one of the ``measures``. Raises InputError that lists every fault."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InputError(path.name, [compose("sizes-unread", reason=str(error), example=EXAMPLE)]) from error
    entries = document.get("table")
    if document.get("format") != FORMAT or not isinstance(entries, list) or not entries:
        raise InputError(path.name, [compose("sizes-no-table", format=FORMAT, example=EXAMPLE)])
    faults = [fault for number, entry in enumerate(entries, 1) for fault in _faults(number, entry)] or [
        compose(
            "size-measure-unknown", table=entry["name"], measure=entry["measure"], known=", ".join(sorted(measures))
        )
        for entry in entries
        if entry["measure"] not in measures
    ]
    if faults:
        raise InputError(path.name, faults)
    return [
        SizeTable(
            entry["name"],
            entry["measure"],
            {size: (float(low), float(high)) for size, (low, high) in entry["sizes"].items()},
            float(entry.get("allowance", 0.0)),
        )
        for entry in entries
    ]


def choose_size(table: SizeTable, value: float, std: float) -> SizeChoice:
    """Returns the probability that each size of a table fits, for a measure with a normally distributed error."""
    wanted, spread = value + table.allowance, max(std, MIN_STD)
    found = {
        size: float(ndtr((high - wanted) / spread) - ndtr((low - wanted) / spread))
        for size, (low, high) in table.sizes.items()
    }
    return SizeChoice(table.name, table.measure, found, max(1.0 - sum(found.values()), 0.0))


def _faults(number: int, entry: Any) -> list[Message]:
    """Returns the faults of one table in the file of sizes."""
    if not isinstance(entry, dict):
        return [compose("size-key-wrong", number=number, key="table")]
    wrong = [key for key in ("name", "measure") if not isinstance(entry.get(key), str) or not entry[key]]
    wrong += sorted(entry.keys() - KEYS)
    if not _is_number(entry.get("allowance", 0.0)):
        wrong.append("allowance")
    sizes = entry.get("sizes")
    if not isinstance(sizes, dict) or not sizes:
        return [compose("size-key-wrong", number=number, key=key) for key in [*wrong, "sizes"]]
    bad = [
        size
        for size, limits in sizes.items()
        if not isinstance(limits, list)
        or len(limits) != 2
        or not all(_is_number(limit) for limit in limits)
        or not limits[0] < limits[1]
    ]
    faults = [compose("size-key-wrong", number=number, key=key) for key in wrong]
    faults += [compose("size-limits-wrong", number=number, size=size) for size in bad]
    if not bad:
        ordered = sorted(sizes.items(), key=lambda of: of[1][0])
        faults += [
            compose("sizes-overlap", number=number, size=one, other=other)
            for (one, limits), (other, after) in pairwise(ordered)
            if after[0] < limits[1]
        ]
    return faults


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9


@dataclass(frozen=True, slots=True)
class Fitted:
    """Holds a measure and its standard deviation, in ``unit`` (mm or deg)."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class UprightHead:
    """Holds a head in RAS axes of the Frankfurt plane (mm), its landmarks, and a mask of the ears' vertices."""

    vertices: Float[np.ndarray, "v 3"]
    faces: np.ndarray
    marks: Mapping[str, Float[np.ndarray, " 3"]]
    ears: Bool[np.ndarray, " v"]


def fitting_measures(visit: Visit) -> dict[str, Fitted]:
    """Returns all measures of a head by name. Raises InputError if landmarks of the Frankfurt plane are missing."""
    measured = visit.measured
    frame = frankfurt_axes(measured, "RAS")
    motion = frame.patient_from_world
    marks = {name: motion.apply(point) for name, point in measured.landmarks.items()}
    whole = motion.apply(measured.mesh_world.vertices)
    kept = whole[:, 2] > marks["nasion"][2] - LOWEST_MM
    faces = (np.cumsum(kept) - 1)[measured.mesh_world.faces[kept[measured.mesh_world.faces].all(axis=1)]]
    vertices, stated = whole[kept], measured.stated_mm[kept]
    normals = measured.mesh_world.normals()[kept] @ motion.rotation.T
    head = UprightHead(vertices, faces, marks, measured.regions["ears"][kept])
    units = {name: value for name, value in _all(head).items() if value is not None}
    drawn: dict[str, list[float]] = {name: [] for name in units}
    for field in _fields(vertices):
        moved = UprightHead(vertices + (stated * field)[:, None] * normals, head.faces, marks, head.ears)
        for name, value in _all(moved).items():
            if name in drawn and value is not None:
                drawn[name].append(value)
    found = {}
    for name in (name for name in units if len(drawn[name]) > DRAWS // 2):
        unit = "deg" if name.endswith("angle") else "mm"
        tilt = frame.tilt_std_deg or 0.0
        shared = visit.scale_sigma * units[name] if unit == "mm" else tilt if name == "frame_angle" else 0.0
        found[name] = Fitted(units[name], float(np.hypot(np.std(drawn[name], ddof=1), shared)), unit)
    return found


def _all(head: UprightHead) -> dict[str, float | None]:
    return {name: measure(head) for name, measure in MEASURES.items()}


def head_circumference(head: UprightHead) -> float | None:
    """Returns the length (mm) of a tape around the head; None for heads without a cranium."""
    front = head.marks["glabella"]
    middle = (np.abs(head.vertices[:, 0] - front[0]) < 5.0) & (head.vertices[:, 2] > 0.0)
    middle &= head.vertices[:, 1] < -CRANIUM_BEHIND_MM
    if not middle.any():
        return None
    behind = head.vertices[middle]
    back = behind[np.argmax(np.linalg.norm(behind - front, axis=1))]
    along = (back - front) * (0.0, 1.0, 1.0)
    along /= np.linalg.norm(along)
    normal = np.cross((1.0, 0.0, 0.0), along)
    faces = head.faces[~head.ears[head.faces].any(axis=1)]
    points = section(head.vertices, faces, front, normal)
    return hull_perimeter(np.stack([points[:, 0], points @ along], axis=1))


def bridge_width(head: UprightHead) -> float | None:
    """Returns the width (mm) of the nose's bridge where the pads of spectacles lie."""
    return _width(head, BRIDGE_BELOW_NASION_MM, PAD_DEPTH_MM)


def splay_angle(head: UprightHead) -> float | None:
    """Returns the mean angle (degrees) between the flanks of the nose's bridge and straight ahead."""
    narrow, wide = (_width(head, BRIDGE_BELOW_NASION_MM, depth) for depth in FLANK_DEPTHS_MM)
    return (
        None if narrow is None or wide is None else _half_angle(wide - narrow, FLANK_DEPTHS_MM[1] - FLANK_DEPTHS_MM[0])
    )


def frontal_angle(head: UprightHead) -> float | None:
    """Returns the mean angle (degrees) of the bridge's flanks to the vertical; positive if they widen downwards."""
    crest = _crest(head, FLANK_HEIGHTS_MM[0])
    if crest is None:
        return None
    plane = crest - PAD_DEPTH_MM  # a front of spectacles is upright
    high, low = (_width(head, below, None, plane) for below in FLANK_HEIGHTS_MM)
    return None if high is None or low is None else _half_angle(low - high, FLANK_HEIGHTS_MM[1] - FLANK_HEIGHTS_MM[0])


def frame_angle(head: UprightHead) -> float | None:
    """Returns the mean tilt (degrees) of the lines that touch brow and cheek in front of each eye."""
    found = [_brow_to_cheek(head, side) for side in ("right", "left")]
    return None if None in found else float(np.mean([angle for angle in found if angle is not None]))


MEASURES: Mapping[str, Callable[[UprightHead], float | None]] = {
    "head_circumference": head_circumference,
    "nose_bridge_width": bridge_width,
    "nose_bridge_splay_angle": splay_angle,
    "nose_bridge_frontal_angle": frontal_angle,
    "frame_angle": frame_angle,
}


def section(vertices: Points, faces: np.ndarray, origin: Float[np.ndarray, " 3"], normal: np.ndarray) -> Points:
    """Returns the points where the triangles' edges cross a plane."""
    height = (vertices - origin) @ normal
    above = height > 0.0
    first, second, third = (above[faces[:, corner]] for corner in range(3))
    passed = faces[(first != second) | (second != third)]
    edges = np.concatenate([passed[:, [0, 1]], passed[:, [1, 2]], passed[:, [2, 0]]])
    edges = np.unique(np.sort(edges[above[edges[:, 0]] != above[edges[:, 1]]], axis=1), axis=0)
    one, other = height[edges[:, 0]], height[edges[:, 1]]
    share = one / (one - other)
    return vertices[edges[:, 0]] + share[:, None] * (vertices[edges[:, 1]] - vertices[edges[:, 0]])


def hull_perimeter(points: Float[np.ndarray, "n 2"]) -> float | None:
    """Returns the perimeter of the convex hull of points in a plane; None if the points lie on a line."""
    try:
        return float(ConvexHull(points).area)  # the length of the border, in two dimensions
    except (QhullError, ValueError):
        return None


def _nose_section(head: UprightHead, below_mm: float) -> Points:
    """Returns the points of the nose's horizontal section at a height below nasion, from right to left (mm)."""
    nasion = head.marks["nasion"]
    reach = np.abs(head.marks["endocanthion_right"][0] - head.marks["endocanthion_left"][0]) / 2.0
    off = head.vertices - nasion
    nose = (np.abs(off[:, 0]) < reach + SPARE_MM) & (off[:, 1] > -30.0 - SPARE_MM)
    nose &= np.abs(off[:, 2] + below_mm) < SPARE_MM
    faces = head.faces[nose[head.faces[:, 0]]]  # all of them would be a hundred times as many
    points = section(head.vertices, faces, nasion - (0.0, 0.0, below_mm), np.array([0.0, 0.0, 1.0]))
    near = (np.abs(points[:, 0] - nasion[0]) < reach) & (points[:, 1] > nasion[1] - 30.0)
    return points[near][np.argsort(points[near, 0])]


def _crest(head: UprightHead, below_mm: float) -> float | None:
    points = _nose_section(head, below_mm)
    return float(points[:, 1].max()) if len(points) else None


def _width(head: UprightHead, below_mm: float, depth_mm: float | None, plane: float | None = None) -> float | None:
    """Returns the nose's width in a horizontal section, at a depth behind its front or in a given vertical plane."""
    points = _nose_section(head, below_mm)
    if len(points) < 4:
        return None
    top = int(np.argmax(points[:, 1]))
    level = points[top, 1] - depth_mm if depth_mm is not None else plane
    sides = []
    for flank in (points[: top + 1][::-1], points[top:]):
        behind = np.flatnonzero(flank[:, 1] <= level)
        if not len(behind) or behind[0] == 0:
            return None
        before, after = flank[behind[0] - 1], flank[behind[0]]
        share = (before[1] - level) / max(before[1] - after[1], 1e-9)
        sides.append(before[0] + share * (after[0] - before[0]))
    return float(sides[1] - sides[0])


def _half_angle(wider_mm: float, length_mm: float) -> float:
    return float(np.degrees(np.arctan2(0.5 * wider_mm, length_mm)))


def _brow_to_cheek(head: UprightHead, side: str) -> float | None:
    """Returns the tilt (degrees) of the line that touches the face above and below an eye."""
    eye = 0.5 * (head.marks[f"exocanthion_{side}"] + head.marks[f"endocanthion_{side}"])
    off = head.vertices - eye
    near = (np.abs(off[:, 0]) < EYE_HALF_WIDTH_MM) & (off[:, 1] > -25.0)
    near &= (off[:, 2] < ABOVE_EYE_MM) & (off[:, 2] > -BELOW_EYE_MM)
    profile = off[near][:, 1:]
    try:
        corners = profile[ConvexHull(profile).vertices]
    except (QhullError, ValueError):
        return None
    for one, other in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        low, high = sorted((one, other), key=lambda point: point[1])
        if low[1] < 0.0 <= high[1] and 0.5 * (low[0] + high[0]) > profile[:, 0].mean():
            return float(np.degrees(np.arctan2(high[0] - low[0], high[1] - low[1])))
    return None


def _fields(vertices: Points) -> list[Float[np.ndarray, " v"]]:
    """Returns smooth random fields of unit variance over a surface: sums of waves with the head models' spectrum."""
    rng = np.random.default_rng(0)
    weights = np.array([scale.amplitude_mm**2 for scale in SCALES])
    lengths = np.array([scale.length_mm for scale in SCALES])
    picked = lengths[rng.choice(len(SCALES), (DRAWS, WAVES), p=weights / weights.sum())]
    waves = rng.standard_normal((DRAWS, WAVES, 3)) / picked[:, :, None]
    phases = rng.uniform(0.0, 2.0 * np.pi, (DRAWS, WAVES))
    places = vertices.astype(np.float32)
    return [
        np.sqrt(2.0 / WAVES) * np.cos(places @ wave.T.astype(np.float32) + phase.astype(np.float32)).sum(axis=1)
        for wave, phase in zip(waves, phases, strict=True)
    ]
