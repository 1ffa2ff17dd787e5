"""Corrects blendshapes so that lips and lids may touch but do not pass through each other at any weight from 0 to 1.

A blendshape moves every vertex along a straight line and ignores collisions. Triangles that cross in the posed mesh but
not at rest are corrected as follows:

- Lids are apart at rest, so their displacement is scaled down until they only touch.
- Lips touch at rest, so their displacement is blended with its mean over the surrounding space. (A mean moves both lips
  in the same way; if it changes by less than 1 mm per mm, no triangles can cross.)

Each correction starts small and grows until no triangles cross; all other vertices keep their displacement."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from pipeline.fusion.crossings import crossing_faces

WEIGHTS = (0.25, 0.5, 0.75, 1.0)  # at which shapes are tested
MEETING = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # ... lids, which meet late
MEETING_ROUNDS = 6
STILL_MM = 0.01  # vertices that move less count as unmoved
MARGIN = 0.02  # of the weight: lids stop so much before they meet
RADII_MM = (3.0, 6.0, 12.0, 24.0)  # of the space over which lips move together; lips are some 10 mm high
BLEND_STEP = 0.25  # of the way to moving together, a round
MAX_ROUNDS = 60
ZONE_RINGS = 6  # rings tested around crossing triangles in a round; at the end all are
MAX_ZONES = 5  # that a change makes wider
FEW = 0.35  # share of the triangles from which testing all is faster
SOFT_RINGS = 3  # over which a change fades
RELAXING = 4  # halvings of the search for the least change that is enough
Vertices = Float[np.ndarray, "t 3"]
Rows = Int[np.ndarray, " r"]


@dataclass(frozen=True, slots=True, eq=False)
class RestSurface:
    """Holds a mesh without expression for the collision tests; ``beside`` is 1 for every two vertices that an edge
    joins. Triangles that already cross others at rest, and their neighbours, are ``excluded`` from the tests."""

    vertices: Vertices
    faces: Int[np.ndarray, "f 3"]
    beside: sparse.csr_array
    excluded: Bool[np.ndarray, " f"]


def prepare_rest_surface(vertices: Vertices, faces: Int[np.ndarray, "f 3"]) -> RestSurface:
    """Prepares a mesh without expression (mm) for the collision tests."""
    count = len(vertices)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ones = sparse.csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    beside = sparse.csr_array(((ones + ones.T) > 0).astype(float))
    spoilt = np.zeros(count, bool)
    spoilt[faces[crossing_faces(vertices, faces)]] = True
    excluded = np.asarray(spoilt[faces].any(axis=1))
    return RestSurface(vertices, faces, beside, excluded)


def crossings(rest: RestSurface, displacement: Vertices, weights: tuple[float, ...] = WEIGHTS) -> Int[np.ndarray, " w"]:
    """Returns, for each weight of a blendshape, the number of triangles that cross others only in the posed mesh."""
    moved = _moved(rest, displacement)
    return np.array([np.count_nonzero(_crossing(rest, displacement, w, moved)) for w in weights])


def keep_apart(rest: RestSurface, displacement: Vertices, *, closing: bool) -> Vertices:
    """Returns a blendshape's displacement (mm, at weight 1) with the smallest change that leaves as few new crossings
    of triangles at ``WEIGHTS`` as possible. If ``closing``, the blendshape closes the lids, which stop where they meet;
    otherwise vertices on both sides of a crossing move together."""
    spot = crossing_vertices(rest, displacement, WEIGHTS[1::2])
    best, fewest, zone = displacement, np.count_nonzero(spot), np.zeros(len(rest.vertices), bool)
    for _ in range(MAX_ZONES):
        if not fewest:
            break
        zone = _grown(rest, zone | spot, ZONE_RINGS)
        rows = np.flatnonzero(zone[rest.faces].any(axis=1))
        out = _stopped(rest, displacement, rows) if closing else displacement
        out = _relaxed(rest, displacement, _together(rest, out, rows), rows)
        spot = crossing_vertices(rest, out, WEIGHTS)
        if np.count_nonzero(spot) < fewest:
            best, fewest = out, np.count_nonzero(spot)
    return best


def _moved(rest: RestSurface, displacement: Vertices) -> Bool[np.ndarray, " f"]:
    """Returns a mask of the triangles that a blendshape moves. Unmoved triangles cannot begin to cross each other."""
    return (np.abs(displacement).max(axis=1) > STILL_MM)[rest.faces].any(axis=1)


def _stopped(rest: RestSurface, displacement: Vertices, zone: Rows) -> Vertices:
    """Returns the displacement scaled by the weight at which triangles of the zone first touch."""
    scale = np.ones(len(displacement))
    for _ in range(MEETING_ROUNDS):
        first = np.full(len(displacement), np.inf)
        for weight in reversed(MEETING):
            spot = crossing_vertices(rest, scale[:, None] * displacement, (weight,), zone)
            first[spot] = weight
        if np.isinf(first).all():
            break
        step = MEETING[1] - MEETING[0]
        allowed = np.where(np.isinf(first), 1.0, first - step / 2.0 - MARGIN)
        scale *= _faded(rest, allowed)
    return scale[:, None] * displacement


def _together(rest: RestSurface, displacement: Vertices, zone: Rows) -> Vertices:
    """Returns the displacement blended with its mean over growing spheres, until no triangles of the zone cross."""
    out, rounds = displacement, 0
    best, fewest = displacement, np.inf
    for radius_mm in RADII_MM:
        base, times = out, np.zeros(len(out), int)
        while rounds < MAX_ROUNDS:
            spot = crossing_vertices(rest, out, WEIGHTS, zone)
            if np.count_nonzero(spot) < fewest:
                best, fewest = out, np.count_nonzero(spot)
            if not spot.any():
                return out
            if times[spot].min() * BLEND_STEP >= 1.0:
                break
            rounds += 1
            times[_grown(rest, spot, 2)] += 1
            retained = _faded(rest, np.clip(1.0 - BLEND_STEP * times, 0.0, 1.0))
            rows = np.flatnonzero(retained < 1.0)
            mean = _mean_in_space(rest.vertices, rows, radius_mm) @ base
            out = base.copy()
            out[rows] = mean + retained[rows, None] * (base[rows] - mean)
    return best


def _relaxed(rest: RestSurface, wanted: Vertices, clean: Vertices, zone: Rows) -> Vertices:
    """Returns the displacement between ``clean`` and ``wanted`` that is nearest to ``wanted`` without crossings."""
    if (wanted == clean).all() or crossing_vertices(rest, clean, WEIGHTS, zone).any():
        return clean
    low, high = 0.0, 1.0
    for _ in range(RELAXING):
        middle = 0.5 * (low + high)
        crosses = crossing_vertices(rest, clean + middle * (wanted - clean), WEIGHTS, zone).any()
        low, high = (low, middle) if crosses else (middle, high)
    return clean + low * (wanted - clean)


def _mean_in_space(vertices: Vertices, rows: Rows, radius_mm: float) -> sparse.csr_array:
    """Returns the matrix that averages displacements near some vertices with Gaussian weights."""
    near = KDTree(vertices).query_ball_point(vertices[rows], 2.0 * radius_mm)
    counts = np.array([len(each) for each in near])
    column, row = np.concatenate(near).astype(int), np.repeat(np.arange(len(rows)), counts)
    square = ((vertices[column] - vertices[rows][row]) ** 2).sum(axis=1)
    weight = np.exp(-0.5 * square / radius_mm**2)
    total = np.bincount(row, weight, len(rows))
    return sparse.csr_array((weight / total[row], (row, column)), shape=(len(rows), len(vertices)))


def _crossing(
    rest: RestSurface, displacement: Vertices, weight: float, active: Bool[np.ndarray, " f"]
) -> Bool[np.ndarray, " f"]:
    """Returns a mask of the triangles that cross at a weight; only pairs with an active triangle are tested."""
    if not active.any():
        return active
    few = active if active.mean() < FEW else None
    return crossing_faces(rest.vertices + weight * displacement, rest.faces, few) & ~rest.excluded


def _crossing_within(rest: RestSurface, displacement: Vertices, weight: float, rows: Rows) -> Bool[np.ndarray, " f"]:
    """Returns a mask of the triangles in ``rows`` that cross each other at a weight, in a tenth of the time."""
    out = np.zeros(len(rest.faces), bool)
    out[rows] = crossing_faces(rest.vertices + weight * displacement, rest.faces[rows])
    return out & ~rest.excluded


def crossing_vertices(
    rest: RestSurface, displacement: Vertices, weights: tuple[float, ...], zone: Rows | None = None
) -> Bool[np.ndarray, " t"]:
    """Returns a mask of the vertices whose triangles cross at some weight, in a ``zone`` or everywhere."""
    out, moved = np.zeros(len(rest.vertices), bool), _moved(rest, displacement)
    for weight in weights:
        crossing = (
            _crossing(rest, displacement, weight, moved)
            if zone is None
            else _crossing_within(rest, displacement, weight, zone)
        )
        out[rest.faces[crossing]] = True
    return out


def _grown(rest: RestSurface, chosen: Bool[np.ndarray, " t"], rings: int) -> Bool[np.ndarray, " t"]:
    for _ in range(rings):
        chosen = chosen | (rest.beside @ chosen.astype(float) > 0)
    return chosen


def _faded(rest: RestSurface, retained: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """Raises the factors to 1 gradually over the rings of neighbours around vertices with smaller factors."""
    count = np.maximum(np.asarray(rest.beside.sum(axis=1)).ravel(), 1.0)
    out = retained
    for _ in range(SOFT_RINGS):
        out = np.minimum(out, 0.5 * out + 0.5 * (rest.beside @ out) / count)
    return out
