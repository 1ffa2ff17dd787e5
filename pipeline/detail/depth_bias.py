"""Measures the depth bias that matching windows cause (``pipeline.stereo.depth_map``) on the fitted face of each
capture. The fitted face is a good reference, since it was fitted with patches that follow the surface.

On captures from two renderers the measured surface was 0.0 to 0.15 mm too deep, and the slope ``share`` was 0.7 to 1.5.
The fitted face and the true face gave the same slope to 0.1.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.compute.trace import traced
from pipeline.detail.association import Target, interpolated
from pipeline.detail.dense_points import SurfacePoints
from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.robust import Cauchy
from pipeline.estimation.terms import Linear, Problem
from pipeline.part_labels.codes import Part
from pipeline.stereo.depth_map import WindowBias, windowed_height
from rig.mesh import Mesh

REACH_MM, AGREEMENT, MIN_POINTS = 2.0, 0.8, 300
ROBUST_MM, ROUNDS = 0.15, 10
MAX_MM, MAX_SHARE = 0.3, 2.0  # of the common offset, and of the share: beyond, something else is wrong


@dataclass(frozen=True, slots=True, eq=False)
class OnFace:
    """Holds points of skin with their closest points on the fitted face, their offsets from the face (mm, along
    ``normal``), and the face's ``windowed_height`` at the closest points."""

    row: Int[np.ndarray, " n"]  # of the points
    normal: Float[np.ndarray, "n 3"]
    off_mm: Float[np.ndarray, " n"]
    windowed_mm: Float[np.ndarray, " n"]


@traced
def points_on_face(surface: SurfacePoints, head_world: Mesh, face: Bool[np.ndarray, " v"]) -> OnFace:
    """Returns the points of skin whose closest triangle on the head (world frame, mm) has all corners in ``face``."""
    vertices, faces, normals = head_world.vertices, head_world.faces, head_world.normals()
    skin = np.flatnonzero(surface.part == Part.SKIN)
    if not len(skin):
        return OnFace(skin, np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    points, facing = surface.points[skin], surface.normals[skin]
    target = Target.of(vertices, normals, faces)
    found = target.closest(points, facing, reach_mm=REACH_MM, least_agreement=AGREEMENT)
    on_face = face[faces[found.triangle]].all(axis=1)
    row, corner, blend = skin[found.row[on_face]], faces[found.triangle[on_face]], found.blend[on_face]
    normal = interpolated(normals[corner], blend)
    off_mm = ((surface.points[row] - interpolated(vertices[corner], blend)) * normal).sum(axis=1)
    return OnFace(row, normal, off_mm, (windowed_height(vertices, normals, face)[corner] * blend).sum(axis=1))


def measure_bias(seen: OnFace) -> WindowBias:
    """Measures the bias of the matching windows by a robust straight line through the points' offsets from the fitted
    face over its windowed height. The intercept is the common bias (mm), the slope is ``share``. Returns zero bias for
    fewer than ``MIN_POINTS`` points."""
    if len(seen.row) < MIN_POINTS:
        return WindowBias()
    columns = np.stack([np.ones(len(seen.row)), seen.windowed_mm], axis=1)
    problem = Problem((Linear(columns, seen.off_mm, Cauchy(ROBUST_MM)),), 2, np.add)
    limits = Limits(steps=ROUNDS, tolerance=1e-9, first_damping=0.0)
    line = minimise(problem, np.array([np.median(seen.off_mm), 0.0]), limits).value
    return WindowBias(float(np.clip(line[0], -MAX_MM, MAX_MM)), float(np.clip(line[1], 0.0, MAX_SHARE)))


def remove_window_bias(surface: SurfacePoints, seen: OnFace, bias: WindowBias) -> SurfacePoints:
    """Returns the points with the bias of the matching windows removed. Every point moves along its normal by the
    common bias. Points on the face also move by ``share`` times the windowed height."""
    points = surface.points - bias.common_mm * surface.normals
    points[seen.row] = (
        surface.points[seen.row] - (bias.common_mm + bias.share * seen.windowed_mm)[:, None] * seen.normal
    )
    return replace(surface, points=points)
