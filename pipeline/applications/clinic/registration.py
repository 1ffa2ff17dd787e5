"""Registers a head to the surface of the same person's CT or CBCT: a mesh in mm in LPS or RAS axes that may contain
skull and airways.

The motion is rigid: photographs and CT both measure in millimetres, and a scale would hide errors that should be
visible. If the CT surface has landmarks, the search starts from them. Without landmarks the search starts from the head
in the Frankfurt plane, rotated by up to ``TURNS_DEG``, with the face at many places of the surface, because patients
lie in a scanner upright within some tens of degrees. From the best starts, a trimmed robust fit of the face is
computed. The result is the fit with the largest part of the face on the CT surface. Parts outside the face may differ:
soft tissue on another day, a chin rest, a field of view that ends at the forehead, surfaces of skull and airways.

Only the fraction ``share`` of the matched points, the nearest ones, enters the fit (trimmed ICP, Chetverikov et al.
2002), and Tukey's biweight removes outliers among them. Points are not matched with a surface that faces the other way,
such as airways and skull below the skin."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from pipeline.applications.clinic.anatomical_frame import frankfurt_axes
from pipeline.applications.clinic.visit import Visit
from pipeline.applications.model_building.correspondence.scans import read_landmarks, weld_scan
from pipeline.applications.verification.reference import Reference
from pipeline.geometry.registration.rigid import (
    ROUNDS,
    Counterparts,
    draw_rows,
    draw_surface_points,
    fit_motion,
    motion_columns,
    search_motions,
)
from pipeline.geometry.surface_index import Hits, SurfaceIndex
from pipeline.head_model.landmarks import stacked
from rig.errors import InputError
from rig.formats.meshes.markups import AXES, Axes
from rig.formats.meshes.mesh_file import SURFACE_ENDINGS, read_mesh
from rig.geometry import RigidTransform, Similarity, rigid_fit
from rig.messages.message import compose

PerPoint = Float[np.ndarray, " n"]
PointFlags = Bool[np.ndarray, " n"]

TUKEY = 4.685  # standard deviations at which a point no longer counts: 95 % efficient with normal errors
MIN_STD_MM = 0.01
MAX_REACH_MM, MIN_REACH_MM = 20.0, 2.0  # of matches, in the first and in the last step
FACING = 0.5  # least cosine between matched normals
FACING_MM = 10.0
STEPS = 60
STILL_MM = 1e-5
CORRELATED_MM = 5.0  # radius within which errors of a dense surface go together: the matcher's windows
MIN_POINTS = 60
TURNS_DEG = {"x": (-25.0, 0.0, 25.0), "z": (-30.0, 0.0, 30.0)}  # nodding and turning; tilts are found by the way
PLACES = 12  # of the surface's parts that look forward, at which the face may begin
FORWARD = 0.2  # cosine to the front from which a surface looks forward
SHARE = 0.8  # of the face with a counterpart that must agree
POINTS = 2500
FEW = 600  # of these, to compare starts
STARTS = 5
MIN_MARKS = 3
MIN_KEPT = 0.3  # share of the face, below which it is not this head
NOT_THIS_MM = 2.0
SAME_MM = 1.0  # distance within which a point supports a start
HEADER_BYTES = 4096  # in which SPACE stands: a comment of a PLY or OBJ, the 80 bytes of an STL


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Holds points (mm) of a head with their unit normals and the areas (mm2) that they represent."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    areas: PerPoint


@dataclass(frozen=True, slots=True, eq=False)
class TrimmedFit:
    """Holds the rigid motion of a patch onto a surface, with residuals and covariance.

    ``residual_mm`` is each point's signed distance along the surface's normal, NaN without a match; ``weights``
    are 0 for outliers. ``covariance`` (6 x 6: rotation about ``centre`` in rad, shift in mm) follows from the scatter;
    the number of independent errors is the number of patches of ``CORRELATED_MM`` in the area.
    """

    motion: RigidTransform
    residual_mm: PerPoint
    weights: PerPoint
    std_mm: float
    centre: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "6 6"]

    @property
    def kept_share(self) -> float:
        """Returns the fraction of the points that have a positive weight."""
        return float(np.mean(self.weights > 0.0))

    def std_along(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> PerPoint:
        """Returns the standard deviation (mm) with which the motion's error displaces surface points along normals."""
        jacobian = motion_columns(points - self.centre, normals)
        return np.sqrt(np.einsum("np,pq,nq->n", jacobian, self.covariance, jacobian))


def trimmed_fit(
    patch: Patch, surface: SurfaceIndex, start: RigidTransform, *, share: float, beside: Callable[[Hits], PointFlags]
) -> TrimmedFit | None:
    """Returns the motion that fits a patch to a surface; None if fewer than ``MIN_POINTS`` points have a match on the
    surface.

    Args:
        patch: points of the head, in any frame.
        surface: the surface to which the patch is fitted.
        start: the starting motion.
        share: the fraction of the matched points, the nearest ones, that get a weight.
        beside: returns which closest points lie on an open edge of the surface.
    """
    reached = MAX_REACH_MM

    def meet(motion: Similarity, there: Float[np.ndarray, "n 3"], reach: float) -> Counterparts | None:
        nonlocal reached
        met = _met(patch, surface, motion, there, reach, share=share, beside=beside)
        if met is None:
            return None
        reached = max(0.7 * reach, MIN_REACH_MM, TUKEY * met.std_mm)
        return Counterparts(met.hits.normals, -met.residual, met.weights * patch.areas, reached)

    found = fit_motion(
        patch.points, meet, Similarity.from_rigid(start), reach_mm=MAX_REACH_MM, steps=STEPS, still_mm=STILL_MM
    )
    if found is None:
        return None
    there = found.apply(patch.points)
    met = _met(patch, surface, found, there, reached, share=share, beside=beside)
    if met is None:
        return None
    centre = np.average(there, axis=0, weights=met.weights * patch.areas)
    jacobian = motion_columns(there - centre, met.hits.normals)
    independent = met.weights * patch.areas / (np.pi * CORRELATED_MM**2)
    information = np.einsum("np,n,nq->pq", jacobian, independent, jacobian)
    covariance = met.std_mm**2 * np.linalg.pinv(information, hermitian=True)
    residual = np.where(met.valid, met.residual, np.nan)
    return TrimmedFit(
        RigidTransform(found.rotation, found.translation), residual, met.weights, met.std_mm, centre, covariance
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Met:
    """Holds each point's closest surface point, whether this is a valid match, the signed distance along the surface's
    normal (positive if the point lies outside), the weight, and the standard deviation of the weighted points."""

    hits: Hits
    valid: PointFlags
    residual: PerPoint
    weights: PerPoint
    std_mm: float


def _met(
    patch: Patch,
    surface: SurfaceIndex,
    motion: Similarity,
    there: Float[np.ndarray, "n 3"],
    reach: float,
    *,
    share: float,
    beside: Callable[[Hits], PointFlags],
) -> _Met | None:
    """Returns the closest surface points of the moved patch; None if fewer than ``MIN_POINTS`` are valid matches."""
    normals = patch.normals @ motion.rotation.T
    hits = surface.closest(there, facing=normals, facing_mm=FACING_MM)
    alike = np.einsum("nx,nx->n", normals, hits.normals) > FACING
    valid = (hits.distances < reach) & alike & ~beside(hits)
    if valid.sum() < MIN_POINTS:
        return None
    residual = np.einsum("nx,nx->n", there - hits.points, hits.normals)
    return _Met(hits, valid, residual, *_weights(residual, valid, share))


def _weights(residual: PerPoint, valid: PointFlags, share: float) -> tuple[PerPoint, float]:
    """Returns a weight for each point, and the standard deviation (mm) of the points with a positive weight."""
    away = np.abs(residual)
    kept = valid & (away <= np.quantile(away[valid], share))
    normal = float(ndtri(0.5 + share / 4.0))  # where the middle of the nearest share of normal errors lies
    std = max(float(np.median(away[kept])) / normal, MIN_STD_MM)
    weights = np.where(kept, np.maximum(1.0 - (away / (TUKEY * std)) ** 2, 0.0) ** 2, 0.0)
    return weights, std


@dataclass(frozen=True, slots=True, eq=False)
class PatientSurface:
    """Holds a CT surface and the axes of its coordinates. ``stated`` is whether the surface's file states its axes."""

    reference: Reference
    axes: Axes
    stated: bool


def read_surface(path: Path, axes: Axes | None = None) -> PatientSurface:
    """Reads a CT surface from a .ply, .obj, .glb or .stl file. The CT axes are ``axes`` or, without them, those in the
    file's header (``SPACE=RAS``, as 3D Slicer writes it), else LPS. Raises InputError that lists every fault."""
    mesh, _ = weld_scan(read_mesh(path, SURFACE_ENDINGS))
    data = path.read_bytes()
    found: Axes | None = next((stated for stated in AXES if f"SPACE={stated}".encode() in data[:HEADER_BYTES]), None)
    reference = Reference.of(mesh, {}, path.name, hashlib.sha256(data).hexdigest())
    return PatientSurface(reference, axes or found or "LPS", axes is None and found is not None)


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Holds the rigid motion of a head onto a CT surface. ``distance_mm`` is each vertex's signed distance (positive
    outside the CT surface), NaN without a match; ``start`` is "landmarks" or "frankfurt"."""

    visit: Visit
    surface: PatientSurface
    start: str
    fit: TrimmedFit
    distance_mm: Float[np.ndarray, " v"]

    def figures(self) -> dict[str, float]:
        """Returns statistics of the distances (mm) between head and CT surface that remain on the face."""
        face = self.visit.measured.regions["face"]
        known = face & np.isfinite(self.distance_mm)
        away, areas = np.abs(self.distance_mm[known]), self.visit.measured.areas
        return {
            "covered_share": float(areas[known].sum() / areas[face].sum()),
            "kept_share": self.fit.kept_share,
            "kept_std_mm": self.fit.std_mm,
            "median_mm": float(np.median(away)),
            "rms_mm": float(np.sqrt(np.average(away**2, weights=areas[known]))),
            "p95_mm": float(np.quantile(away, 0.95)),
        }


def register(
    visit: Visit, surface: PatientSurface, landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None
) -> Registration:
    """Finds the rigid motion of a head onto a CT surface. Raises InputError if the surface is not that of the same
    head.

    Args:
        visit: the head.
        surface: the CT surface of the patient.
        landmarks: three or more of the 26 landmarks on the surface (its frame, mm), or None.
    """
    measured = visit.measured
    rng = np.random.default_rng(0)
    face = measured.regions["face"] & ~measured.regions["eyes"]
    rows = np.flatnonzero(face & (visit.views > 0) if (face & (visit.views > 0)).any() else face)
    rows = rows[draw_rows(measured.areas[rows], POINTS, rng)]
    normals = measured.mesh_world.normals()
    patch = Patch(measured.mesh_world.vertices[rows], normals[rows], measured.areas[rows])
    names = [name for name in landmarks or {} if name in measured.landmarks]
    if landmarks and len(names) >= MIN_MARKS:
        start, starts = "landmarks", [rigid_fit(stacked(measured.landmarks, names), stacked(landmarks, names))]
    else:
        start, starts = "frankfurt", _searched(visit, surface, patch, rng)
    best = _best(patch, surface, starts)
    if best is None or best.kept_share < MIN_KEPT or best.std_mm > NOT_THIS_MM:
        off = float("inf") if best is None else best.std_mm
        raise InputError(surface.reference.name, [compose("surface-not-this-head", head=measured.name, off_mm=off)])
    distance = _distances(visit, surface, best.motion, normals)
    return Registration(visit, surface, start, best, distance)


def _searched(visit: Visit, surface: PatientSurface, patch: Patch, rng: np.random.Generator) -> list[RigidTransform]:
    """Returns starting motions: the head in the Frankfurt plane, slightly rotated, with its face on parts of the CT
    surface that face forward."""
    upright = frankfurt_axes(visit.measured, surface.axes).patient_from_world
    forward = np.array([0.0, -1.0 if surface.axes == "LPS" else 1.0, 0.0])
    angles = [(nod, turn) for nod in TURNS_DEG["x"] for turn in TURNS_DEG["z"]]
    turns = Rotation.from_euler("xz", angles, degrees=True).as_matrix()
    points, facing = draw_surface_points(surface.reference.index, rng)
    ahead = points[facing @ forward > FORWARD]
    ahead = points if len(ahead) < 10 * PLACES else ahead
    places = np.asarray(kmeans2(ahead, PLACES, minit="++", rng=rng)[0])
    some = slice(0, ROUNDS[-1].points)
    there = upright.apply(patch.points[some])
    found = search_motions(
        there, patch.normals[some] @ upright.rotation.T, points, facing, turns=turns, places=places
    )  # fmt: skip
    return [RigidTransform(motion.rotation, motion.translation) @ upright for motion in found]


def _best(patch: Patch, surface: PatientSurface, starts: list[RigidTransform]) -> TrimmedFit | None:
    """Returns the fit with the largest part of the face on the CT surface."""
    reference = surface.reference
    few = Patch(patch.points[:FEW], patch.normals[:FEW], patch.areas[:FEW])
    if len(starts) > 1:
        tried = [
            trimmed_fit(few, reference.index, start, share=SHARE, beside=reference.beside) for start in starts[:STARTS]
        ]
        fits = [fit for fit in tried if fit is not None]
        if not fits:
            return None
        starts = [
            max(fits, key=lambda fit: np.mean(np.abs(np.nan_to_num(fit.residual_mm, nan=np.inf)) < SAME_MM)).motion
        ]
    return trimmed_fit(patch, reference.index, starts[0], share=SHARE, beside=reference.beside)


def _distances(
    visit: Visit, surface: PatientSurface, motion: RigidTransform, normals: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, " v"]:
    """Returns the signed distance of every vertex to the CT surface, NaN where the surface lacks that part."""
    there, facing = motion.apply(visit.measured.mesh_world.vertices), normals @ motion.rotation.T
    hits = surface.reference.index.closest(there, facing=facing)
    alike: Bool[np.ndarray, " v"] = np.einsum("nx,nx->n", facing, hits.normals) > 0.3
    known = (hits.distances < 10.0) & alike & ~surface.reference.beside(hits)
    side = np.einsum("nx,nx->n", there - hits.points, hits.normals)
    return np.where(known, np.copysign(hits.distances, side), np.nan)


def read_surface_landmarks(path: Path, axes: Axes) -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns landmarks by this project's names, in the CT surface's axes. A .mrk.json file states its own axes; other
    files use the surface's axes. Raises InputError, also if fewer than ``MIN_MARKS`` names are known."""
    known = read_landmarks(path, axes)
    if len(known) < MIN_MARKS:
        raise InputError(path.name, [compose("marks-too-few", found=len(known), needed=MIN_MARKS)])
    return known
