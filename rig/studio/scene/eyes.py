"""Creates a simulated subject's eyeballs, directed by a gaze, with white, limbus, iris, pupil and a reflecting cornea.

An adult's eyeball has a radius of 12 mm. An eye's cornea has a radius of 7.8 mm, and meets the eyeball at the limbus of
radius 5.85 mm (visible iris diameter 11.7 mm; Ruefer et al. 2005). At the limbus, an eye's colour changes gradually
over some tenths of a millimetre. If a head's mesh closes the eyes with skin, the skin is cut open between the lids.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from trimesh.remesh import subdivide

from rig.geometry import Similarity
from rig.mesh import Mesh, boundary_edges
from rig.studio.scene.anatomy import Landmarks, grid_faces, turned_along
from rig.studio.scene.skin_texture import eye_gap

Vector = Float[np.ndarray, " 3"]

Colour = tuple[float, float, float]
IRIS_TONES: tuple[Colour, ...] = (
    (0.055, 0.030, 0.016),
    (0.10, 0.055, 0.025),
    (0.13, 0.11, 0.045),
    (0.12, 0.17, 0.22),
    (0.15, 0.18, 0.12),
)
WHITE, PUPIL = (0.52, 0.48, 0.45), (0.006, 0.006, 0.006)  # linear albedo
RIM = 0.45  # of the iris' edge, by its tone
RADIUS_MM, CORNEA_MM, LIMBUS_MM, PUPIL_MM = 12.0, 7.8, 5.85, 1.9
LIMBUS_WIDTH_MM = 0.7
SECTORS = 96
GLOSS_EYE, GLOSS_WHITE = 1.0, 0.3  # strength of highlights
PATCH_MM, EDGE_MM = 19.0, 0.5  # of skin about an eye, and its triangles
GAP_MM, STEP_MM, BACK_MM = 0.1, 0.05, 12.0
MARGIN_MM = 7.0  # how far lids of a cut go back
FRONT_MM = np.array([0.0, 1.4, -4.0])  # from the middle between the corners: where an eyeball is tried first
OPEN_SHARE = 0.4  # of the eye's length, within which lids of an open eye have a border about its middle
SIDES = ("right", "left")


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """Holds an eyeball's centre (mm), its gaze (a unit vector), and the albedo of its iris."""

    centre: Vector
    gaze: Vector
    iris: Colour

    @property
    def iris_centre(self) -> Vector:
        """Returns the middle (mm) of the limbus, the circle around the iris."""
        return self.centre + np.sqrt(RADIUS_MM**2 - LIMBUS_MM**2) * self.gaze

    def placed(self, world_from_head: Similarity) -> "Eye":
        """Transforms the eye to the world frame, by a pose without scaling."""
        return replace(
            self, centre=world_from_head.apply(self.centre[None])[0], gaze=world_from_head.rotation @ self.gaze
        )

    def reach(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns the distance (mm) from the eyeball's centre to its surface in each direction (unit vectors)."""
        cosine = directions @ self.gaze
        ahead = np.sqrt(RADIUS_MM**2 - LIMBUS_MM**2) - np.sqrt(CORNEA_MM**2 - LIMBUS_MM**2)
        bulge = ahead * cosine + np.sqrt(np.maximum(CORNEA_MM**2 - ahead**2 * (1.0 - cosine**2), 0.0))
        return np.where(cosine > np.sqrt(1.0 - (LIMBUS_MM / RADIUS_MM) ** 2), bulge, RADIUS_MM)


@dataclass(frozen=True, slots=True, eq=False)
class EyeSurface:
    """Holds an eyeball's front as a mesh, with ``paint`` as in ``photograph.Part`` and the strength of highlights."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    paint: Float[np.ndarray, "v 4"]
    oil: Float[np.ndarray, " v"]


def look_at_point(centres: Mapping[str, Vector], target: Vector, iris: Colour) -> dict[str, Eye]:
    """Returns the eyes by side, with both gazes directed at the point ``target``."""
    out = {}
    for side, centre in centres.items():
        towards = target - centre
        out[side] = Eye(centre, towards / np.linalg.norm(towards), iris)
    return out


def surface(eye: Eye, rng: np.random.Generator) -> EyeSurface:
    """Creates the surface of an eyeball, with random fibres in the iris."""
    limbus = np.arcsin(LIMBUS_MM / RADIUS_MM)
    angles = np.concatenate([np.linspace(0.004, limbus + 0.1, 56), np.linspace(limbus + 0.13, 0.6 * np.pi, 24)])
    around = np.arange(SECTORS) * 2.0 * np.pi / SECTORS
    across = np.cross(eye.gaze, (0.0, 1.0, 0.0))
    across /= np.linalg.norm(across)
    ring = np.outer(np.cos(around), across) + np.outer(np.sin(around), np.cross(across, eye.gaze))
    directions = np.cos(angles)[:, None, None] * eye.gaze + np.sin(angles)[:, None, None] * ring
    reach = eye.reach(directions.reshape(-1, 3))
    off_axis = reach.reshape(len(angles), SECTORS) * np.sin(angles)[:, None]
    faces = grid_faces(len(angles), SECTORS)
    vertices = eye.centre + reach[:, None] * directions.reshape(-1, 3)
    faces = turned_along(vertices, faces, vertices - eye.centre)
    cornea = _step(off_axis, LIMBUS_MM, 0.5)
    oil = GLOSS_WHITE + (GLOSS_EYE - GLOSS_WHITE) * cornea
    return EyeSurface(vertices, faces, _paint(off_axis, eye.iris, rng), oil.ravel())


def _paint(off_axis: Float[np.ndarray, "r s"], iris: Colour, rng: np.random.Generator) -> Float[np.ndarray, "v 4"]:
    fibres = 1.0 + 0.25 * np.clip(rng.standard_normal(SECTORS), -2.0, 2.0)
    rim = 1.0 - (1.0 - RIM) * _step(-off_axis, -(LIMBUS_MM - 0.7), 0.8)
    tone = np.array(iris) * (fibres * rim)[:, :, None]
    within, pupil = (_step(off_axis, *edge)[:, :, None] for edge in ((LIMBUS_MM, LIMBUS_WIDTH_MM), (PUPIL_MM, 0.3)))
    colour = np.array(WHITE) + within * (tone - np.array(WHITE))
    colour += pupil * (np.array(PUPIL) - colour)
    return np.concatenate([colour.reshape(-1, 3), np.full((off_axis.size, 1), 0.1)], axis=1)


def _step(x: Float[np.ndarray, "r s"], middle: float, width: float) -> Float[np.ndarray, "r s"]:
    """Returns a smooth step of ``width``: 1 below ``middle``, 1/2 at it, and 0 above."""
    t = np.clip((middle + 0.5 * width - x) / width, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def open_lids(mesh: Mesh, landmarks: Landmarks) -> Mesh:
    """Removes the skin between a head's lids (head frame), after subdividing triangles there, and gives the lids a
    thickness. The opened mesh's first vertices are those of ``mesh``. Eyes that are already open in the mesh keep their
    border."""
    for side in SIDES:
        mesh, cut = _cut(mesh, landmarks, side)
        mesh = _with_margins(mesh, cut)
    return mesh


def _cut(mesh: Mesh, landmarks: Landmarks, side: str) -> tuple[Mesh, Int[np.ndarray, "e 2"]]:
    """Cuts the skin of one eye open. Also returns the cut's edges, or none if the eye is already open."""
    inner, outer = landmarks[f"endocanthion_{side}"], landmarks[f"exocanthion_{side}"]
    middle = 0.5 * (inner + outer)
    border = mesh.vertices[np.unique(boundary_edges(mesh.faces))]
    if np.linalg.norm(border - middle, axis=1).min(initial=np.inf) < OPEN_SHARE * np.linalg.norm(outer - inner):
        return mesh, np.zeros((0, 2), int)
    vertices, faces = mesh.vertices, mesh.faces
    while True:
        corners = vertices[faces]
        patch = np.linalg.norm(corners.mean(axis=1) - middle, axis=1) < PATCH_MM
        edges = np.linalg.norm(corners[patch] - np.roll(corners[patch], 1, axis=1), axis=2)
        if not patch.any() or np.median(edges) < EDGE_MM:
            break
        vertices, faces, *_ = subdivide(vertices, faces, face_index=np.flatnonzero(patch))
    gap = eye_gap(vertices, inner, outer, 0.0)
    inside = (gap.here & (np.abs(gap.off) < gap.height))[faces].all(axis=1)
    edges = boundary_edges(faces[~inside])
    edges = edges[np.isin(edges, np.unique(faces[inside])).all(axis=1)]
    return Mesh(vertices, faces[~inside]), edges


def _with_margins(mesh: Mesh, edges: Int[np.ndarray, "e 2"]) -> Mesh:
    """Extends the skin of a head backwards from a cut, because lids have a thickness."""
    rim, number = np.unique(edges, return_inverse=True)
    start, end = number.reshape(-1, 2).T + len(mesh.vertices)
    behind = mesh.vertices[rim] - (0.0, 0.0, MARGIN_MM)
    walls = [np.stack([edges[:, 1], edges[:, 0], start], axis=1), np.stack([edges[:, 1], start, end], axis=1)]
    return Mesh(np.concatenate([mesh.vertices, behind]), np.concatenate([mesh.faces, *walls]))


def eye_centres(mesh: Mesh, landmarks: Landmarks, gaze: Vector) -> dict[str, Vector]:
    """Returns the centres (mm, head frame) of a head's eyeballs by side, as far forward as the lids permit with the
    direction ``gaze``."""
    out = {}
    for side in SIDES:
        inner, outer = landmarks[f"endocanthion_{side}"], landmarks[f"exocanthion_{side}"]
        centre = 0.5 * (inner + outer) + FRONT_MM
        lids, _ = _cut(mesh, landmarks, side)
        near = np.linalg.norm(lids.vertices - centre, axis=1) < PATCH_MM
        points = lids.vertices[np.intersect1d(np.flatnonzero(near), np.unique(lids.faces))]
        places = [centre - (0.0, 0.0, back) for back in np.arange(0.0, BACK_MM, STEP_MM)]
        out[side] = next((position for position in places if _has_room(Eye(position, gaze, WHITE), points)), places[-1])
    return out


def _has_room(eye: Eye, lids: Float[np.ndarray, "n 3"]) -> bool:
    away = lids - eye.centre
    distance = np.linalg.norm(away, axis=1)
    return bool((distance > eye.reach(away / distance[:, None]) + GAP_MM).all())
