"""Estimates from the measured surface how far the eyelids are closed.

The photometric fit uses patches of a few millimetres, which cannot follow a lid, so it leaves lids open. The colours
between the lids (``eyelids``) mislead for eyes whose white is hidden. Therefore a few weights of the blink expression
are tested for each eye, and the weight with the smallest robust distance between lids and surface points is chosen.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.contour_fit.fit import Fit
from pipeline.detail.association import Target
from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.eyelids import EyeEvidence, Fissure, eye_fissure
from pipeline.head_model.expressions import BLINKS, plain_name
from pipeline.head_model.model import HeadModel
from pipeline.part_labels.codes import Part
from rig.mesh import vertex_normals

Vertices = Float[np.ndarray, "v 3"]

HALF, OTHERS = 0.5, (0.25, 0.75, 1.0)
NEAR = 0.6  # of the fissure's length: points about the eye
REACH_MM, AGREEMENT, ROBUST_MM = 6.0, 0.3, 0.3
MIN_POINTS = 200
GAIN = 0.97  # of the misfit of open lids that half closed ones must stay under: 0.89 and 0.94 of closed ones, 1.03 and
# more of open ones
SHUT = 0.5  # lids that far down over an eye that shows nothing are closed ...
OPEN = 1.25  # ... and so are others, unless half closed ones fit that much worse: 1.03 and 1.16 on a real scan, whose
# lids are closed another way than the model's; 1.32 to 1.86 on open eyes of the studio


def blinks_of(model: HeadModel) -> dict[str, int]:
    """Returns, for each eye (``right``, ``left``), the index of its blink coefficient in the fit. Eyes for which the
    model has no blink expression are left out."""
    found: dict[str, int] = {}
    for name, place in zip(model.expressions.names, model.posed, strict=False):
        if plain_name(name) in BLINKS:
            found.setdefault(BLINKS[plain_name(name)], place)
    return found


def estimate_eyelid_closure(
    fit: Fit, model: HeadModel, base: Vertices, surface: SurfacePoints, eyes: Mapping[str, EyeEvidence]
) -> tuple[dict[str, float], frozenset[str]]:
    """Estimates how far each eye is closed (0 open, 1 closed), if the model has a blink for it. The function also
    returns eyes that look closed although no blink brings the lids nearer to the points; their lids must be bridged.

    Args:
        fit: the head fitted to the photographs.
        model: with the modes that the fit has.
        base: the fitted head with smooth lids (``replace_lids``), full mesh, world frame, mm.
        surface: the measured surface points, world frame.
        eyes: appearance of the eyes in the photographs. An eye that shows neither white nor iris counts as closed
            unless the points contradict it.
    """
    found, unexplained = {}, set[str]()
    for side, place in blinks_of(model).items():
        fitted, moved = float(fit.coefficients[place]), _moved(fit, model, place)
        share, half = _nearest_closure(base - fitted * moved, moved, fitted, model, surface, eye_fissure(model, side))
        shown = eyes.get(side)
        shut = shown is not None and shown.closed
        found[side] = 1.0 if shut and share >= SHUT else share
        if shown is not None and shown.is_surely_open:
            found[side] = min(share, HALF)
        if shown is not None and shut and share < SHUT and (half < OPEN or shown.is_surely_closed):
            unexplained.add(side)
    return found, frozenset(unexplained)


def blink_shift(fit: Fit, model: HeadModel, lids: Mapping[str, float]) -> Vertices:
    """Returns the displacement (full mesh, world frame, mm) that changes each eye from the fit's blink weight to the
    weight in ``lids``."""
    shift, places = np.zeros((model.levels["full"].count, 3)), blinks_of(model)
    for side, share in lids.items():
        if (more := share - float(fit.coefficients[places[side]])) != 0.0:
            shift += more * _moved(fit, model, places[side])
    return shift


def _moved(fit: Fit, model: HeadModel, place: int) -> Vertices:
    """Returns the displacement of every vertex (full mesh, world frame, mm) by the mode ``place`` at weight 1."""
    moved = model.levels["full"].operator @ model.modes[place].astype(float)
    return fit.world_from_head.scale * moved @ fit.world_from_head.rotation.T


def with_lids(fit: Fit, model: HeadModel, lids: Mapping[str, float]) -> Fit:
    """Returns the fit with the blink weight of each eye set to the value in ``lids`` (0 open, 1 closed)."""
    coefficients, places = fit.coefficients.copy(), blinks_of(model)
    for side, share in lids.items():
        coefficients[places[side]] = share
    return replace(fit, coefficients=coefficients)


def plain_shape(fit: Fit, model: HeadModel, eigenheads: int) -> Vertices:
    """Returns the fitted head (full mesh, world frame, mm) with eigenheads and expressions only: the coefficients of
    all other modes are set to 0."""
    plain = fit.coefficients.copy()
    plain[np.setdiff1d(np.arange(eigenheads, len(plain)), model.posed)] = 0.0
    return fit.world_from_head.apply(model.vertices(plain))


def _nearest_closure(
    open_lids: Vertices, moved: Vertices, fitted: float, model: HeadModel, surface: SurfacePoints, slit: Fissure
) -> tuple[float, float]:
    """Returns the blink weight with the smallest distance between lids and points, or ``fitted`` if no weight is
    better. The function also returns the misfit of half-closed lids divided by the misfit of open lids. Without enough
    points near the lids the function returns ``fitted`` and 1.

    ``moved`` is the displacement (mm) of the lids by a full blink.
    """
    middle = open_lids[slit.ellipse(0.5 * slit.length_mm, 0.4 * slit.length_mm)].mean(axis=0)
    off = np.linalg.norm(surface.points - middle, axis=1)
    about = surface.chosen((off < NEAR * slit.length_mm) & (surface.part != Part.UNSEEN))
    if len(about.points) < MIN_POINTS:
        return fitted, 1.0
    near, faces = _patch(open_lids, model, middle, NEAR * slit.length_mm + REACH_MM)
    still = _misfit(open_lids[near], faces, about)
    misfits = {HALF: _misfit((open_lids + HALF * moved)[near], faces, about)}
    half = misfits[HALF] / max(still, 1e-9)
    if half >= GAIN:  # lids that are down at all are nearer half way
        return fitted, half
    misfits |= {weight: _misfit((open_lids + weight * moved)[near], faces, about) for weight in OTHERS}
    return min(misfits, key=lambda weight: misfits[weight]), half


def _patch(
    vertices: Vertices, model: HeadModel, middle: Float[np.ndarray, " 3"], radius_mm: float
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, "f 3"]]:
    """Returns the vertices within ``radius_mm`` of an eye's middle, and the triangles between them, numbered within
    this patch."""
    inside = np.linalg.norm(vertices - middle, axis=1) < radius_mm
    faces = model.levels["full"].faces
    places = np.cumsum(inside, dtype=np.int32) - np.int32(1)
    found = places[faces[inside[faces].all(axis=1)]]
    found.setflags(write=False)  # as the head's own faces are: loops are compiled for those
    return np.flatnonzero(inside), found


def _misfit(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], points: SurfacePoints) -> float:
    """Returns the mean of Geman and McClure's loss (0 to 1) over the points' distances to the mesh. The distance of a
    point too far from the mesh counts as 1."""
    target = Target.of(vertices, vertex_normals(vertices, faces), faces)
    found = target.closest(points.points, points.normals, reach_mm=REACH_MM, least_agreement=AGREEMENT)
    loss = np.ones(len(points.points))
    loss[found.row] = found.distance_mm**2 / (found.distance_mm**2 + ROBUST_MM**2)
    return float(loss.mean())
