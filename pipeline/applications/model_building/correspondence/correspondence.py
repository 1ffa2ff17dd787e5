"""Brings raw scans into correspondence (section 3.2): landmark warp, cylindrical resampling, second pass, refinement.

Every scan is first moved rigidly (by its landmarks) into the head frame. The reference is the scan nearest to the mean.
Its surface gets the default model's connectivity, because modes on a scan's own hundred thousand vertices would take a
hundred megabytes (the paper keeps the scan's vertices). Then the paper's steps follow unchanged. Landmarks alone leave
the surface free to slide between them, so by default a refinement follows: the most probable head under a prior of
heads (``prior``), given the scan's landmarks and surface, and from there a smooth displacement along the normals onto
the scan."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from pipeline.applications.model_building.correspondence.cylinder import CylinderIndex, coordinates, points_at
from pipeline.applications.model_building.correspondence.parallel import Workers, workers
from pipeline.applications.model_building.correspondence.prior import Prior, registration_prior
from pipeline.applications.model_building.correspondence.scans import Scan
from pipeline.geometry.warp import landmark_warp
from pipeline.head_model.landmarks import NAMES, stacked
from pipeline.head_model.model import HeadModel
from pipeline.head_model.pca import align
from pipeline.head_model.subdivision import edges_of, vertex_areas
from rig.geometry import RigidTransform, cross_matrix, rigid_fit
from rig.mesh import vertex_normals
from rig.progress import Progress

_TAUBIN = (0.5, -0.53)  # weights of a step that smooths and of one that restores the size
_SMOOTHINGS = 4  # pairs of steps: they halve the noise of points; 8 would remove fine shape too


@dataclass(frozen=True, slots=True)
class Search:
    """Holds the limits of one stage in which points of a head are searched on a scan. Lengths in mm."""

    steps: int
    reach_mm: float  # a match farther than this is another part of the head
    normal_mm: float  # a right angle between normals counts as much as this many mm
    plane_mm: float  # residual that weighs as much as one standard deviation of a mode, per cm2


@dataclass(frozen=True, slots=True, kw_only=True)
class Matching:
    """Holds the settings of correspondence. Lengths in mm."""

    refine: bool = True
    reach_mm: float = 15.0  # a sample farther than this from the warped vertex is another part of the head: void
    landmark_smoothing_mm: float = 1.0  # landmarks are marked to about 0.5 mm; the warp must not follow such errors
    # Normals lead while the shape is millimetres off; close by they would pin a vertex to where its own, still wrong,
    # normal points (0.43 mm instead of 0.19 on heads inside the span), so there nearness decides.
    broad: Search = Search(5, 15.0, 12.0, 1.0)
    fine: Search = Search(4, 4.0, 1.0, 0.05)
    mark_mm: float = 0.5  # standard deviation of a marked landmark, per axis
    reference_stiffness: tuple[float, ...] = (30.0, 30.0, 10.0, 10.0, 3.0, 3.0, 1.0, 1.0, 0.5, 0.5)  # per iteration
    stiffness: tuple[float, ...] = (3.0, 1.0, 0.5)
    mark_weight: float = 0.3  # of a landmark in giving the reference its connectivity, beside 1 of a matched vertex
    workers: int = 2  # processes


@dataclass(frozen=True, slots=True, eq=False)
class Correspondence:
    """Holds heads with the same vertices (mm): row k is scan k, moved into the common frame by ``frame_from_scan``.
    ``void`` marks vertices without a surface on the scan."""

    heads: Float[np.ndarray, "N V 3"]
    void: Bool[np.ndarray, "N V"]
    reference: int
    frame_from_scan: list[RigidTransform]


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Holds a scan in the common frame (mm), prepared for refinement; ``marks`` are its landmarks."""

    vertices: Float[np.ndarray, "S 3"]
    normals: Float[np.ndarray, "S 3"]
    marks: Float[np.ndarray, "26 3"]


def correspond(
    scans: Sequence[Scan], template: HeadModel, matching: Matching | None = None, *, report: Progress | None = None
) -> Correspondence:
    """Returns the scans as heads with the connectivity of the template's cage. The scans must have passed
    ``scan_checks.check``."""
    matching = matching or Matching()
    frames = common_frame(scans, template)
    placed_scans = list(zip(scans, frames, strict=True))
    reference = nearest_mean(np.array([frame.apply(stacked(scan.landmarks)) for scan, frame in placed_scans]))
    with workers(matching.workers, len(scans)) as crew:
        shape = on_reference(prepared(scans[reference], frames[reference]), template, matching)
        heads, void = np.zeros((0, 0, 3)), np.zeros((0, 0), bool)
        for stage in ("first pass", "second pass"):
            sample = partial(_resampled, shape, _landmark_rows(template), matching)
            found = crew.over(sample, placed_scans, stage, report)
            heads, void = np.array([head for head, _ in found]), np.array([mask for _, mask in found])
            reference = nearest_mean(heads)
            shape = heads[reference]
        if matching.refine:
            heads = _refined(placed_scans, template, matching, crew, report)
    return Correspondence(heads, void, reference, frames)


def common_frame(scans: Sequence[Scan], template: HeadModel) -> list[RigidTransform]:
    """Returns the rigid motions of all scans into the head frame: landmarks are aligned with each other, and their mean
    with the template's."""
    marks = np.array([stacked(scan.landmarks) for scan in scans])
    ours = template.vertices(np.zeros(0))[[template.landmarks[name] for name in NAMES]]
    weights = np.ones(len(NAMES))
    start = np.array([rigid_fit(m, ours, weights).apply(m) for m in marks])
    mean = align(start, weights).mean(0)
    return [rigid_fit(m, mean, weights) for m in marks]


def prepared(scan: Scan, frame_from_scan: RigidTransform) -> Target:
    """Returns the scan in the common frame, smoothed without shrinking (Taubin 1995), with smooth normals."""
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


def nearest_mean(shapes: Float[np.ndarray, "N L 3"]) -> int:
    """Returns the index of the shape closest to the mean of all, which becomes the reference (step 1 of section
    3.2)."""
    return int(((shapes - shapes.mean(0)) ** 2).sum((1, 2)).argmin())


def on_reference(target: Target, template: HeadModel, matching: Matching) -> Float[np.ndarray, "V 3"]:
    """Returns the template's cage vertices placed on the surface of the reference scan."""
    surface = template.vertices(np.zeros(0))[: len(template.mean)]
    index = _landmark_rows(template)
    warped = landmark_warp(surface[index], target.marks, surface)
    fixed = {int(row): mark for row, mark in zip(index, target.marks, strict=True)}
    return refined(
        warped,
        template.levels["cage"].faces,
        target,
        matching.broad,
        matching.reference_stiffness,
        marks=fixed,
        mark_weight=matching.mark_weight,
    )


def warp_and_resample(
    shape: Float[np.ndarray, "V 3"],
    index: Int[np.ndarray, " L"],
    marks: Float[np.ndarray, "L 3"],
    cylinder: CylinderIndex,
    matching: Matching,
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"], Bool[np.ndarray, " V"]]:
    """Warps the reference to the target's landmarks and resamples it on the target's surface (steps 3 and 4 of section
    3.2). Returns the warped reference, its resampling, and where the target has no surface; such vertices keep the
    warped position."""
    warped = landmark_warp(shape[index], marks, shape, smoothing=matching.landmark_smoothing_mm)
    angles, heights, radii = coordinates(warped)
    cast = cylinder.cast(angles, heights, radii)
    void = ~(np.abs(cast.radii - radii) < matching.reach_mm)
    sampled = points_at(angles, heights, np.where(void, radii, cast.radii))
    sampled[index], void[index] = marks, False  # landmarks stay fixed
    return warped, sampled, void


def _resampled(
    shape: Float[np.ndarray, "V 3"],
    index: Int[np.ndarray, " L"],
    matching: Matching,
    placed_scan: tuple[Scan, RigidTransform],
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, " V"]]:
    scan, frame_from_scan = placed_scan
    vertices = frame_from_scan.apply(scan.vertices)
    marks = frame_from_scan.apply(stacked(scan.landmarks))
    return warp_and_resample(shape, index, marks, CylinderIndex(vertices, scan.faces), matching)[1:]


def _refined(
    placed_scans: Sequence[tuple[Scan, RigidTransform]],
    template: HeadModel,
    matching: Matching,
    crew: Workers,
    report: Progress | None,
) -> Float[np.ndarray, "N V 3"]:
    count = len(template.mean)
    faces, mean = template.levels["cage"].faces, template.vertices(np.zeros(0))[:count]
    prior = registration_prior(mean, template.basis("full", len(template.modes), np.arange(count)), faces)
    one = partial(_most_probable, prior, faces, _landmark_rows(template), matching)
    return np.array(crew.over(one, placed_scans, "refining", report))


def _most_probable(
    prior: Prior,
    faces: Int[np.ndarray, "F 3"],
    index: Int[np.ndarray, " L"],
    matching: Matching,
    placed_scan: tuple[Scan, RigidTransform],
) -> Float[np.ndarray, "V 3"]:
    scan, frame = placed_scan
    target = prepared(scan, frame)
    fitted = statistical(prior, faces, index, target, matching)
    return refined(fitted, faces, target, matching.fine, matching.stiffness)


def _landmark_rows(template: HeadModel) -> Int[np.ndarray, " L"]:
    return np.array([template.landmarks[name] for name in NAMES])


def _tree(target: Target, search: Search) -> KDTree:
    """Returns a search tree of the scan's points by position and normal together."""
    return KDTree(np.concatenate([target.vertices, target.normals * search.normal_mm], 1), balanced_tree=False)


def statistical(
    prior: Prior,
    faces: Int[np.ndarray, "F 3"],
    index: Int[np.ndarray, " L"],
    target: Target,
    matching: Matching,
) -> Float[np.ndarray, "V 3"]:
    """Returns the most probable head under the prior, given the scan's landmarks and surface: first with broad modes,
    then with all.

    Smoothness cannot determine where on a plain cheek a vertex belongs; statistics of other heads can. Residuals are
    point-to-plane and count per cm2 of surface, landmarks along all three axes; six columns are the pose."""
    shape = landmark_warp(prior.mean[index], target.marks, prior.mean, smoothing=20.0)
    areas = vertex_areas(prior.mean, faces)
    for search, count in ((matching.broad, prior.broad), (matching.fine, len(prior.modes))):
        tree = _tree(target, search)
        modes = np.ascontiguousarray(prior.modes[:count].transpose(1, 2, 0))
        for _ in range(search.steps):
            near, weight = _matched(shape, faces, target, tree, search)
            information = weight * areas / 100.0 / search.plane_mm**2
            shape = _posterior_mean(prior.mean, modes, index, target, near, information, mark_mm=matching.mark_mm)
    return shape


def _posterior_mean(
    mean: Float[np.ndarray, "V 3"],
    modes: Float32[np.ndarray, "V 3 K"],
    index: Int[np.ndarray, " L"],
    target: Target,
    near: Int[np.ndarray, " V"],
    information: Float[np.ndarray, " V"],
    *,
    mark_mm: float,
) -> Float[np.ndarray, "V 3"]:
    """Returns the posterior mean for vertices on the planes of their matches. Single precision suffices, since the
    prior regularises the system."""
    planes, count = target.normals[near], modes.shape[2]
    along = sum(planes[:, axis, None].astype(np.float32) * modes[:, axis] for axis in range(3))
    lever = np.concatenate([planes, np.cross(mean, planes)], 1)
    turns = np.concatenate([-cross_matrix(point) for point in mean[index]])
    mark_lever = np.concatenate([np.tile(np.eye(3), (len(index), 1)), turns], 1)
    root = np.sqrt(np.concatenate([information, np.full(3 * len(index), mark_mm**-2)]))[:, None]
    offsets = np.concatenate([_dots(target.vertices[near] - mean, planes), (target.marks - mean[index]).ravel()])
    rows = np.block([[along, lever], [modes[index].reshape(-1, count), mark_lever]])
    weighted = (rows * root).astype(np.float32)
    system = (weighted.T @ weighted).astype(float)
    system[range(count), range(count)] += 1.0
    solution = np.linalg.solve(system, weighted.T.astype(float) @ (offsets * root[:, 0]))
    z, shift, turn = np.split(solution, [count, count + 3])
    return mean + modes @ z + shift + np.cross(turn, mean)


def refined(
    start: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    target: Target,
    search: Search,
    stiffnesses: Sequence[float],
    *,
    marks: Mapping[int, Float[np.ndarray, " 3"]] = MappingProxyType({}),
    mark_weight: float = 0.0,
) -> Float[np.ndarray, "V 3"]:
    """Refines a warped reference onto a target by non-rigid closest points (``relaxed``). Matches are nearest by
    position and normal together. ``marks`` are target positions of vertices (mm)."""
    tree, fixed = _tree(target, search), np.array(list(marks), int)

    def match(shape: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, " V"]]:
        near, weight = _matched(shape, faces, target, tree, search)
        normals = target.normals[near]
        wanted = shape + _dots(target.vertices[near] - shape, normals)[:, None] * normals
        if marks:
            wanted[fixed], weight[fixed] = np.array(list(marks.values())), mark_weight
        return wanted, weight

    return relaxed(start, faces, match, stiffnesses)


def relaxed(
    start: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    match: Callable[[Float[np.ndarray, "V 3"]], tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, " V"]]],
    stiffnesses: Sequence[float],
) -> Float[np.ndarray, "V 3"]:
    """Moves a mesh smoothly to where its vertices match: non-rigid closest points, a step for each stiffness.

    Each step solves (W + k L^T L) u = W d for the displacements u from ``start``. L is the graph Laplacian, so that
    nearly affine motions cost little; all three axes share the matrix. ``match`` returns the wanted position and the
    weight of every vertex of a shape (mm). It should move a vertex along the normal of its match and leave it in place
    in the tangent plane."""
    bending, shape = _bending(faces, start), start
    for stiffness in stiffnesses:
        wanted, weight = match(shape)
        system = sparse.csc_array(sparse.diags_array(weight + 1e-4) + stiffness * bending)
        solver = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        shape = start + solver.solve(weight[:, None] * (wanted - start))
    return shape


def _matched(
    shape: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], target: Target, tree: KDTree, search: Search
) -> tuple[Int[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Returns the nearest scan points, and weights: 1 where the match is near and its normal similar, otherwise 0."""
    normals = vertex_normals(shape, faces)
    near = np.asarray(tree.query(np.concatenate([shape, normals * search.normal_mm], 1), workers=1)[1])
    distance = np.linalg.norm(target.vertices[near] - shape, axis=1)
    facing = _dots(normals, target.normals[near])
    return near, np.where((distance < search.reach_mm) & (facing > 0.7), 1.0, 0.0)


def _dots(a: Float[np.ndarray, "N 3"], b: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    return np.einsum("nx,nx->n", a, b)


def _bending(faces: Int[np.ndarray, "F 3"], vertices: Float[np.ndarray, "V 3"]) -> sparse.csr_array:
    """Returns L^T L of a graph Laplacian whose weights fall with edge length, because vertices are unevenly dense."""
    edges, _, _ = edges_of(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    weight = 1 / np.maximum(length, 0.5)
    count = len(vertices)
    both = np.concatenate([edges, edges[:, ::-1]])
    graph = sparse.csr_array((np.tile(weight, 2), (both[:, 0], both[:, 1])), shape=(count, count))
    degree = np.asarray(graph.sum(1)).ravel()
    laplacian = sparse.identity(count) - sparse.diags_array(1 / np.maximum(degree, 1e-12)) @ graph
    return sparse.csr_array(laplacian.T @ laplacian)
