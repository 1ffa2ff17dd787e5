"""Samples points on the visible true surface of a simulated subject: head, hair and clothes.

The sampled points are the reference for a reconstruction of the whole visible surface. Strands of hair are left out,
because they are thinner than a pixel and no reconstructed mesh contains them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from rig.camera import Camera
from rig.mesh import Mesh, face_normals
from rig.render.renderer import Renderer
from rig.rig import Rig

Points = Float[np.ndarray, "n 3"]

PARTS = ("head", "hair", "clothes")
AREA_MM2 = 2.25  # of surface for each point: 1.5 mm apart
VIEWS_LEAST = 2  # what one camera alone sees has no depth
LEAST_FACING = 0.1  # cosine: flatter than 84 degrees no camera tells where a surface is
HIDDEN_MM = 0.5  # a nearer surface hides a point beyond this: the depth map's own rounding, and facets


@dataclass(frozen=True, slots=True, eq=False)
class VisiblePoints:
    """Holds points (world frame, mm) of the true surface that two or more cameras see. ``part`` indexes ``PARTS``."""

    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]  # unit, outwards
    part: UInt8[np.ndarray, " n"]
    views: UInt8[np.ndarray, " n"]  # cameras that see the point

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the arrays of ``visible.npz``. ``area`` is the surface area (mm2) that each point represents."""
        counted = {"points": self.points, "normals": self.normals, "part": self.part, "views": self.views}
        return counted | {"area": np.asarray(AREA_MM2, np.float32)}


def visible_points(
    rig: Rig, surfaces: Mapping[str, Mesh], *, renderer: Renderer, rng: np.random.Generator
) -> VisiblePoints:
    """Draws random points evenly on surfaces (world frame, mm) by part. Returns the points that at least
    ``VIEWS_LEAST`` cameras see."""
    drawn = [sample_surface(mesh, AREA_MM2, rng) for mesh in surfaces.values()]
    points, normals = (np.concatenate(arrays) for arrays in zip(*drawn, strict=True))
    codes = np.array([PARTS.index(name) for name in surfaces], np.uint8)
    part = np.repeat(codes, [len(points) for points, _ in drawn])
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in surfaces.values()])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(surfaces.values(), offsets, strict=False)])
    depth = renderer.depth(rig, np.concatenate([mesh.vertices for mesh in surfaces.values()]), faces)
    views = np.zeros(len(points), np.uint8)
    for camera in rig:
        views += sees(camera, depth[camera.name], points, normals)
    visible = views >= VIEWS_LEAST
    return VisiblePoints(
        points[visible].astype(np.float32), normals[visible].astype(np.float32), part[visible], views[visible]
    )


def part_masks(
    rig: Rig, surfaces: Mapping[str, Mesh], masks: Mapping[str, Bool[np.ndarray, "_ _"]], *, renderer: Renderer
) -> dict[str, UInt8[np.ndarray, "_ _"]]:
    """Returns the part at every pixel by camera: 1 skin, 2 hair, 3 clothes, and 0 outside ``masks``.

    Pixels inside a mask that no surface covers are hair, because only strands can be there.
    """
    depth = {name: renderer.depth(rig, mesh.vertices, mesh.faces) for name, mesh in surfaces.items()}
    codes = np.array([1 + PARTS.index(name) for name in surfaces], np.uint8)
    parts = {}
    for camera in rig.names:
        stack = np.stack([depth[name][camera] for name in surfaces])
        nearest = codes[stack.argmin(axis=0)]
        nearest[~np.isfinite(stack).any(axis=0)] = 1 + PARTS.index("hair")
        parts[camera] = np.where(masks[camera], nearest, np.uint8(0))
    return parts


def sample_surface(mesh: Mesh, area_mm2: float, rng: np.random.Generator) -> tuple[Points, Points]:
    """Draws random points on a mesh, one for each ``area_mm2``. Returns the points and their triangles' unit
    normals."""
    normals = face_normals(mesh.vertices, mesh.faces)
    double = np.linalg.norm(normals, axis=1)
    ends = np.cumsum(double / 2)
    face = np.searchsorted(ends, rng.uniform(0, ends[-1], int(ends[-1] / area_mm2)))
    a, b = rng.uniform(0, 1, (2, len(face), 1))
    over = a + b > 1  # folds the parallelogram into its triangle
    a, b = np.where(over, 1 - a, a), np.where(over, 1 - b, b)
    corners = mesh.vertices[mesh.faces[face]]
    points = corners[:, 0] + a * (corners[:, 1] - corners[:, 0]) + b * (corners[:, 2] - corners[:, 0])
    return points, normals[face] / double[face, None]


def sees(camera: Camera, depth: Float[np.ndarray, "h w"], points: Points, normals: Points) -> np.ndarray:
    """Returns a mask of the surface points that a camera sees. ``depth`` is the surface's depth map in the camera (z,
    mm), inf where no surface is.

    The depth at the centre of the pixel nearest to a point is compared with the point's tangent plane.
    """
    k, pose = camera.intrinsics, camera.camera_from_world
    at = np.rint(np.nan_to_num(camera.project(points), nan=-9.0))
    framed = np.all((at >= 0) & (at < (k.width, k.height)), axis=1)
    column, row = np.where(framed[:, None], at, 0).astype(int).T
    towards = camera.centre_world - points
    facing = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    rays = np.zeros_like(points)
    rays[framed] = camera.rays_world(at[framed])
    z = pose.apply(points)[:, 2]
    slant = (normals * rays).sum(axis=1)
    along = -(normals * towards).sum(axis=1) / np.where(np.abs(slant) > 1e-6, slant, 1.0)
    point_depth = np.where(np.abs(slant) > 1e-6, along * (rays @ pose.rotation[2]), z)
    return framed & (facing > LEAST_FACING) & (point_depth < depth[row, column] + HIDDEN_MM)
