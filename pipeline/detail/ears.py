"""Moves each ear of the head by a similarity transform, before the head is deformed.

An ear may be a centimetre away from its predicted position, and has many folds, so closest points may lie on the wrong
fold. Therefore each ear first moves by a similarity, found by iterated closest points along the normals (Chen and
Medioni 1992). The search has several starts, and the result with the best fit to the surface points is kept. The skin
around the ear follows smoothly.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.detail.association import Target, interpolated
from pipeline.detail.dense_points import SurfacePoints
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.registration.rigid import motion_columns, solve_with_prior
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from pipeline.part_labels.codes import Part
from rig.geometry import rotation_from_vector
from rig.mesh import vertex_normals

Vector = Float[np.ndarray, " 3"]
Vertices = Float[np.ndarray, "v 3"]

ABOUT_MM = 25.0  # points that far from the ear may be its own
BLEND_MM = 10.0  # over which the head follows
STARTS_MM = (0.0, -9.0, 9.0)  # up and down the head, and to and fro
REACHES_MM = (14.0, 10.0, 7.0, 5.0, 4.0, 3.0, 3.0, 3.0)
ROBUST_SHARE = 0.4  # of the reach
MIN_POINTS, MIN_SHOWN = 80, 80  # about the ear, and on it
TURN_SD, SCALE_SD, SHIFT_SD_MM = 0.2, 0.08, 8.0  # of the motion, against points worth ...
POINT_SD_MM = 3.0  # ... that each: they are many, and the shape is another's
PRIOR = np.array([TURN_SD**-2] * 3 + [SHIFT_SD_MM**-2] * 3 + [SCALE_SD**-2])
AGREEMENT = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Holds a similarity about the middle of an ear, its robust cost per point, and the number of points (``shown``)
    whose closest point lies on the moved ear."""

    cost: float
    scale: float
    turn: Float[np.ndarray, "3 3"]
    shift: Vector  # mm
    shown: int


def move_ears(vertices: Vertices, model: HeadModel, surface: SurfacePoints) -> Vertices:
    """Returns the head with each ear moved to the skin points near it. An ear with too few measurements does not move.

    Args:
        vertices: full mesh, world frame, mm.
        model: the head model.
        surface: the surface points, thinned to a spacing of 1.5 to 3 mm.
    """
    faces, ears = model.levels["full"].faces, head_regions(model)["ears"]
    middle = model.vertices(np.zeros(0))[:, 0] < 0
    skin = surface.chosen(surface.part == Part.SKIN)
    moved = np.zeros_like(vertices)
    for side in (ears & middle, ears & ~middle):
        rows = np.flatnonzero(side)
        if not len(rows) or not len(skin.points):
            continue
        distance, _ = nearest(PointTree.of(vertices[rows]), skin.points, within=ABOUT_MM)
        near = skin.chosen(np.isfinite(distance))
        if len(near.points) < MIN_POINTS:
            continue
        turned = _registered(vertices, faces, side, near, model)
        off, _ = nearest(PointTree.of(vertices[rows]), vertices, within=4.0 * BLEND_MM)
        share = np.exp(-0.5 * (np.where(np.isfinite(off), off, 1e3) / BLEND_MM) ** 2)
        moved += share[:, None] * (turned - vertices)
    return vertices + moved


def _registered(
    vertices: Vertices,
    faces: Int[np.ndarray, "f 3"],
    ear: Bool[np.ndarray, " v"],
    points: SurfacePoints,
    model: HeadModel,
) -> Vertices:
    """Returns all vertices after the similarity that best fits the ear to the points around it. The vertices are
    unchanged if fewer than ``MIN_SHOWN`` points lie on the ear itself, as under hair, where the cheek would pull the
    ear."""
    centre = vertices[ear].mean(axis=0)
    local = np.flatnonzero(np.linalg.norm(vertices - centre, axis=1) < np.linalg.norm(
        vertices[ear] - centre, axis=1).max() + BLEND_MM)  # fmt: skip
    place = np.full(len(vertices), -1)
    place[local] = np.arange(len(local))
    part = place[faces[(place[faces] >= 0).all(axis=1)]]
    local_vertices = vertices[local] - centre
    target = Target.of(local_vertices, vertex_normals(local_vertices, part), part)
    up, ahead = _axes(vertices, model)
    found = []
    for rise in STARTS_MM:
        for forth in STARTS_MM:
            shift = rise * up + forth * ahead
            if abs(rise) + abs(forth) <= max(STARTS_MM):  # up, down, to or fro
                found.append(_descend(target, ear[local], points, centre, shift))
    best = min(found, key=lambda each: each.cost)
    if best.shown < MIN_SHOWN:
        return vertices
    return best.scale * (vertices - centre) @ best.turn.T + centre + best.shift


def _axes(vertices: Vertices, model: HeadModel) -> tuple[Vector, Vector]:
    """Returns the head's upward and forward unit vectors in the world frame."""
    at = {name: vertices[row] for name, row in model.landmarks.items()}
    up = at["nasion"] - at["gnathion"]
    ahead = at["nasion"] - 0.5 * (at["tragion_left"] + at["tragion_right"])
    up = up / np.linalg.norm(up)
    ahead = ahead - (ahead @ up) * up
    return up, ahead / np.linalg.norm(ahead)


def _descend(
    target: Target, ear: Bool[np.ndarray, " v"], points: SurfacePoints, centre: Vector, shift: Vector
) -> Motion:
    """Computes the similarity about ``centre`` to which iterated closest points converge from one starting ``shift``
    (mm). ``target`` is the ear with the skin around it, relative to ``centre``.

    The points are mapped back to the original ear, so that the search tree is built only once.
    """
    scale, turn, cost, shown = 1.0, np.eye(3), np.inf, 0
    for reach in REACHES_MM:
        back = (points.points - centre - shift) @ turn / scale
        found = target.closest(back, points.normals @ turn, reach_mm=reach / scale, least_agreement=AGREEMENT)
        distance_mm = scale * found.distance_mm
        corner = target.head.faces[found.triangle]
        arm = scale * interpolated(target.head.vertices[corner], found.blend) @ turn.T
        ahead = points.normals[found.row]
        off = ((points.points[found.row] - centre - shift - arm) * ahead).sum(axis=1)
        robust = ROBUST_SHARE * reach
        weight = 1.0 / (1.0 + (distance_mm / robust) ** 2) ** 2
        shown = int(np.count_nonzero(ear[corner].all(axis=1)))
        missing = len(points.points) - len(found.row)
        square = distance_mm**2 / (distance_mm**2 + robust**2)
        cost = float((square.sum() + missing) / len(points.points))
        state = np.concatenate([np.zeros(3), shift, [np.log(scale)]])
        step = solve_with_prior(motion_columns(arm, ahead, scale=True), off, weight / POINT_SD_MM**2, PRIOR, state)
        turn = rotation_from_vector(step[:3]) @ turn
        shift, scale = shift + step[3:6], scale * float(np.exp(step[6]))
    return Motion(cost, scale, turn, shift, shown)
