"""Deforms the fitted head to the measured surface.

The displacement of the full mesh's vertices is a smooth random field (``smooth_field``), whose prior standard deviation
is the uncertainty of the fit. Each measured point of skin pulls the closest point of the head along the normals
(``association``), with a robust loss. Where no surface was measured, the head retains the fit's shape. The deformed
head also has a standard deviation for each vertex.

The deformation runs in rounds from coarse to fine. In the first rounds the control points move freely and far, which
brings ears and jaw into position. In the later rounds the vertices move only along their normals, so that a vertex
remains the same anatomical point on every subject. Points of hair and clothes only bound the skin from outside.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Int

from pipeline.compute.trace import traced
from pipeline.contour_fit.fit import Fit
from pipeline.detail.association import Faces, PerVertex, Round, Vertices, add_patches, observe, typical_deviation
from pipeline.detail.blink import blink_shift, estimate_eyelid_closure, plain_shape
from pipeline.detail.dense_points import CELL_MM, SurfacePoints, thin
from pipeline.detail.ears import move_ears
from pipeline.detail.eyelids import EyeEvidence, bridge_eyelids, replace_lids
from pipeline.detail.outline_points import Outlines, OutlineSearch
from pipeline.detail.patch_points import PatchMeasurements, PatchSearch
from pipeline.detail.smooth_field import smooth_field
from pipeline.detail.solve import (
    NodeMesh,
    Nodes,
    Observed,
    Posterior,
    free_directions,
    normal_directions,
    solve_field,
    solving_nodes,
)
from pipeline.fusion.untangling import untangle_head
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from pipeline.part_labels.codes import Part
from rig.mesh import face_normals, vertex_normals
from rig.progress import Progress, discard_progress

MAX_TURN = 0.0  # cosine between a triangle before and after; a right angle is a fold
MIN_AREA = 0.02  # of the triangle's own, before
SWEEPS, RINGS = 60, 6  # of smoothing, and how far about a fold it may reach
GIVING_WAY = 0.8  # what a sweep leaves of a displacement, in the second half of them
COARSE_LENGTH_MM = 12.0  # over which a displacement of the nodes fades where nothing is seen
LENGTH_MM = 5.0  # the same of the displacement along the normals that follows it
MIN_AMPLITUDE_MM = 0.7  # standard deviation of a displacement where the fit claims to be better
COARSE_CELL_MM = 2.5  # the same for the nodes, whose edges are 4 mm long
FLOOR_MM = 0.05  # error of a point that its deviation does not show
COARSE_FLOOR_MM = 0.3  # the same for the nodes: relief that edges of 4 mm cannot follow
COMMON_MM = 0.1  # error that all points share, however far apart: cameras, shading
SHARED_ERROR = 0.25  # share of a point's deviation that points beyond it share: means over 16 mm are 0.2 to 1 of it off
MIN_OBSERVED_SHARE = 0.2  # of the face's vertices that the dense surface must show, or it is of no use
DRAWS = 24  # of the posterior: its deviation is known to a seventh
SEED = 16

COARSE = (Round(5.0, 10.0, 0.5, 3.0), Round(4.0, 7.0, 0.6, 2.0), Round(3.0, 5.0, 0.7, 1.0))
FINE = Round(2.0, 2.5, 0.7, 0.5)
PATCH_ROUNDS_MM = (1.0, 0.5)  # robust scale of each round that measures the current head by the photographs


@dataclass(frozen=True, slots=True, eq=False)
class DeformedSurface:
    """Holds the deformed head (world frame, mm), the standard deviation of each vertex, a mask of vertices with a
    measured point of skin, and how far the eyes are closed."""

    vertices: Vertices
    deviation_mm: PerVertex  # along the normal
    observed: Bool[np.ndarray, " v"]  # at a triangle that a point of skin showed
    closed_eyes: frozenset[str] = frozenset()  # of ``right`` and ``left``
    lids: Mapping[str, float] = field(default_factory=dict)  # how far each eye is closed, where the model blinks


@traced
def refine_to_surface(
    fit: Fit,
    model: HeadModel,
    surface: SurfacePoints,
    *,
    eigenheads: int,
    deviation_mm: PerVertex,
    eyes: Mapping[str, EyeEvidence] | None = None,
    patches: PatchSearch | None = None,
    outlines: OutlineSearch | None = None,
    report: Progress = discard_progress,
) -> DeformedSurface:
    """Deforms the fitted head to the measured surface.

    Args:
        fit: with its covariance.
        model: with the modes that the fit has.
        surface: the measured surface points, world frame.
        eigenheads: how many of the modes are eigenheads; the others are smooth deformations along the normals, or
            expressions.
        deviation_mm: standard deviation of every vertex in the fit (``vertex_deviation_mm``).
        eyes: appearance of the eyes (``measure_eye_appearance``); None keeps the lids as the model has them.
        patches: measures the deformed head once more with the photographs; None skips this step.
        outlines: compares the deformed head with the silhouettes; None skips this step.
        report: called with the share that is done.

    Returns:
        The deformed head, without degenerate triangles (``untangling``), and the state of the eyes.
    """
    faces = model.levels["full"].faces
    fitted = fit.world_from_head.apply(model.vertices(fit.coefficients))
    shape = plain_shape(fit, model, eigenheads)
    base = replace_lids(fitted, shape, model)
    lids, unexplained = estimate_eyelid_closure(fit, model, base, surface, eyes or {})
    closed = frozenset(side for side, eye in (eyes or {}).items() if eye.closed and lids.get(side, 1.0) == 1.0)
    blink = blink_shift(fit, model, lids)
    base = unfold(shape + blink, base + blink, faces)
    base = bridge_eyelids(base, model, closed.difference(lids) | unexplained)
    surface = thin(surface, CELL_MM)  # a million points of depth maps, a fiftieth of that in cells
    base = move_ears(base, model, thin(surface, COARSE_CELL_MM))
    regions = head_regions(model)
    head = deform_to_points(
        base,
        deviation_mm,
        faces,
        solving_nodes(model),
        surface,
        loose=regions["ears"] | regions["neck"],
        measure_patches=patches and patches.measure,
        outlines=outlines and outlines.observe,
        report=report,
    )
    clean, clean_deviation_mm = untangle_head(model, head.vertices, head.deviation_mm)
    observed = head.observed & (clean_deviation_mm < 2.0 * head.deviation_mm)  # what was moved farther is not as seen
    return DeformedSurface(clean.vertices, clean_deviation_mm, observed, closed | unexplained, lids)


def deform_to_points(
    vertices: Vertices,
    deviation_mm: PerVertex,
    faces: Faces,
    nodes: Nodes,
    surface: SurfacePoints,
    *,
    loose: Bool[np.ndarray, " v"],
    measure_patches: Callable[[Vertices], PatchMeasurements] | None = None,
    outlines: Outlines | None = None,
    shared_error: float = SHARED_ERROR,
    report: Progress = discard_progress,
) -> DeformedSurface:
    """Deforms a mesh to the measured points near it.

    Args:
        vertices: of the mesh, mm.
        deviation_mm: prior standard deviation of the vertices along their normals.
        faces: the mesh's triangles.
        nodes: the meshes on which the displacement is solved.
        surface: the points, in the same frame.
        loose: vertices that may move farther than the others.
        measure_patches: measures the surface once more with the photographs; None skips this step.
        outlines: compares the surface with silhouettes; None skips this step.
        shared_error: the fraction of the points' standard deviation that is an error common to all of them.
        report: called with the share that is done.

    Returns:
        The displaced vertices; vertices far from all points are unchanged.
    """
    amplitude = np.maximum(deviation_mm, MIN_AMPLITUDE_MM)
    informative = (surface.part != Part.UNSEEN) & np.isfinite(surface.deviation_mm)
    fine_points = thin(surface.chosen(informative), CELL_MM)
    coarse_points = thin(fine_points, COARSE_CELL_MM)
    current = _coarsely_deformed(
        vertices, amplitude, faces, nodes.coarse, coarse_points, loose=loose, outlines=outlines, report=report
    )
    base = current = unfold(vertices, current, faces)
    normals = vertex_normals(base, faces)
    field = smooth_field(nodes.fine.shape @ base, nodes.fine.faces, LENGTH_MM)
    directions = normal_directions(nodes.fine, nodes.fine.shape @ amplitude, normals)
    report("fine", len(COARSE) / (len(COARSE) + 1))
    dense = observe(base, current, faces, fine_points, loose, limits=FINE, floor_mm=FLOOR_MM)
    posterior = solve_field(field, directions, add_outlines(dense.observed, outlines, base, current, FINE.robust_mm))
    current = base + directions.moved(posterior.mean)
    for robust_mm in PATCH_ROUNDS_MM:
        if measure_patches is None:
            break
        combined = add_patches(dense.observed, measure_patches(current), base, current, faces, robust_mm)
        posterior = solve_field(field, directions, add_outlines(combined, outlines, base, current, robust_mm))
        current = base + directions.moved(posterior.mean)
    seen = np.zeros(len(vertices), bool)
    seen[dense.corner] = True
    common_mm = np.hypot(COMMON_MM, shared_error * typical_deviation(dense, faces, len(vertices)))
    deviation = field_deviation(posterior, base, normals, amplitude, seen, common_mm=common_mm)
    return DeformedSurface(unfold(base, current, faces), deviation, seen)


def _coarsely_deformed(
    vertices: Vertices,
    amplitude: PerVertex,
    faces: Faces,
    nodes: NodeMesh,
    coarse_points: SurfacePoints,
    *,
    loose: Bool[np.ndarray, " v"],
    outlines: Outlines | None,
    report: Progress,
) -> Vertices:
    """Returns the vertices after the coarse rounds, which move control points freely in three dimensions."""
    current = vertices
    field = smooth_field(nodes.shape @ vertices, nodes.faces, COARSE_LENGTH_MM)
    directions = free_directions(nodes, nodes.shape @ amplitude)
    for i, limits in enumerate(COARSE):
        report("fine", i / (len(COARSE) + 1))
        dense = observe(vertices, current, faces, coarse_points, loose, limits=limits, floor_mm=COARSE_FLOOR_MM)
        combined = add_outlines(dense.observed, outlines, vertices, current, limits.robust_mm)
        current = vertices + directions.moved(solve_field(field, directions, combined).mean)
    return current


def add_outlines(
    observed: Observed, outlines: Outlines | None, base: Vertices, current: Vertices, robust_mm: float
) -> Observed:
    """Adds the observations from the outlines, if there are any, to the observations from points."""
    return observed if outlines is None else observed.joined(outlines(base, current, robust_mm))


def field_deviation(
    posterior: Posterior,
    base: Vertices,
    normals: Vertices,
    deviation_mm: PerVertex,
    observed: Bool[np.ndarray, " v"],
    *,
    common_mm: PerVertex,
) -> PerVertex:
    """Returns the standard deviation (mm) of every vertex along its normal. Near measured points the deviation comes
    from random draws of the posterior and from ``common_mm``, the error common to all points; elsewhere it is at least
    ``deviation_mm``."""
    draws = posterior.draws(np.random.default_rng(SEED), DRAWS)
    square = common_mm**2
    for k in range(DRAWS):
        square += (posterior.directions.moved(draws[:, k]) * normals).sum(axis=1) ** 2 / DRAWS
    if not observed.any():
        return deviation_mm
    distance, _ = nearest(PointTree.of(base[observed]), base, within=6.0 * LENGTH_MM)
    near = np.exp(-0.5 * (np.where(np.isfinite(distance), distance, np.inf) / LENGTH_MM) ** 2)
    return np.sqrt(near * square + (1.0 - near) * np.maximum(square, deviation_mm**2))


def is_folded(before: Vertices, after: Vertices, faces: Faces) -> Bool[np.ndarray, " f"]:
    """Returns a mask of the triangles that a displacement flips or makes almost degenerate."""
    old, new = face_normals(before, faces), face_normals(after, faces)
    size, length = np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)
    return ((old * new).sum(axis=1) <= MAX_TURN * size * length) | (length < MIN_AREA * size)


def unfold(before: Vertices, after: Vertices, faces: Faces) -> Vertices:
    """Removes folds from the displaced vertices ``after``. Around each fold the displacement from ``before`` is
    smoothed until no triangle is flipped. In the second half of the sweeps the displacement is also reduced."""
    bad = faces[is_folded(before, after, faces)]
    if not len(bad):
        return after
    local = _around(bad, faces, len(before), RINGS)
    rows = np.unique(local)  # everything below happens among these
    place = np.zeros(len(before), int)
    place[rows] = np.arange(len(rows))
    bad, local, old = place[bad], place[local], before[rows]
    moved, mean = after[rows] - old, _neighbour_mean(local, len(rows))
    for sweep in range(SWEEPS):
        give = np.unique(_around(bad, local, len(rows), 1))
        moved[give] = (1.0 if sweep < SWEEPS // 2 else GIVING_WAY) * (mean[give] @ moved)
        bad = local[is_folded(old, old + moved, local)]
        if not len(bad):
            break
    out = after.copy()
    out[rows] = old + moved
    return out


def _around(chosen: Int[np.ndarray, "b 3"], faces: Faces, count: int, rings: int) -> Int[np.ndarray, "g 3"]:
    """Returns the faces within ``rings`` rings around the chosen faces, with these."""
    about = np.zeros(count, bool)
    about[chosen] = True
    for _ in range(rings - 1):
        about[faces[about[faces].any(axis=1)]] = True
    return faces[about[faces].any(axis=1)]


def _neighbour_mean(faces: Faces, count: int) -> sparse.csr_array:
    """Returns the matrix that averages vertex values over the corners of the faces around each vertex."""
    rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel()
    share = 1.0 / np.maximum(np.bincount(rows, minlength=count), 1)
    return sparse.csr_array((share[rows], (rows, columns)), shape=(count, count))
