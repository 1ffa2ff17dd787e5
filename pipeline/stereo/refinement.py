"""From one size of the photographs to the next: planes doubled, taken over from neighbours, and slid to their place.

What the smaller size knew is carried along with a share of its information, and no more than the relief about a pixel
allows: its windows see shading that smaller ones do not, and miss what is smaller than they are.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, Int

from pipeline.compute.threads import map_in_threads
from pipeline.settings import DenseSettings
from pipeline.stereo.crops import MAX_UNSEEN_PX
from pipeline.stereo.field import Field
from pipeline.stereo.field_kernels import double, fit_planes
from pipeline.stereo.matching_kernels import make_scratch
from pipeline.stereo.refine_kernels import propagate, slide
from pipeline.stereo.specks import take_specks_off
from pipeline.stereo.stack import Stack

STEEPEST = 3.0  # slope against the image plane: 72 degrees
RADIUS_PX = 2  # of the neighbourhood that a plane is laid through
MIN_INFORMATION = 1e-4  # 1 / mm^2: a standard deviation of 100 mm
SAME_PX = 0.1  # planes that differ by less are one: a slide takes either to its place
PLANE_ROUNDS = 2  # what takes a speck's place is tried against its neighbours, too
MAX_SLIDE_PX = 1.0  # of a step: linear models of an image reach no farther


def doubled(fields: Sequence[Field], stack: Stack, settings: DenseSettings) -> list[Field]:
    """Returns the fields enlarged to twice their size, the size of ``stack``, with a share of their information
    kept."""

    def work(view: int) -> Field:
        field, distance = fields[view], stack.image(stack.distance_px, view)
        live = (distance < 0.5) & (distance > MAX_UNSEEN_PX)
        depth, slopes = np.empty(live.shape, np.float32), np.empty((*live.shape, 2), np.float32)
        double(field.depth, field.slopes, live, depth, slopes)
        relief = (settings.relief_factor * field.relief_mm) ** 2
        known = settings.carried * field.information / (1.0 + field.information * relief)
        information = cv2.resize(known, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        zero = np.zeros_like(depth)
        return Field(depth, slopes, information, zero, zero)

    return map_in_threads(work, len(fields))


def refined(
    fields: Sequence[Field],
    stack: Stack,
    neighbours: Sequence[Int[np.ndarray, " _"]],
    pattern: Float32[np.ndarray, "2 s"],
    settings: DenseSettings,
    *,
    steps_px: Sequence[int],
    rounds: int,
    speck_px: int,
) -> list[Field]:
    """Improves the field of every view. Each pixel tries the planes of pixels ``steps_px`` away (odd; empty: none),
    specks of at most ``speck_px`` pixels are replaced, and least squares then moves the planes in ``rounds`` rounds."""

    def work(view: int) -> Field:
        return _refined(
            fields[view],
            stack,
            view,
            neighbours[view],
            pattern,
            settings,
            steps_px=steps_px,
            rounds=rounds,
            speck_px=speck_px,
        )

    return map_in_threads(work, len(fields))


def _refined(
    field: Field,
    stack: Stack,
    view: int,
    neighbours: Int[np.ndarray, " m"],
    pattern: Float32[np.ndarray, "2 s"],
    settings: DenseSettings,
    *,
    steps_px: Sequence[int],
    rounds: int,
    speck_px: int,
) -> Field:
    sight = stack.match_arguments(view, neighbours, pattern, settings.contrast_levels)
    scratch = make_scratch(sight)
    depth, slopes, live = field.depth.copy(), field.slopes.copy(), field.depth > 0.0
    pixel_mm = float(depth[live].mean() / stack.lens[view, 0]) if live.any() else 1.0
    specks = np.zeros(depth.shape, bool)
    if steps_px:
        cost, fresh = np.full(depth.shape, -1.0, np.float32), live.copy()
        black = np.indices(depth.shape).sum(axis=0) % 2 == 0
        for _ in range(PLANE_ROUNDS):
            for parity, tried in ((0, ~black), (1, black)):
                propagate(sight, scratch, parity, np.array(steps_px), SAME_PX * pixel_mm, fresh, depth, slopes, cost)
                fresh[tried] = False
            specks = take_specks_off(depth, slopes, pixel_mm, speck_px)
            cost[specks], fresh[specks] = -1.0, True
    before, known = depth, np.where(specks, np.float32(0.0), field.information) + MIN_INFORMATION
    information, relief, likeness = known, np.zeros_like(depth), np.zeros_like(depth)
    for _ in range(rounds):
        place, seen, likeness = np.empty_like(depth), np.empty_like(depth), np.empty_like(depth)
        slide(sight, scratch, MAX_SLIDE_PX, depth, slopes, place, seen, likeness)
        seen = seen / (settings.match_factor**2 + settings.match_floor_mm**2 * seen)
        information = seen + known
        joined = np.where(live, (seen * place + known * before) / information, 0.0).astype(np.float32)
        depth, flatter, relief = np.empty_like(joined), np.empty_like(slopes), np.empty_like(joined)
        fit_planes(joined, slopes, information, RADIUS_PX, pixel_mm, STEEPEST * pixel_mm, depth, flatter, relief)
        slopes = flatter
    return Field(depth, slopes, information.astype(np.float32), relief, likeness)
