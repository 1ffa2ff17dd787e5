"""Tests whether all views show one moment and one person, by the picture of the face.

Enters: the subject's face in the views, the photographs and the cameras. Leaves: the views whose face lies elsewhere
or whose mouth is another. Every photograph is drawn onto the triangulated face, and three parts of each two drawings
are compared by normalised cross-correlation over shifts up to ``REACH_MM``. A part's depth may be wrong, which shifts
its drawings in proportion to the cameras' slopes: that one number is fitted for each part, and what remains is split
into an offset for each view. A moved head has the same offset in all parts. Landmarks alone scatter by 1.2 mm
in frontal views and by up to 8 mm in profiles, drawings by .3 and .9 mm (median and 95 % of 194 views).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.faces.detection import FaceDetection
from pipeline.faces.matching import MatchedFaces, match_faces
from pipeline.faces.points import direction_from_face, point_table
from pipeline.faces.subject import SubjectFaces
from rig.camera import Camera
from rig.image import ImageRgb
from rig.rig import Rig

CELL_MM = 2.0  # of a drawing: a pixel of a head that fills a picture of 500 rows
REACH_MM = 16.0
PARTS_MM = {"eyes": (-50, 50, 8, 60), "nose": (-44, 44, -26, 16), "mouth": (-32, 32, -72, -24)}  # left right low high
BLUR_MM = 8.0  # standard deviation of what is subtracted: light differs between cameras
MIN_COSINE = 0.3  # between the skin's normal and the direction to the camera
MIN_SHARE = 0.35  # of a part's cells that two drawings share
MIN_LIKENESS = 0.35  # correlation of a shift that counts
MIN_PARTS = 2  # of a view that is judged
DEPTH_PRIOR = 0.02  # keeps the depth 0 where all cameras have one slope
MAX_OFFSET_MM = 2.75  # 2.6 is the largest of views of one moment, of five cameras far apart
MAX_MOUTH_LIKENESS = 0.75  # of a mouth that is open for shut (0.50 to 0.74 with the best other view) ...
MIN_MOUTH_OFFSET_MM = 1.5  # ... and that lies elsewhere than the eyes say (1.6 to 14; one moment at most 1.4) ...
MAX_ELEVATION = 0.42  # ... in cameras that look at the face from less than 25 degrees above it (sine)


@dataclass(frozen=True, slots=True)
class OddView:
    """Holds a view that shows another moment or person, and how far its face, or its mouth alone, lies from where the
    others see it (mm, along the face)."""

    camera: str
    part: Literal["face", "mouth"]
    offset_mm: float


@dataclass(frozen=True, slots=True)
class MomentCheck:
    """Holds the views that differ from the others. ``certain`` is False where the views contradict each other and
    none of them is known to be the wrong one."""

    odd: tuple[OddView, ...] = ()
    certain: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class _Shift:
    """Holds how one part of the drawing of ``first`` must be moved to lie on that of ``second`` (mm)."""

    first: str
    second: str
    shift_mm: Float[np.ndarray, " 2"]
    likeness: float


def check_one_moment(subject: SubjectFaces, images: Mapping[str, ImageRgb], rig: Rig) -> MomentCheck:
    """Finds the views whose face is not that of the others.

    Args:
        subject: the faces that were found.
        images: sRGB, by camera.
        rig: the cameras.
    """
    odd: list[OddView] = []
    count = len(_views_with_face(subject))
    while count > 1:
        sizes, mouths = _compare(subject, images, rig)
        suspects = [name for name, size in sizes.items() if size > MAX_OFFSET_MM]
        left = _views_with_face(subject)
        if not suspects:
            # Views that disagree about the head make the drawings of its mouth differ, too.
            odd = odd or mouths
            break
        worst = max(suspects, key=lambda name: sizes[name])
        if len(left) == 3:  # each may be the wrong one that the two others agree without
            sure = [name for name in left if _agree(without_views(subject, [name], rig), images, rig)]
            worst = sure[0] if len(sure) == 1 else None
        if worst is None or len(left) < 3 or 2 * (len(odd) + 1) >= count:
            doubtful = suspects if len(left) > 3 else left
            unclear = [OddView(name, "face", sizes.get(name, 0.0)) for name in doubtful]
            return MomentCheck((*odd, *unclear), certain=False)
        odd.append(OddView(worst, "face", sizes.get(worst, 0.0)))
        subject = without_views(subject, [worst], rig)
    return MomentCheck(tuple(odd), certain=2 * len(odd) < max(count, 1))


def _views_with_face(subject: SubjectFaces) -> list[str]:
    """Returns the views that show the subject's face, or another one where it must be."""
    if subject.matched is None:
        return []
    shown = [name for name in subject.expected if subject.found.get(name)]
    return list(dict.fromkeys([*subject.matched.detections, *subject.matched.outliers, *shown]))


def _agree(subject: SubjectFaces, images: Mapping[str, ImageRgb], rig: Rig) -> bool:
    return subject.matched is not None and max(_compare(subject, images, rig)[0].values(), default=0.0) <= MAX_OFFSET_MM


def _compare(subject: SubjectFaces, images: Mapping[str, ImageRgb], rig: Rig) -> tuple[dict[str, float], list[OddView]]:
    """Returns by how much each view's face is off that of the others (mm), and the views of another mouth."""
    names, face = _views_with_face(subject), subject.matched
    if face is None:
        return {}, []
    drawings = {name: _draw(face, images[name], rig[name]) for name in names}
    slopes = {name: _slope(face, rig[name]) for name in names}
    parts = {part: _shifts(drawings, part) for part in PARTS_MM}
    by_part = {part: _part_offsets(names, shifts, slopes) for part, shifts in parts.items()}
    sizes = _sizes(names, list(by_part.values()))
    likeness = {part: _likeness(names, shifts) for part, shifts in parts.items()}
    for name in names:
        if name not in sizes and sum(name in alike for alike in likeness.values()) >= MIN_PARTS:  # like no other view
            detection = face.detections.get(name) or face.outliers.get(name) or subject.found[name][0]
            sizes[name] = _landmark_offset(face, detection, rig[name])
    low = [name for name in names if direction_from_face(face.world_from_face, rig[name])[1] < MAX_ELEVATION]
    return sizes, _odd_mouths(low, by_part, likeness["mouth"])


def _landmark_offset(face: MatchedFaces, detection: FaceDetection, camera: Camera) -> float:
    """Returns the median distance (mm) of a view's landmarks from those of the face."""
    depth = camera.camera_from_world.apply(face.points_world)[:, 2]
    off = np.linalg.norm(detection.landmarks_px - camera.project(face.points_world), axis=1)
    return float(np.median(off * depth / camera.intrinsics.fx))


def without_views(subject: SubjectFaces, names: Sequence[str], rig: Rig) -> SubjectFaces:
    """Returns the subject's faces without some views, its points triangulated from the others."""
    face = subject.matched
    assert face is not None
    left = {name: (seen,) for name, seen in face.detections.items() if name not in names}
    found = {name: () if name in names else faces for name, faces in subject.found.items()}
    return SubjectFaces(found, match_faces(left, rig), tuple(name for name in subject.expected if name not in names))


@cache
def _cells() -> tuple[tuple[int, int], Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Returns rows and columns of a drawing, and for each cell three landmarks with their weights and whether it lies
    between them. Cells are a grid across a mean face, from its top left."""
    from scipy.spatial import Delaunay

    x, y = (np.arange(*span, CELL_MM) for span in ((-56.0, 57.0), (-76.0, 69.0)))
    grid = np.stack(np.meshgrid(x, y[::-1]), axis=-1)
    mesh = Delaunay(point_table().shape_mm[:, :2])
    triangle = mesh.find_simplex(grid.reshape(-1, 2))
    to_weights = mesh.transform[triangle]
    two = np.einsum("nij,nj->ni", to_weights[:, :2], grid.reshape(-1, 2) - to_weights[:, 2])
    weights = np.column_stack([two, 1.0 - two.sum(axis=1)])
    return grid.shape[:2], mesh.simplices[triangle], weights, triangle >= 0


def _part(part: str) -> tuple[slice, slice]:
    (rows, columns), (left, right, low, high) = _cells()[0], PARTS_MM[part]
    x, y = np.arange(columns) * CELL_MM - 56.0, np.arange(rows)[::-1] * CELL_MM - 76.0
    row, column = np.flatnonzero((y >= low) & (y <= high)), np.flatnonzero((x >= left) & (x <= right))
    return slice(row[0], row[-1] + 1), slice(column[0], column[-1] + 1)


def _draw(
    face: MatchedFaces, image: ImageRgb, camera: Camera
) -> tuple[Float32[np.ndarray, "r c"], Float32[np.ndarray, "r c"]]:
    """Returns a photograph drawn onto the face, its light subtracted, and 1 for each cell that the camera sees."""
    shape, rows, weights, inside = _cells()
    points = (weights[..., None] * face.points_world[rows]).sum(axis=1)
    normals = (weights[..., None] * point_table().normals[rows]).sum(axis=1) @ face.world_from_face.rotation.T
    towards = camera.centre_world - points
    distance = np.linalg.norm(towards, axis=1)
    cosine = (normals * towards).sum(axis=1) / distance / np.linalg.norm(normals, axis=1)
    pixels = camera.project(points)
    size = np.array(image.shape[1::-1])
    low = np.clip(np.floor(np.nanmin(pixels, axis=0)) - 8, 0, size - 1).astype(int)
    high = np.clip(np.ceil(np.nanmax(pixels, axis=0)) + 8, low + 1, size).astype(int)
    crop = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    grey = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY).astype(np.float32)
    cell_px = CELL_MM * camera.intrinsics.fx / float(distance.mean())
    if cell_px > 1.0:
        grey = cv2.GaussianBlur(grey, (0, 0), 0.4 * cell_px)
    x, y = (pixels - low).astype(np.float32).T.reshape(2, *shape)
    values = cv2.remap(grey, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR)
    seen = (inside & (cosine > MIN_COSINE) & (pixels >= low).all(axis=1) & (pixels <= high - 1).all(axis=1)).reshape(
        shape
    )
    counts = seen.astype(np.float32)
    light = cv2.GaussianBlur(np.where(seen, values, 0.0).astype(np.float32), (0, 0), BLUR_MM / CELL_MM)
    light /= np.maximum(cv2.GaussianBlur(counts, (0, 0), BLUR_MM / CELL_MM), 1e-3)
    return np.where(seen, values - light, 0.0).astype(np.float32), counts


def _shifts(
    drawings: Mapping[str, tuple[Float32[np.ndarray, "r c"], Float32[np.ndarray, "r c"]]], part: str
) -> list[_Shift]:
    """Returns the best shift of a part between each two drawings that share enough of it."""
    rows, columns = _part(part)
    reach = round(REACH_MM / CELL_MM)
    found = []
    wider = slice(rows.start, rows.stop + 2 * reach), slice(columns.start, columns.stop + 2 * reach)
    for first, second in combinations(drawings, 2):
        template, counts = (values[rows, columns] for values in drawings[first])
        target, seen = (np.pad(values, reach)[wider] for values in drawings[second])
        likeness = _correlation(template, counts, target, seen)
        best = np.unravel_index(int(likeness.argmax()), likeness.shape)
        if likeness[best] > -1.0:
            row, column = (_peak(likeness, best, axis) - reach for axis in (0, 1))
            found.append(_Shift(first, second, CELL_MM * np.array([column, -row]), float(likeness[best])))
    return found


def _correlation(
    template: Float32[np.ndarray, "h w"],
    counts: Float32[np.ndarray, "h w"],
    target: Float32[np.ndarray, "H W"],
    seen: Float32[np.ndarray, "H W"],
) -> Float32[np.ndarray, "r c"]:
    """Returns the normalised cross-correlation over the cells that both see, for each shift; -1 where these are few."""

    def sums(image: Float32[np.ndarray, "H W"], kernel: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "r c"]:
        return cv2.matchTemplate(image, kernel, cv2.TM_CCORR).astype(np.float32)

    ours, theirs = template * counts, target * seen
    count = np.maximum(sums(seen, counts), 1.0)
    a, b = sums(seen, ours), sums(theirs, counts)
    spread = (sums(seen, ours * template) - a**2 / count) * (sums(theirs * target, counts) - b**2 / count)
    likeness = (sums(theirs, ours) - a * b / count) / np.sqrt(np.maximum(spread, 1e-6))
    return np.where(count > MIN_SHARE * template.size, likeness, np.float32(-1.0))


def _peak(values: Float32[np.ndarray, "r c"], best: tuple[np.intp, ...], axis: int) -> float:
    """Returns where a parabola through the best value and its two neighbours along an axis has its vertex."""
    line, at = values.take(int(best[1 - axis]), axis=1 - axis), int(best[axis])
    if not 0 < at < len(line) - 1 or min(line[at - 1], line[at + 1]) <= -1.0:
        return float(at)
    before, middle, after = (float(value) for value in line[at - 1 : at + 2])
    bend = before - 2.0 * middle + after
    return at + 0.5 * (before - after) / bend if bend < 0.0 else float(at)


def _slope(face: MatchedFaces, camera: Camera) -> Float[np.ndarray, " 2"]:
    """Returns how far a drawing shifts (mm) for each mm that the face is too far in front."""
    x, y, z = direction_from_face(face.world_from_face, camera)
    return -np.array([x, y]) / max(z, MIN_COSINE / 2)


def _sizes(names: Sequence[str], by_part: Sequence[Mapping[str, Float[np.ndarray, " 2"]]]) -> dict[str, float]:
    """Returns by how much (mm) the drawings of each view are off those of the others, for views of which two parts or
    more can be compared."""
    sizes = {}
    for name in names:
        of_view = np.array([offsets[name] for offsets in by_part if name in offsets])
        if len(of_view) > 2:
            sizes[name] = float(np.linalg.norm(np.median(of_view, axis=0)))
        elif len(of_view) == 2:
            sizes[name] = float(np.linalg.norm(of_view, axis=1).min())
    return sizes


def _odd_mouths(
    names: Sequence[str],
    by_part: Mapping[str, Mapping[str, Float[np.ndarray, " 2"]]],
    likeness: Mapping[str, float],
) -> list[OddView]:
    """Returns the views whose mouth is like that of no other view and lies elsewhere than their eyes say."""
    eyes, mouth = by_part["eyes"], by_part["mouth"]
    offsets = {
        name: float(np.linalg.norm(mouth[name] - eyes[name])) for name in names if name in eyes and name in mouth
    }
    return [
        OddView(name, "mouth", offset)
        for name, offset in offsets.items()
        if likeness[name] < MAX_MOUTH_LIKENESS and offset > MIN_MOUTH_OFFSET_MM
    ]


def _part_offsets(
    names: Sequence[str], shifts: Sequence[_Shift], slopes: Mapping[str, Float[np.ndarray, " 2"]]
) -> dict[str, Float[np.ndarray, " 2"]]:
    """Returns the offset (mm) of each view's drawing of one part: the median over the other views of what the part's
    depth does not explain; of two others the nearer."""
    counted = [s for s in shifts if s.likeness > MIN_LIKENESS and s.first in names and s.second in names]
    if not counted:
        return {}
    slope = np.array([slopes[s.first] - slopes[s.second] for s in counted])
    shift, weights = np.array([s.shift_mm for s in counted]), np.ones((len(counted), 1))
    rest = shift
    for _ in range(20):
        depth_mm = (weights * slope * shift).sum() / ((weights * slope**2).sum() + DEPTH_PRIOR)
        rest = shift - depth_mm * slope
        weights = 1.0 / np.maximum(np.linalg.norm(rest, axis=1), 0.5)[:, None]
    offsets = {}
    for name in names:
        misses = [
            r if s.first == name else -r for s, r in zip(counted, rest, strict=True) if name in (s.first, s.second)
        ]
        nearest = min(misses, key=lambda r: float(np.linalg.norm(r)), default=None)
        if nearest is not None:
            offsets[name] = np.median(misses, axis=0) if len(misses) > 2 else nearest
    return offsets


def _likeness(names: Sequence[str], shifts: Sequence[_Shift]) -> dict[str, float]:
    """Returns the largest correlation of each view's part with that of another view."""
    best: dict[str, float] = {}
    for s in shifts:
        if s.first in names and s.second in names:
            for name in (s.first, s.second):
                best[name] = max(best.get(name, -1.0), s.likeness)
    return best
