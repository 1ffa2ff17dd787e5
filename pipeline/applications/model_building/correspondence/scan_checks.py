"""Checks raw scans for problems: units, left and right, orientation of faces, landmarks off the surface, holes.

A problem with one obvious remedy (units, a mirrored file, exchanged landmark names, inverted faces) is repaired and
reported. Every other problem of a scan is reported as a fault. Landmarks are compared with the default model's."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from pipeline.applications.model_building.correspondence.correspondence import CylinderIndex
from pipeline.applications.model_building.correspondence.scans import Scan
from pipeline.head_model.landmarks import NAMES, PAIRED, mirrored, stacked
from pipeline.head_model.model import HeadModel
from rig.errors import InputError
from rig.geometry import rigid_fit

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
SIZE_RANGE = (0.7, 1.4)  # of the mean head: wider than any adult, narrower than the steps between units
MISPLACED_MM = 35.0  # from the landmark of the mean head: twice the largest distance in the database
OFF_SURFACE_MM = 15.0  # an ear's landmark may lie at the edge of a hole
FACE_HOLE_MM = 25.0
HEAD_HOLE_MM = 90.0
_CELL_MM = 4.0
_ROUND = 140  # 4 mm at 90 mm from the axis
_OUTWARD_SHARE = 0.7  # of the area: folds of ear and nostril look inwards even on a sound scan


class BadScan(InputError):
    """Reports a scan that has faults. ``faults`` lists all faults of the scan."""

    def __init__(self, name: str, faults: Iterable[str]) -> None:
        super().__init__(f"scan {name}", faults)


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """Holds a scan that passed all checks, and the repairs made to it."""

    scan: Scan
    repairs: tuple[str, ...]


def check(scan: Scan, template: HeadModel) -> Checked:
    """Returns the scan in millimetres, with left and right and faces repaired. Raises BadScan with all faults."""
    _check_complete(scan)
    scan, repairs = _in_millimetres(scan, template)
    scan, side_repairs = _sides_and_windings(scan, template)
    faults = [*_landmark_faults(scan, template), *_surface_faults(scan)]
    if not faults:
        faults = _hole_faults(scan, template)
    if faults:
        raise BadScan(scan.name, faults)
    return Checked(scan, tuple(repairs + side_repairs))


def _check_complete(scan: Scan) -> None:
    faults = []
    missing = [name for name in NAMES if name not in scan.landmarks]
    if missing:
        faults.append(f"lacks landmarks: {', '.join(missing)}")
    if len(scan.vertices) < 1000 or len(scan.faces) < 1000:
        faults.append(f"has {len(scan.vertices)} vertices and {len(scan.faces)} triangles; a head needs thousands")
    elif not np.isfinite(scan.vertices).all():
        faults.append("has vertices that are not finite")
    if faults:
        raise BadScan(scan.name, faults)


def _in_millimetres(scan: Scan, template: HeadModel) -> tuple[Scan, list[str]]:
    """Converts a scan to millimetres. The distances between landmarks decide the unit: heads differ in size by a third,
    units by a factor of 10."""
    ratio = _radius_of_gyration(stacked(scan.landmarks)) / _radius_of_gyration(_mean_marks(template))
    for unit, factor in UNITS.items():
        if SIZE_RANGE[0] < ratio * factor < SIZE_RANGE[1]:
            if unit == "mm":
                return scan, []
            marks = {name: point * factor for name, point in scan.landmarks.items()}
            return replace(scan, vertices=scan.vertices * factor, landmarks=marks), [f"converted from {unit} to mm"]
    size = f"its landmarks span {ratio:.3g} times what an adult's do in mm"
    raise BadScan(scan.name, [f"{size}, and neither mm, cm nor m makes that a head: scale it to mm"])


def _sides_and_windings(scan: Scan, template: HeadModel) -> tuple[Scan, list[str]]:
    """Repairs exchanged left and right (compared with the mean head) and inverted faces (compared with the direction
    from the axis). A scan that is both inside out and has right and left exchanged is a mirrored file."""
    marks, mean = stacked(scan.landmarks), _mean_marks(template)
    swapped = marks[[NAMES.index(mirrored(name)) for name in NAMES]]
    flipped = _misfit(swapped, mean) < 0.6 * _misfit(marks, mean)
    named = replace(scan, landmarks=dict(zip(NAMES, swapped, strict=True))) if flipped else scan
    inverted = outward_share(named, template) < 1 - _OUTWARD_SHARE
    if flipped and inverted:
        turn = np.array([-1.0, 1.0, 1.0])
        places = {name: point * turn for name, point in scan.landmarks.items()}
        return replace(scan, vertices=scan.vertices * turn, landmarks=places), ["mirrored back: its x axis was flipped"]
    repairs = ["swapped left and right landmarks, which named the other side"] if flipped else []
    if inverted:
        return replace(named, faces=named.faces[:, ::-1].copy()), [*repairs, "turned faces over, which faced inwards"]
    return named, repairs


def _landmark_faults(scan: Scan, template: HeadModel) -> list[str]:
    mean = _mean_marks(template)
    marks = stacked(scan.landmarks)
    placed = dict(zip(NAMES, rigid_fit(marks, mean).apply(marks), strict=True))
    swapped = [pair for pair in PAIRED if placed[f"{pair}_left"][0] <= placed[f"{pair}_right"][0]]
    faults = [f"{pair}_left and {pair}_right are swapped" for pair in swapped]
    for name, wanted in zip(NAMES, mean, strict=True):
        off = float(np.linalg.norm(placed[name] - wanted))
        if off > MISPLACED_MM and not name.startswith(tuple(swapped)):
            faults.append(f"{name} is {off:.0f} mm from where heads have it: mark it again")
    away = KDTree(scan.vertices).query(marks)[0]
    far = [f"{name} ({d:.0f} mm)" for name, d in zip(NAMES, away, strict=True) if d > OFF_SURFACE_MM]
    if far:
        faults.append(f"landmarks off the surface: {', '.join(far)}; are mesh and landmarks in one frame and unit?")
    return faults


def _surface_faults(scan: Scan) -> list[str]:
    """Returns a fault if neighbouring faces are oriented differently, so that both use their edge in one direction."""
    directed = np.concatenate([scan.faces[:, [0, 1]], scan.faces[:, [1, 2]], scan.faces[:, [2, 0]]]).astype(np.int64)
    keys = directed[:, 0] * len(scan.vertices) + directed[:, 1]
    doubled = len(keys) - len(np.unique(keys))
    if doubled > 0.002 * len(keys):
        return [f"{doubled} edges join triangles that face opposite ways: orient its faces alike"]
    return []


def _hole_faults(scan: Scan, template: HeadModel) -> list[str]:
    """Returns a fault for each hole below the crown that is too wide, seen from the axis. A hole's width is the
    diameter of a disc with the same area."""
    void, face = voids(scan, template)
    faults = []
    for where, mask, limit in (("face", void & face, FACE_HOLE_MM), ("head", void, HEAD_HOLE_MM)):
        size = _widest(mask)
        if size > limit:
            faults.append(f"a hole of about {size:.0f} mm in the {where} ({limit:.0f} mm is the most): scan it again")
    return faults


def voids(scan: Scan, template: HeadModel) -> tuple[Bool[np.ndarray, "H A"], Bool[np.ndarray, "H A"]]:
    """Returns a mask of the grid cells (4 mm wide, by height and angle, from the chin to above the brow) without
    scanned surface, and a mask of the cells that belong to the face."""
    marks, placed = stacked(scan.landmarks), _placed(scan, template)
    at = dict(zip(NAMES, rigid_fit(marks, _mean_marks(template)).apply(marks), strict=True))
    heights = np.arange(at["gnathion"][1] + 4, at["glabella"][1] + 35, _CELL_MM)
    angles = -np.pi + 2 * np.pi * (np.arange(_ROUND) + 0.5) / _ROUND
    columns, rows = np.meshgrid(angles, heights)
    radii = CylinderIndex(placed, scan.faces).cast(columns.ravel(), rows.ravel())
    face = (np.abs(columns) < np.radians(65)) & (rows < at["glabella"][1] + 15)
    return np.isnan(radii).reshape(rows.shape), face


def outward_share(scan: Scan, template: HeadModel) -> float:
    """Returns the fraction of the scan's area whose normals point away from the head's axis."""
    corners = _placed(scan, template)[scan.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = (doubled * (corners.mean(1) * [1, 0, 1])).sum(1) > 0
    area = np.linalg.norm(doubled, axis=1)
    return float(area[outward].sum() / area.sum())


def _widest(mask: Bool[np.ndarray, "H A"]) -> float:
    """Returns the diameter (mm) of a disc with the area of the mask's largest connected patch. The mask's first and
    last column are neighbours on the cylinder."""
    # Two copies side by side, so that the seam cuts no patch.
    twice = np.zeros((len(mask), 2 * mask.shape[1]), np.int32)
    ndimage.label(np.concatenate([mask, mask], 1), output=twice)
    cells = np.bincount(twice.ravel(), minlength=2)[1:]
    largest = min(float(cells.max()), float(mask.sum()))
    return 2 * np.sqrt(largest * _CELL_MM * (2 * np.pi * 90 / _ROUND) / np.pi)


def _placed(scan: Scan, template: HeadModel) -> Float[np.ndarray, "S 3"]:
    return rigid_fit(stacked(scan.landmarks), _mean_marks(template)).apply(scan.vertices)


def _mean_marks(template: HeadModel) -> Float[np.ndarray, "26 3"]:
    index: Int[np.ndarray, " L"] = np.array([template.landmarks[name] for name in NAMES])
    return template.levels["full"].operator[index] @ template.mean.astype(float)


def _misfit(marks: Float[np.ndarray, "26 3"], mean: Float[np.ndarray, "26 3"]) -> float:
    return float(np.linalg.norm(rigid_fit(marks, mean).apply(marks) - mean))


def _radius_of_gyration(marks: Float[np.ndarray, "26 3"]) -> float:
    return float(np.linalg.norm(marks - marks.mean(0)))
