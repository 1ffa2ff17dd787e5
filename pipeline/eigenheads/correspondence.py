"""Correspondence between raw scans (section 3.2): landmark warp, cylindrical resampling, second pass, refinement.

Every scan is first moved rigidly (by its landmarks) into the head frame. The reference is the scan nearest the mean;
its surface is given the default model's connectivity, since a scan's own hundred thousand vertices would make modes
of a hundred megabytes (departure from the paper, which keeps the scan's vertices). The paper's steps then run as
written. Landmarks alone leave the surface free to slide between them, so by default a non-rigid refinement follows:
every vertex looks for the scan's point that is near *and* faces the same way, and displacements stay smooth.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from pipeline.eigenheads.cylinder import CylinderIndex, coordinates, points_at
from pipeline.eigenheads.landmarks import NAMES, stacked
from pipeline.eigenheads.model import HeadModel
from pipeline.eigenheads.parallel import Workers, workers
from pipeline.eigenheads.pca import align, rigid_fit
from pipeline.eigenheads.prior import mixed_modes
from pipeline.eigenheads.scans import Scan
from pipeline.eigenheads.surface import edges_of, vertex_areas
from pipeline.eigenheads.warp import landmark_warp
from rig.geometry import cross_matrix
from rig.mesh import vertex_normals

Report = Callable[[str, float], None]
Frame = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]  # rotation and translation, frame from scan


@dataclass(frozen=True, slots=True, kw_only=True)
class Matching:
    """How correspondence is found. Lengths in mm."""

    refine: bool = True
    reach_mm: float = 15.0  # a sample farther than this from the warped vertex is another part of the head: void
    landmark_smoothing_mm: float = 1.0  # landmarks are marked to about half a millimetre: do not bend for that
    normal_mm: float = 12.0  # a right angle between normals counts as much as this many mm
    stiffness: tuple[float, ...] = (30.0, 30.0, 10.0, 10.0, 3.0, 3.0, 1.0, 1.0, 0.5, 0.5)  # per iteration
    slide: float = 0.0  # share of the tangential pull that is followed
    statistical_steps: int = 6
    plane_mm: float = 1.0  # residual that weighs as much as one standard deviation of a mode, per cm2
    mark_mm: float = 0.7
    mark_weight: float = 0.3  # of a landmark in the smooth refinement, beside 1 of a matched vertex
    workers: int = 2  # processes


@dataclass(frozen=True, slots=True, eq=False)
class Correspondence:
    """Heads with the same vertices: row k is scan k, moved into the common frame by ``frame_from_scan``."""

    heads: Float[np.ndarray, "N V 3"]
    void: Bool[np.ndarray, "N V"]
    reference: int
    frame_from_scan: list[Frame]


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A scan in the common frame, prepared for refinement."""

    vertices: Float[np.ndarray, "S 3"]
    normals: Float[np.ndarray, "S 3"]
    marks: Float[np.ndarray, "26 3"]


def correspond(
    scans: Sequence[Scan], template: HeadModel, matching: Matching | None = None, *, report: Report | None = None
) -> Correspondence:
    """Corresponded heads on the template's cage connectivity. Scans must have passed ``scan_checks.check``."""
    matching = matching or Matching()
    frames = common_frame(scans, template)
    given = list(zip(scans, frames, strict=True))
    reference = nearest_mean(np.array([stacked(scan.landmarks) @ r.T + t for scan, (r, t) in given]))
    with workers(matching.workers, len(scans)) as crew:
        shape = on_reference(prepared(scans[reference], *frames[reference]), template, matching)
        heads, void = np.zeros((0, 0, 3)), np.zeros((0, 0), bool)
        for stage in ("first pass", "second pass"):
            sample = partial(_resampled, shape, _landmark_rows(template), matching)
            found = crew.over(sample, given, stage, report)
            heads, void = np.array([head for head, _ in found]), np.array([mask for _, mask in found])
            reference = nearest_mean(heads)
            shape = heads[reference]
        if matching.refine:
            heads = _refined(given, template, matching, crew, report)
    return Correspondence(heads, void, reference, frames)


def common_frame(scans: Sequence[Scan], template: HeadModel) -> list[Frame]:
    """Rigid motions into the head frame: landmarks aligned with each other, their mean with the template's."""
    marks = np.array([stacked(scan.landmarks) for scan in scans])
    ours = template.vertices(np.zeros(0))[[template.landmarks[name] for name in NAMES]]
    weights = np.ones(len(NAMES))
    start = np.array([m @ r.T + t for m in marks for r, t in [rigid_fit(m, ours, weights)]])
    mean = align(start, weights).mean(0)
    return [rigid_fit(m, mean, weights) for m in marks]


def prepared(scan: Scan, rotation: np.ndarray, translation: np.ndarray) -> Target:
    """The scan in the common frame, with normals smoothed over some millimetres (raw ones are mostly noise)."""
    vertices = scan.vertices @ rotation.T + translation
    normals = vertex_normals(vertices, scan.faces)
    averaging = _averaging(scan.faces, len(vertices))
    for _ in range(4):
        normals = averaging @ normals
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    marks = stacked(scan.landmarks) @ rotation.T + translation
    return Target(vertices, normals, marks)


def _averaging(faces: Int[np.ndarray, "F 3"], count: int) -> sparse.csr_array:
    edges, _, _ = edges_of(faces)
    rows = np.concatenate([edges[:, 0], edges[:, 1], np.arange(count)])
    columns = np.concatenate([edges[:, 1], edges[:, 0], np.arange(count)])
    both = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return sparse.csr_array(sparse.diags_array(1 / np.asarray(both.sum(1)).ravel()) @ both)


def nearest_mean(shapes: Float[np.ndarray, "N L 3"]) -> int:
    """The shape closest to the mean of all (step 1 of section 3.2)."""
    return int(((shapes - shapes.mean(0)) ** 2).sum((1, 2)).argmin())


def on_reference(target: Target, template: HeadModel, matching: Matching) -> Float[np.ndarray, "V 3"]:
    """The reference scan's surface on the template's cage vertices."""
    surface = template.vertices(np.zeros(0))[: len(template.mean)]
    index = _landmark_rows(template)
    warped = landmark_warp(surface[index], target.marks, surface)
    return refined(warped, template.levels["cage"].faces, index, target, _tree(target, matching), matching)


def warp_and_resample(
    shape: Float[np.ndarray, "V 3"],
    index: Int[np.ndarray, " L"],
    marks: Float[np.ndarray, "L 3"],
    cylinder: CylinderIndex,
    matching: Matching,
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"], Bool[np.ndarray, " V"]]:
    """Steps 3 and 4: the warped reference, its resampling on the target, and where that is void (there: warped)."""
    warped = landmark_warp(shape[index], marks, shape, smoothing=matching.landmark_smoothing_mm)
    angles, heights, radii = coordinates(warped)
    cast = cylinder.cast(angles, heights, radii)
    void = ~(np.abs(cast.radii - radii) < matching.reach_mm)
    sampled = points_at(angles, heights, np.where(void, radii, cast.radii))
    sampled[index], void[index] = marks, False  # landmarks stay fixed
    return warped, sampled, void


def _resampled(
    shape: Float[np.ndarray, "V 3"], index: Int[np.ndarray, " L"], matching: Matching, given: tuple[Scan, Frame]
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, " V"]]:
    scan, (rotation, translation) = given
    vertices = scan.vertices @ rotation.T + translation
    marks = stacked(scan.landmarks) @ rotation.T + translation
    return warp_and_resample(shape, index, marks, CylinderIndex(vertices, scan.faces), matching)[1:]


def _refined(
    given: Sequence[tuple[Scan, Frame]],
    template: HeadModel,
    matching: Matching,
    crew: Workers,
    report: Report | None,
) -> Float[np.ndarray, "N V 3"]:
    count = len(template.mean)
    mean = template.vertices(np.zeros(0))[:count]
    modes = mixed_modes(mean, template.basis("full", len(template.modes), np.arange(count)).astype(float))
    one = partial(_most_probable, mean, modes, template.levels["cage"].faces, _landmark_rows(template), matching)
    return np.array(crew.over(one, given, "refining", report))


def _most_probable(
    mean: Float[np.ndarray, "V 3"],
    modes: Float[np.ndarray, "M V 3"],
    faces: Int[np.ndarray, "F 3"],
    index: Int[np.ndarray, " L"],
    matching: Matching,
    given: tuple[Scan, Frame],
) -> Float[np.ndarray, "V 3"]:
    scan, frame = given
    target = prepared(scan, *frame)
    tree = _tree(target, matching)
    likeness = statistical(mean, modes, faces, index, target, tree, matching)
    return refined(likeness, faces, index, target, tree, matching)


def _landmark_rows(template: HeadModel) -> Int[np.ndarray, " L"]:
    return np.array([template.landmarks[name] for name in NAMES])


def _tree(target: Target, matching: Matching) -> KDTree:
    """Scan points by position and direction together."""
    return KDTree(np.concatenate([target.vertices, target.normals * matching.normal_mm], 1), balanced_tree=False)


def statistical(
    mean: Float[np.ndarray, "V 3"],
    modes: Float[np.ndarray, "M V 3"],
    faces: Int[np.ndarray, "F 3"],
    index: Int[np.ndarray, " L"],
    target: Target,
    tree: KDTree,
    matching: Matching,
) -> Float[np.ndarray, "V 3"]:
    """The most probable head under mean + z modes, z ~ N(0, I), for the scan's landmarks and surface.

    Smoothness cannot tell where on a plain cheek a vertex belongs; what is known of other heads helps. Residuals are
    point-to-plane, counted per cm2 of surface, landmarks in all three axes; six columns carry the pose.
    """
    areas = vertex_areas(mean, faces)
    shape = landmark_warp(mean[index], target.marks, mean, smoothing=20.0)
    for _ in range(matching.statistical_steps):
        near, weight = _matched(shape, faces, target, tree, matching)
        information = weight * areas / 100.0 / matching.plane_mm**2
        planes = target.normals[near]
        rows_of = np.einsum("mvx,vx->vm", modes, planes)
        offset = np.einsum("vx,vx->v", target.vertices[near] - mean, planes)
        lever = np.concatenate([planes, np.cross(mean, planes)], 1)
        marks = modes[:, index].reshape(len(modes), -1).T
        mark_lever = np.concatenate(
            [np.tile(np.eye(3), (len(index), 1)), np.concatenate([-cross_matrix(p) for p in mean[index]])], 1
        )
        jacobian = np.concatenate([np.hstack([rows_of, lever]), np.hstack([marks, mark_lever])])
        wanted = np.concatenate([offset, (target.marks - mean[index]).ravel()])
        trust = np.concatenate([information, np.full(3 * len(index), 1 / matching.mark_mm**2)])
        weighted = jacobian * trust[:, None]
        system = weighted.T @ jacobian
        system[range(len(modes)), range(len(modes))] += 1.0
        solution = np.linalg.solve(system, weighted.T @ wanted)
        z, pose = solution[: len(modes)], solution[len(modes) :]
        shape = mean + np.tensordot(z, modes, 1) + pose[:3] + np.cross(pose[3:], mean)
    return shape


def refined(
    start: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    index: Int[np.ndarray, " L"],
    target: Target,
    tree: KDTree,
    matching: Matching,
) -> Float[np.ndarray, "V 3"]:
    """Non-rigid closest-point refinement of a warped reference onto a target.

    Each step solves (W + k L^T L) u = W d for the displacements u from ``start`` (all three axes share the matrix; L is
    the graph Laplacian, so affine-like motions stay cheap), with d the pull towards the match: all of it along the
    normal, a share of it in the tangent plane. Matches are nearest in position and normal together.
    """
    bending = _bending(faces, start)
    shape = start
    for stiffness in matching.stiffness:
        near, weight = _matched(shape, faces, target, tree, matching)
        pull = target.vertices[near] - shape
        along = np.einsum("nx,nx->n", pull, target.normals[near])[:, None] * target.normals[near]
        wanted = shape - start + along + matching.slide * (pull - along)
        wanted[index], weight[index] = target.marks - start[index], matching.mark_weight
        system = sparse.csc_array(sparse.diags_array(weight + 1e-4) + stiffness * bending)
        solver = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        shape = start + solver.solve(weight[:, None] * wanted)
    return shape


def _matched(
    shape: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], target: Target, tree: KDTree, matching: Matching
) -> tuple[Int[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Nearest scan points, and weight 1 where the match is near and faces the same way."""
    normals = vertex_normals(shape, faces)
    near = np.asarray(tree.query(np.concatenate([shape, normals * matching.normal_mm], 1), workers=1)[1])
    distance = np.linalg.norm(target.vertices[near] - shape, axis=1)
    facing = np.einsum("nx,nx->n", normals, target.normals[near])
    return near, np.where((distance < matching.reach_mm) & (facing > 0.7), 1.0, 0.0)


def _bending(faces: Int[np.ndarray, "F 3"], vertices: Float[np.ndarray, "V 3"]) -> sparse.csr_array:
    """L^T L of the Laplacian with weights that fall with edge length (a graph of uneven density)."""
    edges, _, _ = edges_of(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    weight = 1 / np.maximum(length, 0.5)
    count = len(vertices)
    both = np.concatenate([edges, edges[:, ::-1]])
    graph = sparse.csr_array((np.tile(weight, 2), (both[:, 0], both[:, 1])), shape=(count, count))
    degree = np.asarray(graph.sum(1)).ravel()
    laplacian = sparse.identity(count) - sparse.diags_array(1 / np.maximum(degree, 1e-12)) @ graph
    return sparse.csr_array(laplacian.T @ laplacian)
