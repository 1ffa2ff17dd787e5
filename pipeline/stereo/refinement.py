"""Carries the planes from one size of the photographs to the next: enlarges them, lets pixels take over better planes
of their neighbours, and moves each to the best match.

A part of the information from the smaller size is kept, limited by the relief around the pixel: the larger windows
there see shading that smaller ones do not, and miss what is smaller than they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from pipeline.compute.threads import map_in_threads
from pipeline.stereo.crops import MAX_UNSEEN_PX
from pipeline.stereo.depth_map import Field
from pipeline.stereo.field_kernels import double, fill_specks, fit_planes, mark_specks
from pipeline.stereo.matcher import Matching, Planes
from pipeline.stereo.stack import Stack

MATCH_FACTOR = 1.6  # of a match's own standard deviation: samples of a window are not independent
MATCH_FLOOR_MM = 0.1  # error of a match that its window does not show
CARRIED = 0.5  # share of the information that goes on to the next size, as far as ...
RELIEF_FACTOR = 3.0  # ... this many times the relief about a pixel allows: without it hair and lids blur
GAP_PX = 1.0  # between the planes of two pixels of one piece
SWEEPS = 30  # a speck of 60 pixels is 8 wide


def take_specks_off(
    depth: Float32[np.ndarray, "h w"], slopes: Float32[np.ndarray, "h w 2"], pixel_mm: float, most_px: int
) -> Bool[np.ndarray, "h w"]:
    """Replaces, in place, small separate pieces of surface (at most ``most_px`` pixels) by a smooth surface through
    what surrounds them. Returns which pixels were replaced.

    A piece stays if nothing is known around it: at an outline, where the surface may go on behind, or among so many
    other pieces that together they exceed ``most_px``. (In one capture a quarter of the clothes are such neighbouring
    pieces at the search's size; two fifths of them are right, and replacing them all lost 6 % of the clothes.)
    """
    specks = np.zeros(depth.shape, bool)
    mark_specks(depth, slopes, GAP_PX * pixel_mm, most_px, specks)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(specks.astype(np.uint8), connectivity=4)
    group = np.asarray(labels, np.int32)
    inside = (depth > 0.0).astype(np.uint8)
    inner = cv2.erode(inside, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    enclosed = stats[:, cv2.CC_STAT_AREA] <= most_px
    enclosed[np.unique(group[inner == 0])] = False
    specks &= enclosed[group]
    fill_specks(depth, slopes, specks, SWEEPS)
    return specks


STEEPEST = 3.0  # slope against the image plane: 72 degrees
RADIUS_PX = 2  # of the neighbourhood that a plane is laid through
MIN_INFORMATION = 1e-4  # 1 / mm^2: a standard deviation of 100 mm
SAME_PX = 0.1  # planes that differ by less are one: a slide takes either to its place
PLANE_ROUNDS = 2  # what takes a speck's place is tried against its neighbours, too
MAX_SLIDE_PX = 1.0  # of a step: linear models of an image reach no farther


def doubled(fields: Sequence[Field], stack: Stack) -> list[Field]:
    """Returns the fields enlarged to twice their width and height, the size of ``stack``. They keep a part of their
    information."""

    def work(view: int) -> Field:
        field, distance = fields[view], stack.image(stack.distance_px, view)
        live = (distance < 0.5) & (distance > MAX_UNSEEN_PX)
        depth, slopes = np.empty(live.shape, np.float32), np.empty((*live.shape, 2), np.float32)
        double(field.depth, field.slopes, live, depth, slopes)
        relief = (RELIEF_FACTOR * field.relief_mm) ** 2
        known = CARRIED * field.information / (1.0 + field.information * relief)
        information = cv2.resize(known, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        zero = np.zeros_like(depth)
        return Field(depth, slopes, information, zero, zero)

    return map_in_threads(work, len(fields))


@dataclass(frozen=True, slots=True)
class Pass:
    """Holds how the planes are improved at one size of the photographs."""

    steps_px: tuple[int, ...]  # each pixel tries the planes of pixels that far away (odd)
    speck_px: int  # pieces of surface of so few pixels are replaced
    rounds: int  # of least squares


def refined(fields: Sequence[Field], matching: Matching, once: Pass) -> list[Field]:
    """Improves the field of every view: pixels take over their neighbours' planes, small wrong pieces of surface are
    replaced, and least squares then moves the planes."""

    def work(view: int) -> Field:
        return _refined(fields[view], matching, view, once)

    return map_in_threads(work, len(fields))


def _refined(field: Field, matching: Matching, view: int, once: Pass) -> Field:
    matcher = matching.matcher(view)
    depth, slopes, live = field.depth.copy(), field.slopes.copy(), field.depth > 0.0
    pixel_mm = float(depth[live].mean() / matching.stack.lens[view, 0]) if live.any() else 1.0
    specks = np.zeros(depth.shape, bool)
    if once.steps_px:
        planes = Planes(depth, slopes, np.full(depth.shape, -1.0, np.float32), live.copy())
        black = np.indices(depth.shape).sum(axis=0) % 2 == 0
        for _ in range(PLANE_ROUNDS):
            for parity, tried in ((0, ~black), (1, black)):
                matcher.propagate(planes, parity, once.steps_px, SAME_PX * pixel_mm)
                planes.fresh[tried] = False
            specks = take_specks_off(depth, slopes, pixel_mm, once.speck_px)
            planes.cost[specks], planes.fresh[specks] = -1.0, True
    before, known = depth, np.where(specks, np.float32(0.0), field.information) + MIN_INFORMATION
    information, relief, likeness = known, np.zeros_like(depth), np.zeros_like(depth)
    for _ in range(once.rounds):
        place, seen, likeness = matcher.slide(MAX_SLIDE_PX, depth, slopes)
        seen = seen / (MATCH_FACTOR**2 + MATCH_FLOOR_MM**2 * seen)
        information = seen + known
        joined = np.where(live, (seen * place + known * before) / information, 0.0).astype(np.float32)
        depth, flatter, relief = np.empty_like(joined), np.empty_like(slopes), np.empty_like(joined)
        fit_planes(joined, slopes, information, RADIUS_PX, pixel_mm, STEEPEST * pixel_mm, depth, flatter, relief)
        slopes = flatter
    return Field(depth, slopes, information.astype(np.float32), relief, likeness)
