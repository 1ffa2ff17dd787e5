"""Aligns a measured head to its reference scan by the rigid motion that minimises the squared distances to the surface.

The reference scan may be in any frame. The motion starts from landmarks if head and scan both have them. Without known
landmarks many starts are tried: rotations in all directions, with the head's centre at the centres of parts of the
scan. The start with the best fit of the face is chosen. Gauss-Newton steps on the distances along the reference's
normals over the face, weighted by area, refine the motion (``pipeline.geometry.registration``). The module computes the
best fit of the standard VDI/VDE 2634, which does not correct size. The size error is then estimated by the same steps
with a scale, and only reported."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

from pipeline.applications.verification.measured import Measured
from pipeline.applications.verification.reference import Reference
from pipeline.geometry.registration.rigid import (
    ROUNDS,
    Counterparts,
    draw_rows,
    draw_surface_points,
    fit_motion,
    search_motions,
)
from pipeline.geometry.surface_index import Hits
from pipeline.head_model.landmarks import stacked
from rig.errors import InputError
from rig.geometry import RigidTransform, Similarity, rigid_fit

FAR_MM = 10.0  # from the reference: farther points have no match on it
POINTS = 2000  # of the face, for the fit: six numbers need no more
PARTS = 4  # of the scan: shoulders or a stand move its middle away from the head's
FEW = 300  # of these points, to compare starts
MIN_MARKS = 3
MIN_COVERED = 0.3  # share of the face that must not lie at the scan's rim
MIN_POINTS = 42  # with a counterpart: six to each unknown of a similarity
STEPS = 30
STILL_MM = 3e-4  # a step whose points move by less is the last
NOT_THIS_MM = 5.0  # RMS over the face after the best fit: beyond any fault of a rig, and near any two heads' difference


@dataclass(frozen=True, slots=True, eq=False)
class BestFit:
    """Holds the rigid motion that aligns a head to its reference.

    ``start`` is "landmarks" or "search". ``rms_mm`` is the RMS distance after the rigid motion, over the ``points``
    that have a match on the reference. ``scale`` is the size of the measured head relative to the reference, 1 if
    correct.
    """

    reference_from_world: RigidTransform
    start: str
    rms_mm: float
    points: int
    scale: float


def align_face(measured: Measured, reference: Reference) -> BestFit:
    """Finds the rigid motion that aligns the face of a measured head to the reference. Raises InputError if the
    reference is not a scan of this head."""
    face = measured.regions["face"]
    rng = np.random.default_rng(0)
    count = min(POINTS, int(face.sum()))
    picked = rng.choice(np.flatnonzero(face), count, replace=False)
    points, weights = measured.mesh_world.vertices[picked], measured.areas[picked]
    marks = [name for name in reference.landmarks if name in measured.landmarks]
    if len(marks) >= MIN_MARKS:
        start = "landmarks"
        motion = rigid_fit(stacked(measured.landmarks, marks), stacked(reference.landmarks, marks))
        starts = [Similarity.from_rigid(motion)]
    else:
        start, starts = "search", _searched(measured, reference, rng)
    if len(starts) > 1:
        tried = [_refined(points[:FEW], weights[:FEW], reference, motion, free_scale=False) for motion in starts]
        starts = [min(tried, key=lambda fit: fit[1])[0]]
    place, rms, used = _refined(points, weights, reference, starts[0], free_scale=False)
    if rms > NOT_THIS_MM:
        raise InputError(reference.name, [f"is no scan of the head in {measured.name}: after the best fit (from "
            f"{start}) the face is {rms:.1f} mm off. Is it this mannequin, in mm, and not mirrored?"])  # fmt: skip
    scaled, _, _ = _refined(points, weights, reference, place, free_scale=True)
    return BestFit(RigidTransform(place.rotation, place.translation), start, rms, used, 1.0 / scaled.scale)


def counted(hits: Hits, reference: Reference) -> Bool[np.ndarray, " n"]:
    """Returns a mask of the closest points that are valid matches: near enough, and not at an open edge of the scan."""
    return (hits.distances < FAR_MM) & ~reference.beside(hits)


def _refined(
    points: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"],
    reference: Reference,
    start: Similarity,
    *,
    free_scale: bool,
) -> tuple[Similarity, float, int]:
    """Refines a motion by Gauss-Newton steps. Returns the motion, the RMS distance (mm) and the number of matched
    points. Distant points have less weight in the first steps (Geman and McClure), and the same weight in the last.

    In the RMS, a point far from the scan counts as ``FAR_MM`` away, so that a fit to a small part of the scan is not
    chosen."""

    def meet(_: Similarity, there: Float[np.ndarray, "n 3"], reach: float) -> Counterparts | None:
        hits = reference.index.closest(there)
        used = (hits.distances < max(FAR_MM, reach)) & ~reference.beside(hits)
        if used.sum() < MIN_POINTS:
            return None
        robust = (1.0 + (hits.distances / reach) ** 2) ** -2 if reach > 1.0 else np.ones(len(points))
        ahead = ((hits.points - there) * hits.normals).sum(axis=1)
        return Counterparts(hits.normals, ahead, np.where(used, weights * robust, 0.0), max(0.5 * reach, 0.5))

    place = fit_motion(points, meet, start, reach_mm=2.0 * FAR_MM, steps=STEPS, still_mm=STILL_MM, scale=free_scale)
    if place is None:
        return start, np.inf, 0
    hits = reference.index.closest(place.apply(points))
    covered = ~reference.beside(hits)
    if covered.mean() < MIN_COVERED:
        return place, np.inf, 0
    off = np.minimum(hits.distances, FAR_MM)[covered]
    return place, float(np.sqrt(np.average(off**2, weights=weights[covered]))), int(counted(hits, reference).sum())


def _searched(measured: Measured, reference: Reference, rng: np.random.Generator) -> list[Similarity]:
    """Returns the best starting motions among all rotations: many are tried with few points and iterations, then the
    better ones with more."""
    head = np.flatnonzero(~measured.regions["neck"])
    chosen = head[draw_rows(measured.areas[head], ROUNDS[-1].points, rng)]
    surface, facing = draw_surface_points(reference.index, rng)
    parts = np.asarray(kmeans2(surface, PARTS, minit="++", rng=rng)[0])
    places = np.stack([surface.mean(axis=0), (surface.min(axis=0) + surface.max(axis=0)) / 2, *parts])
    turns = Rotation.create_group("I").as_matrix()  # no turn is farther than 45 degrees from one of the sixty
    points, normals = measured.mesh_world.vertices[chosen], measured.mesh_world.normals()[chosen]
    return search_motions(points, normals, surface, facing, turns=turns, places=places)
