"""Brings raw scans into correspondence (the paper's section 3.2): landmark warp, cylindrical resampling, refinement.

Each scan is first moved rigidly into the head frame by its landmarks. A registered scan has the vertices and triangles
of the default model, because modes on a scan's hundred thousand vertices would take a hundred megabytes; the paper
keeps the scan's vertices. The functions ``on_reference`` and ``warp_and_resample`` are the paper's steps; they serve
only to draw its figure 3. Landmarks alone leave the vertices between them free to slide along the surface. A model is
therefore built from refined heads: the most probable head under a prior of heads, given the scan's landmarks and
surface, is displaced smoothly along its normals onto the scan.

The prior contains more heads than the span of a PCA. A PCA of 138 heads has 137 directions, and a head outside this
span would be fitted with vertices at wrong positions. Two assumptions extend the sample of scanned heads. A head and
its mirror image are equally likely, so the covariance is averaged with the covariance of mirrored heads. Distant parts
of a head are nearly independent, so a second covariance is multiplied by a Gaussian of the distance between vertices.
The localised covariance keeps only the correlation of near vertices (localised models: Luethi et al. 2018, *Gaussian
Process Morphable Models*, section 3.3). The prior mixes the original and the localised covariance.

Resampling casts rays outwards from the vertical axis through the head. A ray is (angle, height): angle 0 points along
+z (out of the face), pi/2 along +x (the subject's left); height is y. Several processes work on scans, because SuperLU
and numpy do not release the interpreter lock."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import TypeVar

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from pipeline.applications.model_building.correspondence.cylinder_kernels import CELL_MM, bin_triangles, cast_rays
from pipeline.applications.model_building.correspondence.scans import Scan
from pipeline.geometry.registration.nonrigid import (
    Search,
    Target,
    dots,
    draw_to_target,
    match_points,
    oriented_tree,
    warp_by_landmarks,
)
from pipeline.geometry.registration.rigid import motion_columns, solve_with_prior
from pipeline.head_model.landmarks import NAMES, stacked
from pipeline.head_model.model import HeadModel
from pipeline.head_model.pca import align
from pipeline.head_model.subdivision import vertex_areas
from rig.geometry import RigidTransform, rigid_fit
from rig.mesh import edges_of, vertex_normals
from rig.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

FEW = 12  # with fewer items the processes' start (two seconds) costs more than they save
_CHUNK = 4  # items per message: the task's constant data (a prior of 40 MB) is sent once for each chunk
PerVertex = Float[np.ndarray, " N"]
_TAUBIN = (0.5, -0.53)  # weights of a step that smooths and of one that restores the size
_SMOOTHINGS = 4  # pairs of steps: they halve the noise of points; 8 would remove fine shape too
# Normals lead while the shape is millimetres off; close by they would pin a vertex to where its own, still wrong,
# normal points (0.43 mm instead of 0.19 on heads inside the span), so there nearness decides.
BROAD, FINE = Search(5, 15.0, 12.0, 1.0), Search(4, 4.0, 1.0, 0.05)
STIFFNESS = (3.0, 1.0, 0.5)
MARK_MM = 0.5  # standard deviation of a marked landmark, per axis
WORKERS = 2  # processes
# Of figure 3: the drawing of the reference, in which a matched vertex weighs 1; the warp, which must not follow the
# errors of landmarks; and how far a sample may lie from the warped vertex.
REFERENCE_STIFFNESS, MARK_WEIGHT = (30.0, 30.0, 10.0, 10.0, 3.0, 3.0, 1.0, 1.0, 0.5, 0.5), 0.3
MARK_SMOOTHING_MM, SAMPLE_REACH_MM = 1.0, 15.0
GLOBAL, LOCAL = 0.8, 0.6  # factors of both parts' standard deviations; their squares add up to 1
LENGTH_MM = 60.0  # of the Gaussian of the distance between vertices
# Localised modes; with 300 the held-out error is a tenth larger (tests/laboratory/notes/head-models.md).
KEPT = 700
_SPARE = 100  # directions of the sketch beyond those kept
_BLOCK = 600
_MIRROR = np.array([-1.0, 1.0, 1.0])
_SYMMETRIC = 0.99  # share of edges that must exist mirrored too; not all do, since quads may be split differently


@dataclass(frozen=True, slots=True, eq=False)
class Workers:
    """Runs a picklable function over items in several processes."""

    pool: ProcessPoolExecutor | None

    def over(self, work: Callable[[Item], Result], items: Sequence[Item], stage: str, report: Progress) -> list[Result]:
        """Runs ``work`` on the items and returns the results in their order. Raises the exception of the first item
        that fails."""
        results = map(work, items) if self.pool is None else self.pool.map(work, items, chunksize=_CHUNK)
        out = []
        for result in results:
            out.append(result)
            report(stage, len(out) / len(items))
        return out


@contextmanager
def workers(count: int, items: int) -> Iterator[Workers]:
    """Yields ``count`` processes for ``items`` pieces of work; few items are processed in the calling process."""
    if count < 2 or items < FEW:
        yield Workers(None)
        return
    # fresh interpreters: a fork would copy locks that threads (BLAS, numba) of this process hold
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        yield Workers(pool)


def coordinates(points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, " _"], ...]:
    """Returns angle (-pi to pi), height and radius (mm) of points about the axis x = z = 0."""
    return np.arctan2(points[:, 0], points[:, 2]), points[:, 1], np.hypot(points[:, 0], points[:, 2])


def points_at(angles: PerVertex, heights: PerVertex, radii: PerVertex) -> Float[np.ndarray, "N 3"]:
    """Returns points from angle, height and radius: the inverse of ``coordinates``."""
    return np.stack([radii * np.sin(angles), heights, radii * np.cos(angles)], 1)


class CylinderIndex:
    """Holds a triangle surface (mm), prepared for rays from the vertical axis x = z = 0."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self._vertices = np.ascontiguousarray(vertices, float)
        self._faces = np.ascontiguousarray(faces, np.int64)
        self._low = float(vertices[:, 1].min())
        self._rows = int((vertices[:, 1].max() - self._low) / CELL_MM) + 1
        self._start, self._members = bin_triangles(self._vertices, self._faces, self._low, self._rows)

    def cast(self, angles: PerVertex, heights: PerVertex, near: PerVertex | None = None) -> PerVertex:
        """Returns the radius (mm) at which each ray hits the surface: the hit nearest to ``near`` or, without ``near``,
        the outermost hit; NaN without a hit."""
        wanted = np.full(len(angles), np.inf) if near is None else np.asarray(near, float)
        return cast_rays(
            self._vertices, self._faces, self._low, self._rows, self._start, self._members, angles, heights, wanted
        )


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Holds a distribution of heads (mm): mean + z modes with z ~ N(0, I). Modes need not be orthogonal; the first
    ``broad`` modes are global, the others localised."""

    mean: Float[np.ndarray, "V 3"]
    modes: Float32[np.ndarray, "K V 3"]
    broad: int


def registration_prior(
    mean: Float[np.ndarray, "V 3"], modes: Float[np.ndarray, "M V 3"], faces: Int[np.ndarray, "F 3"]
) -> Prior:
    """Returns the mixed prior for a model's mean and modes (mm per sigma), mirrored if the mesh is symmetric."""
    opposite = mirror_images(mean, faces)
    if opposite is not None:
        mean = (mean + mean[opposite] * _MIRROR) / 2
        modes = np.concatenate([modes, modes[:, opposite] * _MIRROR]) / np.sqrt(2)
    modes = modes.astype(np.float32)
    local = localised(mean, modes)
    return Prior(mean, np.concatenate([GLOBAL * modes, LOCAL * local]).astype(np.float32), len(modes))


def mirror_images(mean: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " V"] | None:
    """Returns, for each vertex, its mirror vertex across the median plane x = 0; None if the mesh is not symmetric.

    The mirror pairs are the one-to-one assignment with the least total distance. A mean head is not exactly symmetric,
    so choosing the nearest mirrored vertex would use some vertices twice."""
    opposite = linear_sum_assignment(cdist(mean, mean * _MIRROR, "sqeuclidean"))[1]
    edges = edges_of(faces)[0].astype(np.int64)
    across = np.sort(opposite[edges], 1)
    found = np.isin(across[:, 0] * len(mean) + across[:, 1], edges[:, 0] * len(mean) + edges[:, 1])
    return opposite if found.mean() > _SYMMETRIC else None


def localised(mean: Float[np.ndarray, "V 3"], modes: Float32[np.ndarray, "M V 3"]) -> Float32[np.ndarray, "K V 3"]:
    """Returns the ``KEPT`` strongest modes of the localised covariance: the modes' covariance times a Gaussian of the
    vertex distance on the mean head.

    The covariance matrix K is too large to store (400 MB), so its rows are computed in blocks and multiplied by a
    random matrix P: K ~ Y (P^T Y)^-1 Y^T with Y = K P (Halko, Martinsson, Tropp 2011, section 5.5)."""
    size = mean.size
    flat = modes.reshape(len(modes), size)
    probe = np.random.default_rng(0).standard_normal((size, min(KEPT + _SPARE, size))).astype(np.float32)
    sketch = np.empty_like(probe)
    for first in range(0, len(mean), _BLOCK):
        rows = slice(first, first + _BLOCK)
        window = np.exp(cdist(mean[rows], mean, "sqeuclidean") / (-2 * LENGTH_MM**2)).astype(np.float32)
        entries = slice(3 * first, 3 * (first + len(window)))
        product = (flat[:, entries].T @ flat).reshape(len(window), 3, len(mean), 3) * window[:, None, :, None]
        sketch[entries] = product.reshape(3 * len(window), size) @ probe
    core = probe.T.astype(float) @ sketch
    ridge = 1e-6 * np.trace(core) / len(core)  # rounding makes the smallest eigenvalues negative
    factor = cholesky((core + core.T) / 2 + ridge * np.eye(len(core)))
    root = solve_triangular(factor.T, sketch.T.astype(float), lower=True)
    values, vectors = np.linalg.eigh(root @ root.T)
    strongest = np.argsort(values)[::-1][:KEPT]
    return (vectors[:, strongest].T @ root).reshape(-1, *mean.shape).astype(np.float32)


def correspond(scans: Sequence[Scan], template: HeadModel, report: Progress) -> Float[np.ndarray, "N V 3"]:
    """Returns the scans as heads with the vertices of the template's coarsest mesh, the cage (mm), in the common head
    frame. The scans must have passed ``scan_checks.check``."""
    count = len(template.mean)
    faces, mean = template.levels["cage"].faces, template.vertices(np.zeros(0))[:count]
    prior = registration_prior(mean, template.basis("full", len(template.modes), np.arange(count)), faces)
    one = partial(_most_probable, prior, faces, _landmark_rows(template))
    placed_scans = list(zip(scans, common_frame(scans, template), strict=True))
    with workers(WORKERS, len(scans)) as crew:
        return np.array(crew.over(one, placed_scans, "refining", report))


def common_frame(scans: Sequence[Scan], template: HeadModel) -> list[RigidTransform]:
    """Returns the rigid motion of each scan into the head frame: the scans' landmarks are aligned with each other, and
    their mean with the template's landmarks."""
    marks = np.array([stacked(scan.landmarks) for scan in scans])
    ours = template.vertices(np.zeros(0))[[template.landmarks[name] for name in NAMES]]
    weights = np.ones(len(NAMES))
    start = np.array([rigid_fit(m, ours, weights).apply(m) for m in marks])
    mean = align(start, weights).mean(0)
    return [rigid_fit(m, mean, weights) for m in marks]


def prepared(scan: Scan, frame_from_scan: RigidTransform) -> Target:
    """Returns the scan in the common frame, smoothed without shrinking (Taubin 1995), with smoothed normals."""
    vertices = frame_from_scan.apply(scan.vertices)
    averaging = _averaging(scan.faces, len(vertices))
    for factor in _TAUBIN * _SMOOTHINGS:
        vertices += factor * (averaging @ vertices - vertices)
    normals = vertex_normals(vertices, scan.faces)
    for _ in range(2):
        normals = averaging @ normals
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    marks = frame_from_scan.apply(stacked(scan.landmarks))
    return Target(vertices, normals, marks)


def _averaging(faces: Int[np.ndarray, "F 3"], count: int) -> sparse.csr_array:
    edges, _, _ = edges_of(faces)
    rows = np.concatenate([edges[:, 0], edges[:, 1], np.arange(count)])
    columns = np.concatenate([edges[:, 1], edges[:, 0], np.arange(count)])
    both = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return sparse.csr_array(sparse.diags_array(1 / np.asarray(both.sum(1)).ravel()) @ both)


def on_reference(target: Target, template: HeadModel) -> Float[np.ndarray, "V 3"]:
    """Returns the template's cage vertices moved onto the surface of the reference scan."""
    surface = template.vertices(np.zeros(0))[: len(template.mean)]
    index = _landmark_rows(template)
    warped = warp_by_landmarks(surface[index], target.marks, surface)
    fixed = {int(row): mark for row, mark in zip(index, target.marks, strict=True)}
    faces = template.levels["cage"].faces
    return draw_to_target(warped, faces, target, BROAD, REFERENCE_STIFFNESS, marks=fixed, mark_weight=MARK_WEIGHT)


def warp_and_resample(
    shape: Float[np.ndarray, "V 3"],
    index: Int[np.ndarray, " L"],
    marks: Float[np.ndarray, "L 3"],
    cylinder: CylinderIndex,
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"], Bool[np.ndarray, " V"]]:
    """Warps the reference head to the scan's landmarks and resamples it on the scan's surface (steps 3 and 4 of the
    paper's section 3.2). Returns the warped head, the resampled head, and a mask of the vertices without surface, which
    stay at the warped position."""
    warped = warp_by_landmarks(shape[index], marks, shape, smoothing=MARK_SMOOTHING_MM)
    angles, heights, radii = coordinates(warped)
    hits = cylinder.cast(angles, heights, radii)
    void = ~(np.abs(hits - radii) < SAMPLE_REACH_MM)
    sampled = points_at(angles, heights, np.where(void, radii, hits))
    sampled[index], void[index] = marks, False  # landmarks stay fixed
    return warped, sampled, void


def _most_probable(
    prior: Prior, faces: Int[np.ndarray, "F 3"], index: Int[np.ndarray, " L"], placed_scan: tuple[Scan, RigidTransform]
) -> Float[np.ndarray, "V 3"]:
    scan, frame = placed_scan
    target = prepared(scan, frame)
    return draw_to_target(statistical(prior, faces, index, target), faces, target, FINE, STIFFNESS)


def _landmark_rows(template: HeadModel) -> Int[np.ndarray, " L"]:
    return np.array([template.landmarks[name] for name in NAMES])


def statistical(
    prior: Prior, faces: Int[np.ndarray, "F 3"], index: Int[np.ndarray, " L"], target: Target
) -> Float[np.ndarray, "V 3"]:
    """Returns the most probable head under the prior, given the scan's landmarks and surface; it is fitted first with
    the broad modes, then with all modes.

    On a featureless cheek, smoothness cannot determine where a vertex belongs, but the statistics of other heads can.
    Surface residuals are point-to-plane distances weighted by area (cm2); landmark residuals count along all three
    axes; six unknowns are the pose."""
    mean, areas = prior.mean, vertex_areas(prior.mean, faces)
    shape = warp_by_landmarks(mean[index], target.marks, mean, smoothing=20.0)
    points = np.concatenate([mean, np.repeat(mean[index], 3, axis=0)])  # a landmark is three planes
    for search, count in ((BROAD, prior.broad), (FINE, len(prior.modes))):
        tree = oriented_tree(target, search)
        modes = np.ascontiguousarray(prior.modes[:count].transpose(1, 2, 0))
        for _ in range(search.steps):
            near, weight = match_points(shape, faces, target, tree, search)
            planes = target.normals[near]
            along = sum(planes[:, axis, None].astype(np.float32) * modes[:, axis] for axis in range(3))
            moves = np.concatenate([along, modes[index].reshape(-1, count)])
            normals = np.concatenate([planes, np.tile(np.eye(3), (len(index), 1))])
            columns = np.concatenate([moves, motion_columns(points, normals)], axis=1)
            ahead = np.concatenate([dots(target.vertices[near] - mean, planes), (target.marks - mean[index]).ravel()])
            information = weight * areas / 100.0 / search.plane_mm**2
            known = np.concatenate([information, np.full(3 * len(index), MARK_MM**-2)])
            priors = np.repeat([1.0, 0.0], [count, 6])
            solution = solve_with_prior(columns, ahead, known, priors, np.zeros(count + 6), precision=np.float32)
            z, turn, shift = np.split(solution, [count, count + 3])
            shape = mean + modes @ z + shift + np.cross(turn, mean)
    return shape
