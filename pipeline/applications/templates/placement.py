"""Finds head_from_template, the similarity transform that places another program's mesh in the head frame, from
landmarks or by a search.

The search tries millimetres, centimetres, decimetres and metres, every orientation of the axes, and three start
positions for each combination. Iterated closest points (Besl and McKay 1992; with Umeyama's scale) from the head
model's surface to the mesh then refine the transform; teeth, eyeballs or shoulders of the mesh have no effect."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from pipeline.geometry.registration.rigid import procrustes
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from rig.errors import InputError
from rig.geometry import Similarity
from rig.mesh import vertex_normals
from rig.messages.message import compose

UNITS = {"mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0}
EXTENT_MM = (110.0, 750.0)  # of a face alone, and of a bust
COARSE, FINE = 400, 3000  # points of the model that are matched
SAMPLES = 20_000  # of the mesh's points that are found
COARSE_STEPS, FINE_STEPS = 8, 30
TRIED = 4  # coarse placements that are refined
NORMAL_MM = 20.0  # distance that equals a unit difference of normals
FAR_MM = 20.0  # distances are clipped here
SCALE_RANGE = (0.7, 1.45)  # of adults' and children's heads by the model's
UNLIKE_MM = 8.0  # mean distance of the face beyond which a placement is rejected


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Holds a triangle mesh with unit vertex normals; lengths are in mm after placement in the head frame."""

    vertices: Float[np.ndarray, "t 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "t 3"]

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "t 3"], faces: Int[np.ndarray, "f 3"]) -> "Surface":
        """Returns the mesh with computed vertex normals."""
        return cls(vertices, faces, vertex_normals(vertices, faces))

    def placed(self, place: Similarity) -> "Surface":
        """Returns the mesh transformed by a similarity."""
        return Surface(place.apply(self.vertices), self.faces, self.normals @ place.rotation.T)


def outward(vertices: Float[np.ndarray, "t 3"], faces: Int[np.ndarray, "f 3"]) -> Surface:
    """Returns the mesh with computed vertex normals; if its faces point inwards, all of them are flipped."""
    corners = vertices[faces] - vertices[np.unique(faces)].mean(axis=0)
    if np.einsum("fx,fx->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    return Surface.of(vertices, faces)


def place_by_landmarks(model: HeadModel, landmarks: Mapping[str, Float[np.ndarray, " 3"]], name: str) -> Similarity:
    """Computes head_from_template from at least four landmarks in the mesh's frame. Raises InputError, which begins
    with the mesh's ``name``, if the landmarks do not suffice."""
    names = [each for each in landmarks if each in model.landmarks]
    if len(names) < 4:
        raise InputError(name, [compose("template-landmarks-too-few", count=len(names), names=names or ["none"])])
    ours = model.vertices(np.zeros(0))[[model.landmarks[each] for each in names]]
    try:
        return procrustes(np.array([landmarks[each] for each in names]), ours)
    except ValueError as error:
        raise InputError(name, [compose("template-landmarks-do-not-place", reason=str(error))]) from None


def find_place(model: HeadModel, mesh: Surface, name: str) -> Similarity:
    """Finds head_from_template by a search over units, axes and start positions. Raises InputError if the mesh does not
    resemble a head."""
    used = mesh.vertices[np.unique(mesh.faces)]
    extent = float(np.ptp(used, axis=0).max())
    factors = [f for f in UNITS.values() if EXTENT_MM[0] < extent * f < EXTENT_MM[1]]
    if not factors:
        raise InputError(name, [compose("extent-absurd", extent=extent, units=UNITS)])
    points, normals, weights = _model_points(model, FINE)
    some = slice(None, None, max(1, len(points) // COARSE))
    there = [part[:: max(1, len(part) // SAMPLES)] for part in samples(mesh)]
    tree = KDTree(np.concatenate([there[0] * factors[0], there[1] * NORMAL_MM], axis=1))
    coarse = []
    for factor, turn in product(factors, _axis_turns()):
        for start in _starts(model, points, Similarity(factor, turn, np.zeros(3)), used):
            found = _closest_points(
                mesh, tree, factors[0], points[some], normals[some], weights[some], place=start, steps=COARSE_STEPS
            )
            coarse.append(found)
    coarse.sort(key=lambda found: found[0])
    fine = [
        _closest_points(mesh, tree, factors[0], points, normals, weights, place=place, steps=FINE_STEPS)
        for _, place in coarse[:TRIED]
    ]
    off_mm, place = min(fine, key=lambda found: found[0])
    if off_mm > UNLIKE_MM:
        why = compose("template-off-face", off_mm=off_mm)
        raise InputError(name, [compose("template-no-head", reason=why)])
    return place


def _model_points(model: HeadModel, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns points on the head model without its neck, their normals, and their weights. Points of the face have the
    largest weight, because the mesh may consist of a face alone."""
    vertices, regions = model.vertices(np.zeros(0)), head_regions(model)
    rows = np.flatnonzero(~regions["neck"])
    rows = rows[:: max(1, len(rows) // count)]
    weights = np.where(regions["face"][rows], 1.0, 0.3)
    return vertices[rows], vertex_normals(vertices, model.levels["full"].faces)[rows], weights / weights.sum()


def samples(mesh: Surface) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns points of a mesh and the unit normals there: its used vertices, and the centres of its faces."""
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    normal = mesh.normals[mesh.faces].sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    used = np.unique(mesh.faces)
    return np.concatenate([mesh.vertices[used], middle]), np.concatenate([mesh.normals[used], normal])


def _axis_turns() -> list[Float[np.ndarray, "3 3"]]:
    """Returns the 24 rotations that map the coordinate axes onto each other."""
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if np.linalg.det(matrix) > 0:
            turns.append(matrix)
    return turns


def _starts(
    model: HeadModel, points: np.ndarray, turned: Similarity, used: Float[np.ndarray, "t 3"]
) -> list[Similarity]:
    """Returns three transforms that bring the mesh's nose, crown or centre to that of the head model."""
    here, ours = turned.apply(used), model.vertices(np.zeros(0))
    low, high = here.min(axis=0), here.max(axis=0)
    nose, crown = here[here[:, 2].argmax()], np.array([*(low + high)[[0]] / 2, high[1], (low + high)[2] / 2])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    our_crown = np.array([middle[0], points[:, 1].max(), middle[2]])
    shifts = (ours[model.landmarks["pronasale"]] - nose, our_crown - crown, middle - (low + high) / 2)
    return [Similarity(turned.scale, turned.rotation, shift) for shift in shifts]


def _closest_points(
    mesh: Surface,
    tree: KDTree,
    factor: float,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"],
    *,
    place: Similarity,
    steps: int,
) -> tuple[float, Similarity]:
    """Refines a similarity by iterated closest points. Returns the smallest weighted mean distance (mm, clipped at
    ``FAR_MM``) of the head model's points from the mesh, and the similarity. ``tree`` is a search tree over the mesh's
    points, scaled by ``factor``, with their normals."""
    start = place.scale
    found = (FAR_MM, place)
    for step in range(steps + 1):
        back = place.inverse()
        query = np.concatenate([back.apply(points) * factor, normals @ place.rotation * NORMAL_MM], axis=1)
        near = tree.data[np.asarray(tree.query(query)[1], int)]
        there = place.apply(near[:, :3] / factor)
        off = np.linalg.norm(there - points, axis=1)
        facing = np.einsum("nx,nx->n", query[:, 3:], near[:, 3:]) / NORMAL_MM**2
        cost = float(weights @ np.minimum(np.where(facing > 0.3, off, FAR_MM), FAR_MM))
        if cost < found[0]:
            found = (cost, place)
        if step == steps:
            break
        keep = weights * (facing > 0.3) / (1.0 + (off / max(3.0, 2.0 * cost)) ** 2) ** 2
        if np.count_nonzero(keep) < 20:
            break
        try:
            moved = procrustes(near[:, :3] / factor, points, keep)
        except ValueError:
            break
        low, high = (limit * start for limit in SCALE_RANGE)
        scale = float(np.clip(moved.scale, low, high))
        share = keep / keep.sum()
        shift = share @ points - scale * moved.rotation @ (share @ near[:, :3] / factor)
        place = Similarity(scale, moved.rotation, shift)
    return found
