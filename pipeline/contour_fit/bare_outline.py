"""Finds the parts of a silhouette's outline where the scalp is bald.

``noise_model.is_hairless`` assumes that an outline shows hair if no head of the model's population fits it. A bald head
of unusual shape breaks this assumption, so this module tests the pixels. Along a bald scalp skin reaches up to the
outline, and the outline is smooth. Strands and tufts make the outline of hair rough.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.contour_fit.clutter import CELL_PX, is_crown, within
from pipeline.contour_fit.contour import ContourSolution, run_stage
from pipeline.contour_fit.noise_model import update_noise
from pipeline.contour_fit.problem import ContourProblem, State
from pipeline.contour_fit.rim import Views
from pipeline.contour_fit.rim_term import observed_rim
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.cap import Cap
from rig.rig import Rig

SHOWN = 0.5  # of what lies just inside an outline, from which on the cap makes it
Plane = Float32[np.ndarray, "h w"]

DEPTH_MM = 4.0  # inside the outline, where the pixel shows what makes it: blur and matting end before
MIN_SKIN = 0.4  # probability there, in the median of views: of a bald, oily crown 0.55 to 0.9, of hair 0 to 0.08
SMOOTH_MM = 3.0  # an outline is compared with itself, smoothed over this
ROUGH_MM = 0.16  # RMS of what stands out of it: of skulls 0.05 to 0.15, of short hair 0.16 to 0.30
BARE_SHARE = 0.5  # of the crown's outline: less is smooth and like skin by chance
STRETCH_MM = 12.0  # along the outline over which both are pooled
REACH_MM = 30.0  # from the outline to a rim that belongs to it
MISSED_PX = 1.0  # a crown whose outline is farther off is fitted once more


def fit_bare_outline(solved: ContourSolution, skin: Mapping[str, Plane]) -> ContourSolution:
    """Finds the outline of a bald crown, and fits the head once more with this outline at full weight.

    Args:
        solved: the solution of the contour solver.
        skin: for each camera, the probability that a pixel shows skin.

    Returns:
        The new solution, or ``solved`` if the crown has hair.
    """
    if not skin:
        return solved
    bare = find_bare(solved.problem, solved.state, skin)
    crown, shown = _shown_crown(solved, bare)
    return refit_with_crown(solved, bare) if shown.any() and shown.sum() >= BARE_SHARE * crown.sum() else solved


def refit_with_crown(solved: ContourSolution, cells: tuple[Bool[np.ndarray, "_ _"], ...]) -> ContourSolution:
    """Fits the head once more, with full weight for the crown's outline in the marked ``cells`` of each view.

    Skips the fit and only adds the marked cells if the whole head's outline already has full weight, or if the crown's
    residuals are below ``MISSED_PX``.
    """
    problem, scale = solved.problem, solved.problem.settings.robust_px
    evidence = replace(solved.evidence, noise=replace(solved.evidence.noise, bare=cells))
    marked = replace(solved, evidence=evidence)
    residual = observed_rim(problem, evidence, solved.state, solved.stage).residual[_shown_crown(solved, cells)[1]]
    if solved.stage.whole_head or not len(residual) or np.sqrt(np.mean(residual**2)) < MISSED_PX:
        return marked
    coarse = replace(solved.stage, level="p95", scales_px=(20.0, 10.0, 5.0, 2.0 * scale), steps=4)
    state, spent, _ = run_stage(problem, evidence, solved.state, coarse, lambda fraction: None)
    state, more, reason = run_stage(problem, evidence, state, solved.stage, lambda fraction: None)
    evidence = update_noise(problem, evidence, state, solved.stage)
    evaluations = solved.evaluations + spent + more
    return replace(solved, evidence=evidence, state=state, evaluations=evaluations, termination_reason=reason)


def _shown_crown(
    solved: ContourSolution, cells: tuple[Bool[np.ndarray, "_ _"], ...]
) -> tuple[Bool[np.ndarray, " s"], Bool[np.ndarray, " s"]]:
    """Returns two masks over the rim samples: samples on the crown, and samples on the crown in marked cells."""
    rim = observed_rim(solved.problem, solved.evidence, solved.state, solved.stage)
    crown = is_crown(solved.problem, rim, solved.stage.level)
    return crown, crown & within(cells, rim)


def find_bare(problem: ContourProblem, state: State, skin: Mapping[str, Plane]) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """Marks, in every view, the square cells (``CELL_PX`` pixels wide) near the outline of a bald scalp."""
    views, maps = problem.views, []
    for k, camera in enumerate(problem.rig):
        distance = views.distance_map(k)
        depth = camera.camera_from_world.apply(state.world_from_head.translation)[2]
        if camera.name in skin:
            maps.append(mark_bare_cells(distance, skin[camera.name], camera.intrinsics.fx / depth))
        else:
            maps.append(mark_cells(np.zeros((0, 2)), np.zeros(0, bool), distance.shape, 0.0))
    return tuple(maps)


def mark_bare_cells(distance: Plane, skin: Plane, px_per_mm: float) -> Bool[np.ndarray, "_ _"]:
    """Marks the square cells (``CELL_PX`` pixels wide) of one view that lie within ``REACH_MM`` of a bald scalp's
    outline, which is smooth and borders on skin.

    Args:
        distance: signed distance to the outline (px), negative inside.
        skin: probability that a pixel shows skin.
        px_per_mm: pixels for each millimetre at the head.
    """
    outline = largest_outline(distance)
    if outline is None:
        return mark_cells(np.zeros((0, 2)), np.zeros(0, bool), distance.shape, 0.0)
    from scipy.ndimage import gaussian_filter1d  # 0.05 s

    smooth = gaussian_filter1d(outline, SMOOTH_MM * px_per_mm, axis=0, mode="wrap")
    rough = roughness(distance, smooth, px_per_mm) / px_per_mm
    shown = _pooled(share_inside(distance, skin, smooth, px_per_mm), px_per_mm)
    return mark_cells(outline, (rough < ROUGH_MM) & (shown > MIN_SKIN), distance.shape, REACH_MM * px_per_mm)


def largest_outline(distance: Plane) -> Float[np.ndarray, "n 2"] | None:
    """Returns the pixels (column, row) along the longest zero contour of a signed distance map; None without any."""
    outlines = cv2.findContours((distance < 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    return max(outlines, key=len)[:, 0].astype(float) if outlines else None


def mark_cells(
    outline: Float[np.ndarray, "n 2"], chosen: Bool[np.ndarray, " n"], shape: tuple[int, int], reach_px: float
) -> Bool[np.ndarray, "_ _"]:
    """Marks the square cells (``CELL_PX`` pixels wide) of a picture of ``shape`` (rows, columns) that lie within
    ``reach_px`` of an outline and whose nearest outline point has the mask ``chosen`` set."""
    height, width = shape
    cells = np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), bool)
    if not chosen.any():
        return cells
    row, column = np.indices(cells.shape)
    middle = CELL_PX * (np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5)
    away, row = nearest(PointTree.of(outline), middle, within=reach_px)
    near = np.isfinite(away)
    cells.ravel()[near] = chosen[row[near]]
    return cells


def roughness(distance: Plane, smooth: Float[np.ndarray, "n 2"], px_per_mm: float) -> Float[np.ndarray, " n"]:
    """Returns the roughness (px, RMS) of an outline at each point of ``smooth``, a smoothed curve along it. Roughness
    is the scatter of the distance between outline and curve within some millimetres.

    ``distance`` is the signed distance (px) to the outline. The distance is interpolated at the curve's points, because
    the outline's pixels would add steps of a whole pixel.
    """
    column, row = np.split(smooth.T.astype(np.float32), 2)
    off = cv2.remap(distance, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0].astype(float)
    return np.sqrt(np.maximum(_pooled(off**2, px_per_mm) - _pooled(off, px_per_mm) ** 2, 0.0))


def _pooled(values: Float[np.ndarray, " n"], px_per_mm: float) -> Float[np.ndarray, " n"]:
    from scipy.ndimage import gaussian_filter1d  # 0.05 s

    return gaussian_filter1d(values, STRETCH_MM * px_per_mm, mode="wrap")


def share_inside(
    distance: Plane, skin: Plane, outline: Float[np.ndarray, "n 2"], px_per_mm: float
) -> Float[np.ndarray, " n"]:
    """Returns the mean of ``skin`` (a probability) at ``DEPTH_MM`` inside each point of an outline, averaged across the
    outline."""
    reach = max(1, round(DEPTH_MM * px_per_mm))
    within = (distance < 0).astype(np.float32)
    size = (2 * reach + 1, 2 * reach + 1)
    column, row = np.clip(np.rint(outline).astype(int), 0, np.array(distance.shape[::-1]) - 1).T
    area = cv2.blur(within, size)[row, column]
    return (cv2.blur(skin * within, size)[row, column] / np.maximum(area, 1e-6)).astype(float)


@dataclass(frozen=True, slots=True, eq=False)
class CapOutline:
    """Holds, by camera, the silhouettes without the wig cap's thickness, and the square cells (``CELL_PX`` pixels wide)
    near the cap's outline."""

    silhouettes: Mapping[str, Silhouette]
    cells: Mapping[str, Bool[np.ndarray, "_ _"]]


def shrink_cap_outlines(
    silhouettes: Mapping[str, Silhouette], cap: Cap, rig: Rig, at_world: Float[np.ndarray, " 3"]
) -> CapOutline:
    """Moves the outlines inwards by the wig cap's thickness wherever the cap forms the outline.

    Args:
        silhouettes: by camera.
        cap: where each camera sees it.
        rig: the cameras as calibrated.
        at_world: about the middle of the head, mm.
    """
    moved, cells = dict(silhouettes), {}
    for name in silhouettes.keys() & cap.masks.keys():
        camera, seen = rig[name], silhouettes[name]
        px_per_mm = camera.intrinsics.fx / float(camera.camera_from_world.apply(at_world[None])[0, 2])
        outline = largest_outline(seen.distance)
        if outline is None:
            continue
        shown = share_inside(seen.distance, cap.masks[name].astype(np.float32), outline, px_per_mm) > SHOWN
        cells[name] = mark_cells(outline, shown, seen.distance.shape, REACH_MM * px_per_mm)
        distance = seen.distance + cap.thickness_mm * px_per_mm * _at_pixels(cells[name], seen.distance.shape)
        moved[name] = replace(seen, mask=seen.mask & (distance < 0), distance=distance.astype(np.float32))
    return CapOutline(moved, cells)


def cells_of_views(cells: Mapping[str, Bool[np.ndarray, "_ _"]], views: Views) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """Returns the cells of each view of a contour problem; a view whose camera has no cells gets an empty map."""
    empty = {
        name: np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), bool)
        for name, (width, height) in zip(views.names, views.size, strict=True)
    }
    return tuple(cells.get(name, empty[name]) for name in views.names)


def _at_pixels(cells: Bool[np.ndarray, "r c"], shape: tuple[int, int]) -> np.ndarray:
    rows, columns = cells.shape
    whole = cv2.resize(cells.astype(np.float32), (columns * CELL_PX, rows * CELL_PX), interpolation=cv2.INTER_LINEAR)
    return whole[: shape[0], : shape[1]]
