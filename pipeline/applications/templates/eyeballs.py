"""Adds eyeballs to a mesh that has none: a ball with a cornea behind the lids, and lids that close over the ball.

Sizes are an adult's: the ball's radius is 12 mm, the cornea's 7.8 mm, and they meet in a circle of radius 5.9 mm, the
limbus (after Gullstrand's schematic eye). The ball lies as far in front as the open lids allow; the module ``pivots``
gives its sideways position. A blendshape moves a lid along a straight line, which cuts through the ball; the
displacement is therefore lifted so that the lid clears the ball at half and full weight."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.applications.templates.pivots import EYE_RADIUS_MM, Points
from rig.geometry import rotation_from_vector
from rig.mesh import Mesh, boundary_edges

Places = Float[np.ndarray, "t 3"]

CORNEA_MM, LIMBUS_MM, PUPIL_MM = 7.8, 5.9, 2.0
GAP_MM = 0.15  # between lids and ball: what a flat triangle of 4 mm lies below a ball
REACH_MM = 20.0  # of the lids about the ball's centre
BACK_MM, STEP_MM = 8.0, 0.05  # how far a ball is moved back from its pivot until lids are free
WEIGHTS = (0.5, 1.0)
ROUNDS = 30
RINGS, SECTORS = 40, 48
OPEN_SHARE = 0.4  # of the eye's length, within which lids of an open eye have a border about its middle
AHEAD = np.array([0.0, 0.0, 1.0])
STRAIGHT: Mapping[str, Float[np.ndarray, " 3"]] = {}
WHITE, IRIS, PUPIL = (225, 220, 214), (96, 72, 52), (12, 12, 12)  # sRGB; not measured in photographs


@dataclass(frozen=True, slots=True, eq=False)
class Eyeball:
    """Holds an eyeball in the head frame, mm. ``gaze`` is the unit vector of the viewing direction."""

    centre: Float[np.ndarray, " 3"]
    gaze: Float[np.ndarray, " 3"]
    radius_mm: float = EYE_RADIUS_MM

    def reach(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns the distance (mm) from the eyeball's centre to its surface in each direction (unit vectors); within
        the limbus this surface is the cornea."""
        cosine = directions @ self.gaze
        cornea = float(np.sqrt(self.radius_mm**2 - LIMBUS_MM**2) - np.sqrt(CORNEA_MM**2 - LIMBUS_MM**2))
        inside = np.maximum(CORNEA_MM**2 - cornea**2 * (1.0 - cosine**2), 0.0)
        bulge = cornea * cosine + np.sqrt(inside)
        return np.where(cosine > _limbus_cosine(self.radius_mm), bulge, self.radius_mm)

    def mesh(self) -> Mesh:
        """Returns the eyeball's mesh as rings around the gaze, with vertex colours of white, iris and pupil."""
        limbus, pupil = np.arccos(_limbus_cosine(self.radius_mm)), np.arcsin(PUPIL_MM / self.radius_mm)
        marks = np.unique(np.concatenate([np.linspace(0.0, np.pi, RINGS), [pupil, limbus]]))[1:-1]
        around = np.arange(SECTORS) * 2.0 * np.pi / SECTORS
        across = np.cross(self.gaze, (0.0, 1.0, 0.0))
        across /= np.linalg.norm(across)
        ring = np.outer(np.cos(around), across) + np.outer(np.sin(around), np.cross(across, self.gaze))
        rings = np.cos(marks)[:, None, None] * self.gaze + np.sin(marks)[:, None, None] * ring
        directions = np.concatenate([self.gaze[None], rings.reshape(-1, 3), -self.gaze[None]])
        vertices = self.centre + self.reach(directions)[:, None] * directions
        angles = np.concatenate([[0.0], np.repeat(marks, SECTORS), [np.pi]])
        return Mesh(vertices, _outward(vertices, _ring_faces(len(marks)), self.centre), _colours(angles, pupil, limbus))


def _limbus_cosine(radius_mm: float) -> float:
    return float(np.sqrt(1.0 - (LIMBUS_MM / radius_mm) ** 2))


def _ring_faces(count: int) -> Int[np.ndarray, "f 3"]:
    """Returns the triangles between one pole of a sphere, ``count`` rings of vertices, and the other pole."""
    ring = np.arange(SECTORS)
    beside = (ring + 1) % SECTORS
    last = 1 + (count - 1) * SECTORS
    caps = [
        np.stack([np.zeros_like(ring), 1 + ring, 1 + beside], axis=1),
        np.stack([np.full_like(ring, last + SECTORS), last + beside, last + ring], axis=1),
    ]
    bands = []
    for k in range(count - 1):
        here, there = 1 + k * SECTORS, 1 + (k + 1) * SECTORS
        bands += [
            np.stack([here + ring, there + ring, there + beside], axis=1),
            np.stack([here + ring, there + beside, here + beside], axis=1),
        ]
    return np.concatenate([*caps, *bands]).astype(np.int32)


def _outward(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], centre: Float[np.ndarray, " 3"]
) -> Int[np.ndarray, "f 3"]:
    """Returns the triangles reordered so that their normals point out of the ball."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("fx,fx->f", np.cross(b - a, c - a), a - centre) < 0.0
    return np.where(inward[:, None], faces[:, ::-1], faces)


def _colours(angles: Float[np.ndarray, " n"], pupil: float, limbus: float) -> UInt8[np.ndarray, "n 3"]:
    out = np.full((len(angles), 3), WHITE, np.uint8)
    out[angles < limbus - 1e-9] = IRIS
    out[angles <= pupil + 1e-9] = PUPIL
    return out


def turn_to(gaze: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation of an eye from straight ahead to ``gaze`` (unit vector, head frame), without roll about the
    line of sight (Listing's law)."""
    axis = np.cross(AHEAD, gaze)
    sine = float(np.linalg.norm(axis))
    return rotation_from_vector(axis * (np.arctan2(sine, gaze @ AHEAD) / sine if sine > 0.0 else 1.0))


def place_eyeballs(
    mesh: Places,
    triangles: Int[np.ndarray, "g 3"],
    landmarks: Points,
    centres: Mapping[str, Float[np.ndarray, " 3"]],
    gazes: Mapping[str, Float[np.ndarray, " 3"]] = STRAIGHT,
) -> dict[str, Eyeball]:
    """Returns eyeballs behind the open eyes of a mesh without expression, by pivot; closed eyes get none.

    Args:
        mesh: vertices, head frame, mm.
        triangles: triangles of the mesh.
        landmarks: landmarks of the head.
        centres: the pivots ``eye_right`` and ``eye_left``, or one of them.
        gazes: their viewing directions (unit vectors, head frame); missing ones are straight ahead.
    """
    out = {}
    for name in centres:
        if not _is_open(mesh, triangles, landmarks, name.removeprefix("eye_")):
            continue
        points = sample_triangles(mesh, triangles[_near(mesh, triangles, centres[name])])
        gaze, back = gazes.get(name, AHEAD), 0.0
        while back < BACK_MM and _depths(Eyeball(centres[name] - back * AHEAD, gaze), points).max(initial=0.0) > 0.0:
            back += STEP_MM
        out[name] = Eyeball(centres[name] - back * AHEAD, gaze)
    return out


def _is_open(mesh: Places, triangles: Int[np.ndarray, "g 3"], landmarks: Points, side: str) -> bool:
    """Returns whether the mesh has a hole near the middle of an eye, as around an open eye."""
    outer, inner = landmarks[f"exocanthion_{side}"], landmarks[f"endocanthion_{side}"]
    border = mesh[np.unique(boundary_edges(triangles))]
    away = np.linalg.norm(border - 0.5 * (outer + inner), axis=1)
    return bool(away.min(initial=np.inf) < OPEN_SHARE * np.linalg.norm(outer - inner))


def _near(mesh: Places, triangles: Int[np.ndarray, "g 3"], centre: Float[np.ndarray, " 3"]) -> Bool[np.ndarray, " g"]:
    """Returns a mask of the triangles that lie around an eye and in front of its centre."""
    near = (np.linalg.norm(mesh - centre, axis=1) < REACH_MM) & (mesh[:, 2] > centre[2] - BACK_MM)
    return near[triangles].all(axis=1)


def sample_triangles(mesh: Places, triangles: Int[np.ndarray, "g 3"]) -> Float[np.ndarray, "g 7 3"]:
    """Returns seven points of each triangle: its corners, the midpoints of its edges, and its centroid."""
    corners = mesh[triangles]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    return np.concatenate([corners, middles, corners.mean(axis=1, keepdims=True)], axis=1)


def _depths(eyeball: Eyeball, points: Float[np.ndarray, "g 7 3"]) -> Float[np.ndarray, " g"]:
    """Returns how deep (mm) each triangle lies in an eyeball or the required gap around it; 0 for triangles outside."""
    away = points - eyeball.centre
    distance = np.linalg.norm(away, axis=2)
    reach = eyeball.reach((away / np.maximum(distance, 1e-9)[:, :, None]).reshape(-1, 3)).reshape(distance.shape)
    return np.maximum((reach + GAP_MM - distance).max(axis=1), 0.0)


def lift_lids(
    mesh: Places, triangles: Int[np.ndarray, "g 3"], displacement: Places, eyeballs: Mapping[str, Eyeball]
) -> Places:
    """Returns a blendshape's displacement (mm) with lids lifted off the eyeballs at ``WEIGHTS``, else unchanged."""
    out = displacement
    for eyeball in eyeballs.values():
        about = triangles[_near(mesh, triangles, eyeball.centre)]
        if not np.abs(displacement[about]).max(initial=0.0):
            continue
        for _ in range(ROUNDS):
            push = np.zeros(len(mesh))
            for weight in WEIGHTS:
                depths = _depths(eyeball, sample_triangles(mesh + weight * out, about))
                np.maximum.at(push, about, (depths / weight)[:, None])
            rows = np.flatnonzero(push)
            if not len(rows):
                break
            away = mesh[rows] + 0.5 * out[rows] - eyeball.centre
            out = out.copy()
            out[rows] += push[rows, None] * away / np.linalg.norm(away, axis=1, keepdims=True)
    return out
