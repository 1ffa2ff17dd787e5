"""Refines a fit to outlines with the photographs inside the outlines, by solving the contour solver's least-squares
problem again.

The input is a solved contour problem and the photographs. The output is the same problem, solved again with finer modes
and with observations of the surface. The search runs in three rounds, from coarse to fine. Each patch of the current
surface (``patches``) is moved along its normal, and its images are compared in the cameras that see it. The position
with the best correlation is an observation of the surface; the remaining image shifts between the views correct the
cameras (``depth_search``). Patches are left out if their best match is weak or at the end of the search range (hidden,
glossy, without texture), or if they show hair (``under_hair``). The observations are robust terms of the normal
equations, together with rims, feature points and priors (``surface_term``); where there are no observations, the prior
continues the surface smoothly."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.spatial import KDTree

from pipeline.compute.array_cache import cached_arrays
from pipeline.compute.trace import traced
from pipeline.contour_fit.contour import ContourSolution, run_stage
from pipeline.contour_fit.problem import PhotoEvidence, Stage, StageEvidence, State, SurfaceObservations, widen
from pipeline.contour_fit.surface_term import surface_residual
from pipeline.head_model.gaussian_process import with_fine_kernel
from pipeline.head_model.model import HeadModel
from pipeline.photometric_fit.depth_search import (
    CENTRE_MM,
    Round,
    head_depth_factor,
    head_of,
    moved_cameras,
    observe,
    pixels_per_mm,
    sample_visibility,
)
from pipeline.photometric_fit.images import fine_texture, load_photographs
from pipeline.photometric_fit.patches import HairProbability, Patches, arrays_of, make_patches, under_hair
from pipeline.warnings import Detail
from rig.mesh import vertex_normals
from rig.messages.message import compose

SAMPLE_MM = 1.0  # distance of samples on the surface: two pixels of the usual rig
MIN_SHARE = 0.15  # of the patches that must be found again in other views, or photographs are of no use
FINE_LENGTH_MM = 9.0  # of the kernel that photographs add in the face region ...
FINE_AMPLITUDE_MM = 0.5  # ... and its standard deviation
ROUNDS = (Round(3.0, 0.8, 4.0, 17, False), Round(2.5, 0.55, 2.0, 13, False), Round(2.0, 0.45, 1.0, 9))
RADIUS_WINDOWS = 2.0  # a patch ends at that many standard deviations of its widest window
LEVEL, STEPS = "p95", 3  # the rim needs no more there, and the surface term is the full level's anyway
MIN_VIEWS = 3
NEIGHBOURS, NEAR_MM = 24, 4.0  # patches about a vertex: two windows
HAIR_REACH_MM = 4.0  # patches are 3 mm apart
LOST_MM = 2.5  # assumed distance where no views match: the largest at which two photographs still match
MISFIT_FACTOR, MISFIT_LOCAL = 1.2, 0.6  # the latter is the share of a place's own misfit: its few patches know their
# variance badly, all of them together well. So 95 % intervals hold 91 to 98 % of a scan and four draws


@traced
def refine_with_photographs(
    solved: ContourSolution, images: Mapping[str, UInt8[np.ndarray, "h w 3"]], *, hair: HairProbability | None = None
) -> tuple[ContourSolution, Detail]:
    """Continues the contour solution with finer modes and with observations of the surface from photographs.

    Args:
        solved: the solution of the contour solver.
        images: sRGB photographs, by camera.
        hair: for each camera, the probability that a pixel shows hair; None takes everything inside the outline for
            skin.

    Returns:
        The refined solution, or ``solved`` if the photographs show too little; and the level of detail with the reason.
    """
    problem = solved.problem
    scale = pixels_per_mm(moved_cameras(problem, solved.state), solved.state.world_from_head.translation)
    photographs = load_photographs(images, problem.views)
    texture = fine_texture(photographs, problem.views, scale)
    speaking = int(np.count_nonzero(photographs.speaks))
    if speaking < MIN_VIEWS:
        why = compose("level-views-without-texture", speaking=speaking, all=len(problem.views.names), needed=MIN_VIEWS)
        return solved, Detail("kernel", why)
    model, patches, basis = finer(problem.model)
    problem = widen(problem, model, (LEVEL,))
    stage = Stage(LEVEL, len(model.modes), True, solved.stage.scales_px[-1:], solved.stage.whole_head, True, STEPS)
    state, evaluations, reason, share = solved.state, solved.evaluations, solved.termination_reason, 0.0
    evidence = solved.evidence
    centres = model.vertices(np.zeros(0))[patches.centre]
    lost, surface = np.zeros(0, int), None
    start = head_of(problem, state)
    cameras = [camera for camera, speaks in zip(problem.rig, photographs.speaks, strict=True) if speaks]
    for each in rounds_of_rig(head_depth_factor(start, patches.centre, cameras)):
        visibility = sample_visibility(problem, state, patches, photographs.speaks)
        seen = visibility.facing > 0
        hidden = under_hair(patches, hair or {}, problem.views.names, visibility.pixel, seen, centres)
        read = photographs if each.with_shading else texture
        surface, lost = observe(problem, state, read, patches, visibility, hidden, basis=basis, each=each)
        share = np.count_nonzero(~surface.bound) / max(len(patches.centre), 1)
        if share < MIN_SHARE:
            why = compose("level-alike-too-little", share=share, needed=MIN_SHARE)
            return solved, Detail("kernel", why)
        outline = {LEVEL: near_hair(model, patches.centre[hidden])}
        evidence = StageEvidence(solved.evidence.noise, PhotoEvidence(surface, outline))
        state, used, reason = run_stage(problem, evidence, state, stage, lambda fraction: None)
        evaluations += used
    assert surface is not None
    misfit = local_misfit_mm(model, surface, state, lost)
    why = compose("level-alike", share=share, photographs=speaking)
    return ContourSolution(problem, evidence, state, stage, evaluations, reason, misfit), Detail("photo", why)


def rounds_of_rig(factor: float) -> tuple[Round, ...]:
    """Returns the rounds of the search for a rig whose depths are ``factor`` times (1 or more) less precise than those
    of the usual rig.

    Each round has the usual number of steps, over a range ``factor`` times as wide. For each doubling of the factor,
    the last round is repeated once, and then once more over half its range, because with only three cameras in front,
    outlines leave the middle of a face undetermined by 8 mm. Shading is also removed in the last rounds, because gloss
    looks like a change of depth."""
    more = round(math.log2(factor))
    wider = [replace(each, reach_mm=factor * each.reach_mm) for each in ROUNDS]
    wider[-1] = replace(wider[-1], with_shading=not more)
    half = replace(wider[-1], reach_mm=0.5 * wider[-1].reach_mm)
    return (*wider, *[wider[-1]] * more, *[half] * more)


@lru_cache(maxsize=1)  # 150 MB; studios work with one model
def finer(model: HeadModel) -> tuple[HeadModel, Patches, Float32[np.ndarray, "m c 3"]]:
    """Returns the model with additional fine modes, its patches, and its modes at the patches' centres. All three
    values depend on ``model`` alone and are cached."""
    length, amplitude = FINE_LENGTH_MM, FINE_AMPLITUDE_MM
    sizes = {
        "sample_mm": SAMPLE_MM,
        "centre_mm": CENTRE_MM,
        "radius_mm": RADIUS_WINDOWS * max(each.window_mm for each in ROUNDS),
    }

    def make() -> dict[str, np.ndarray]:
        fine = with_fine_kernel(model, length_mm=length, amplitude_mm=amplitude)
        patches = make_patches(model, **sizes)
        basis = fine.basis("full", len(fine.modes), patches.centre)
        return {"modes": fine.modes, "sigma": fine.sigma, "basis": basis, **arrays_of(patches)}

    full, cage = model.levels["full"], model.levels["cage"]
    operator = (full.operator.data, full.operator.indices, full.operator.indptr)
    faces = (full.faces, full.face_region, cage.faces, cage.face_region)
    kept = cached_arrays(
        "fine-modes",
        (model.mean, model.modes, model.sigma, *operator, *faces, length, amplitude, sizes),
        make,
        made_by=(with_fine_kernel, make_patches, vertex_normals, HeadModel),
    )
    fine = replace(model, modes=kept.pop("modes"), sigma=kept.pop("sigma"), _bases={})
    basis = kept.pop("basis")
    return fine, Patches(**kept), basis


def near_hair(model: HeadModel, hair: Int[np.ndarray, " h"]) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the vertices near ``hair`` in the mesh that the contour fit uses; ``hair`` are the finest
    mesh's vertices under hair. The outline at these vertices is that of hair, and a fit to contours alone bulged into
    the hair."""
    mean = model.vertices(np.zeros(0))
    if not len(hair):
        return np.zeros(model.levels[LEVEL].count, bool)
    return KDTree(mean[hair]).query(mean[model.levels[LEVEL].rows])[0] < HAIR_REACH_MM


def local_misfit_mm(
    model: HeadModel, seen: SurfaceObservations, state: State, lost: Int[np.ndarray, " u"]
) -> Float[np.ndarray, " v0"]:
    """Returns, around each vertex of the coarsest mesh, the RMS distance (mm) between the photographed surface and the
    fitted surface.

    Several cameras see the vertices ``lost``, but their views do not match within the search range; the distance of
    these vertices is set to ``LOST_MM``. An example is an eye that is open in the fitted head and closed in the
    photographs. The vertices ``lost`` affect only the surface around them. The misfit fades to 0 away from the patches.
    """
    skin = ~seen.bound
    off = surface_residual(seen, state.coefficients, state.world_from_head, state.camera_shift)[0][skin]
    full, cage = model.vertices(np.zeros(0)), model.mean.astype(float)
    square = np.concatenate([np.minimum(np.abs(off), LOST_MM), np.full(len(lost), LOST_MM)]) ** 2
    square = MISFIT_LOCAL * square + (1.0 - MISFIT_LOCAL) * square[: len(off)].mean()
    distance, near = KDTree(full[np.concatenate([seen.vertex[skin], lost])]).query(cage, k=min(NEIGHBOURS, len(square)))
    weight = np.exp(-0.5 * (distance / NEAR_MM) ** 2)
    return MISFIT_FACTOR * np.sqrt((weight * square[near]).sum(axis=1) / np.maximum(weight.sum(axis=1), 0.1))
