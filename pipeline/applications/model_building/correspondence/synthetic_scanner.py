"""Simulates a cylindrical scanner: turns a head into a raw scan such as section 3.2 receives.

The scanner looks at the axis from outside. It takes one sample per (angle, height), of the outermost surface, with
radial noise, and none where hair or the folds of the ear absorb the light stripe. Each scan has its own grid, so
numbers of vertices differ."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.applications.model_building.correspondence.cylinder import CylinderIndex, points_at
from pipeline.applications.model_building.correspondence.scans import Scan
from rig.geometry import rotation_from_vector

_JUMP_MM = 8.0  # neighbouring samples farther apart lie on two surfaces ...
_STEEPEST = 4.0  # ... unless the grid is coarse: 4 mm apart, the side of a nose would come out as a hole


@dataclass(frozen=True, slots=True, kw_only=True)
class Scanner:
    """Holds the properties of a scanner and its subjects. Lengths in mm."""

    spacing_mm: float = 1.0
    noise_mm: float = 0.1
    landmark_noise_mm: float = 0.5
    holes: int = 3  # in the hair
    hole_mm: float = 12.0  # largest radius of one
    ear_holes: bool = True
    turn_rad: float = 0.05  # standard deviation: the subject does not sit exactly straight
    shift_mm: float = 5.0


def scan_head(
    name: str,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    landmarks: Mapping[str, int],
    scanner: Scanner,
    rng: np.random.Generator,
) -> Scan:
    """Returns a raw scan of a head (head frame, mm) in the scanner's frame: rotated and shifted slightly."""
    angles, heights = _grid(vertices, scanner, rng)
    columns, rows = np.meshgrid(angles, heights)
    cast = CylinderIndex(vertices, faces).cast(columns.ravel(), rows.ravel())
    radii = cast.radii + scanner.noise_mm * rng.standard_normal(len(cast.radii))
    points = points_at(columns.ravel(), rows.ravel(), radii)
    marks = {n: vertices[v] + scanner.landmark_noise_mm * rng.standard_normal(3) for n, v in landmarks.items()}
    valid = np.isfinite(radii) & ~_swallowed(points, {n: vertices[v] for n, v in landmarks.items()}, scanner, rng)
    mesh = _grid_faces(valid.reshape(rows.shape), points, max(_JUMP_MM, _STEEPEST * scanner.spacing_mm))
    used, local = np.unique(mesh, return_inverse=True)
    turn = rotation_from_vector(scanner.turn_rad * rng.standard_normal(3))
    shift = scanner.shift_mm * rng.standard_normal(3)
    place = points[used] @ turn.T + shift
    return Scan(name, place, local.reshape(-1, 3).astype(np.int32), {n: p @ turn.T + shift for n, p in marks.items()})


def _grid(
    vertices: Float[np.ndarray, "V 3"], scanner: Scanner, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " A"], Float[np.ndarray, " H"]]:
    """Returns angles and heights of the samples, about ``spacing_mm`` apart on a head of 90 mm radius, different for
    each scan."""
    spacing_mm = scanner.spacing_mm * rng.uniform(0.95, 1.05)
    count = round(2 * np.pi * 90 / spacing_mm)
    angles = -np.pi + 2 * np.pi * (np.arange(count) + rng.uniform()) / count
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    return angles, np.arange(low + spacing_mm * rng.uniform(), high, spacing_mm)


def _swallowed(
    points: Float[np.ndarray, "N 3"],
    marks: Mapping[str, Float[np.ndarray, " 3"]],
    scanner: Scanner,
    rng: np.random.Generator,
) -> Bool[np.ndarray, " N"]:
    """Returns which samples hair or the ears absorb."""
    lost = np.zeros(len(points), bool)
    hair_line = marks["glabella"][1] + 45.0
    hairy = np.flatnonzero((points[:, 1] > hair_line) | ((points[:, 2] < -20) & (points[:, 1] > 0)))
    for centre in points[rng.choice(hairy, scanner.holes)] if len(hairy) else ():
        lost |= np.linalg.norm(points - centre, axis=1) < rng.uniform(0.3, 1.0) * scanner.hole_mm
    if scanner.ear_holes:
        for side in ("left", "right"):
            behind = marks[f"tragion_{side}"] + [0.0, 0.0, -18.0]
            lost |= np.linalg.norm(points - behind, axis=1) < rng.uniform(8.0, 14.0)
    return lost


def _grid_faces(
    valid: Bool[np.ndarray, "H A"], points: Float[np.ndarray, "N 3"], jump_mm: float
) -> Int[np.ndarray, "F 3"]:
    """Returns triangles between neighbouring samples, across the seam too; none has a side of ``jump_mm`` or more."""
    rows, columns = valid.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    here, right = index[:-1], np.roll(index, -1, 1)[:-1]
    up, across = index[1:], np.roll(index, -1, 1)[1:]
    faces = np.concatenate([np.stack([here, right, across], -1), np.stack([here, across, up], -1)]).reshape(-1, 3)
    faces = faces[valid.ravel()[faces].all(1)]
    corners = points[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1)
    return faces[longest < jump_mm]
