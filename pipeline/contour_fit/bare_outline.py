"""Finds the stretches of a silhouette's outline that are the hairless head itself.

An outline that a population's heads do not explain is taken for hair (``noise_model.is_hairless``), though a head may
just lie outside the population. The pixels decide: along a hairless head skin reaches up to the outline, and the
outline is smooth. Hair as light as skin fails the second test, for strands and tufts stand out of it.
"""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.contour_fit.clutter import CELL_PX, is_crown, within
from pipeline.contour_fit.contour import ContourSolution, run_stage
from pipeline.contour_fit.noise_model import with_misfit
from pipeline.contour_fit.problem import ContourProblem, State
from pipeline.contour_fit.rim_term import observed_rim
from pipeline.geometry.nearest import PointTree, nearest

DEPTH_MM = 4.0  # inside the outline, where the pixel shows what makes it: blur and matting end before
MIN_SKIN = 0.7  # probability there
SMOOTH_MM = 3.0  # an outline is compared with itself, smoothed over this
ROUGH_MM = 0.11  # RMS of what stands out of it: of skulls 0.05 to 0.08, of short hair 0.16 to 0.30
BARE_SHARE = 0.7  # of the crown's outline: less is smooth and like skin by chance
STRETCH_MM = 12.0  # along the outline over which both are pooled
REACH_MM = 30.0  # from the outline to a rim that belongs to it
MISSED_PX = 1.0  # a crown whose outline is farther off is fitted once more


def with_bare_outline(solved: ContourSolution, skin: Mapping[str, Float32[np.ndarray, "h w"]]) -> ContourSolution:
    """Fits the head once more if its crown turns out to be hairless, with the outline of the crown counted in full.

    Args:
        solved: the solution of the contour solver.
        skin: for each camera, the probability that a pixel shows skin.

    Returns:
        The new solution; ``solved`` if the outline of the whole head counts already or the crown is not bare. Where the
        crown already fits its outline within ``MISSED_PX``, only the marks of the bare outline are added.
    """
    if solved.stage.whole_head or not skin:
        return solved
    problem, scale = solved.problem, solved.problem.settings.robust_px
    bare = find_bare(problem, solved.state, skin)
    evidence = replace(solved.evidence, noise=replace(solved.evidence.noise, bare=bare))
    rim = observed_rim(problem, evidence, solved.state, solved.stage)
    crown = is_crown(problem, rim, solved.stage.level)
    shown = crown & within(bare, rim)
    if not shown.any() or shown.sum() < BARE_SHARE * crown.sum():
        return solved
    if np.sqrt(np.mean(rim.residual[shown] ** 2)) < MISSED_PX:
        return replace(solved, evidence=evidence)
    coarse = replace(solved.stage, level="p95", scales_px=(20.0, 10.0, 5.0, 2.0 * scale), steps=4)
    state, spent, _ = run_stage(problem, evidence, solved.state, coarse, lambda fraction: None)
    state, more, reason = run_stage(problem, evidence, state, solved.stage, lambda fraction: None)
    evidence = with_misfit(problem, evidence, state, solved.stage)
    evaluations = solved.evaluations + spent + more
    return replace(solved, evidence=evidence, state=state, evaluations=evaluations, termination_reason=reason)


def find_bare(
    problem: ContourProblem, state: State, skin: Mapping[str, Float32[np.ndarray, "h w"]]
) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """Marks, in every view, the square cells (``CELL_PX`` pixels wide) near an outline that is a hairless head's."""
    views, maps = problem.views, []
    for k, camera in enumerate(problem.rig):
        (width, height), first = views.size[k], views.offset[k]
        distance = views.distance[first : first + width * height].reshape(height, width)
        depth = camera.camera_from_world.apply(state.world_from_head.translation)[2]
        if camera.name in skin:
            maps.append(bare_cells(distance, skin[camera.name], camera.intrinsics.fx / depth))
        else:
            maps.append(np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), bool))
    return tuple(maps)


def bare_cells(
    distance: Float32[np.ndarray, "h w"], skin: Float32[np.ndarray, "h w"], px_per_mm: float
) -> Bool[np.ndarray, "_ _"]:
    """Marks the square cells (``CELL_PX`` pixels wide) within ``REACH_MM`` of a hairless head's outline in one view: of
    an outline that is smooth, with skin up to it.

    Args:
        distance: signed distance to the outline (px), negative inside.
        skin: probability that a pixel shows skin.
        px_per_mm: pixels for each millimetre at the head.
    """
    height, width = distance.shape
    cells = np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), bool)
    outlines = cv2.findContours((distance < 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    if not outlines:
        return cells
    outline = max(outlines, key=len)[:, 0].astype(float)
    from scipy.ndimage import gaussian_filter1d  # 0.05 s

    smooth = gaussian_filter1d(outline, SMOOTH_MM * px_per_mm, axis=0, mode="wrap")
    rough = roughness(distance, smooth, px_per_mm) / px_per_mm
    shown = _pooled(_inside(distance, skin, smooth, px_per_mm), px_per_mm)
    bare = (rough < ROUGH_MM) & (shown > MIN_SKIN)
    row, column = np.indices(cells.shape)
    middle = CELL_PX * (np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5)
    away, row = nearest(PointTree.of(outline), middle, within=REACH_MM * px_per_mm)
    near = np.isfinite(away)
    cells.ravel()[near] = bare[row[near]]
    return cells


def roughness(
    distance: Float32[np.ndarray, "h w"], smooth: Float[np.ndarray, "n 2"], px_per_mm: float
) -> Float[np.ndarray, " n"]:
    """Returns the roughness (px, RMS) of an outline at each point of the ``smooth`` curve along it: how far the outline
    strays from the curve within some millimetres, without their mean offset.

    ``distance`` is the signed distance (px) to the outline. Read along the curve it has none of the steps that an
    outline of whole pixels has.
    """
    column, row = np.split(smooth.T.astype(np.float32), 2)
    off = cv2.remap(distance, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0].astype(float)
    return np.sqrt(np.maximum(_pooled(off**2, px_per_mm) - _pooled(off, px_per_mm) ** 2, 0.0))


def _pooled(values: Float[np.ndarray, " n"], px_per_mm: float) -> Float[np.ndarray, " n"]:
    from scipy.ndimage import gaussian_filter1d  # 0.05 s

    return gaussian_filter1d(values, STRETCH_MM * px_per_mm, mode="wrap")


def _inside(
    distance: Float32[np.ndarray, "h w"],
    skin: Float32[np.ndarray, "h w"],
    outline: Float[np.ndarray, "n 2"],
    px_per_mm: float,
) -> Float[np.ndarray, " n"]:
    """Returns the probability of skin ``DEPTH_MM`` inside each point of an outline, its mean across it."""
    reach = max(1, round(DEPTH_MM * px_per_mm))
    within = (distance < 0).astype(np.float32)
    size = (2 * reach + 1, 2 * reach + 1)
    column, row = np.clip(np.rint(outline).astype(int), 0, np.array(distance.shape[::-1]) - 1).T
    area = cv2.blur(within, size)[row, column]
    return (cv2.blur(skin * within, size)[row, column] / np.maximum(area, 1e-6)).astype(float)
