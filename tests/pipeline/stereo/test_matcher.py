"""Windows compared by shaders are compared as by compiled loops, on whatever OpenGL this machine has."""

from collections.abc import Iterator

import numpy as np
import pytest

from pipeline.stereo.crops import Crop, make_crops
from pipeline.stereo.depth_map import DepthMap
from pipeline.stereo.depth_range import DepthRange, find_depth_ranges
from pipeline.stereo.estimate import (
    COARSEST_LEVEL,
    CONTRAST_LEVELS,
    LABELS,
    PIXEL_MM,
    choose_neighbours,
    estimate_depth,
    label_strides,
    square_pattern,
)
from pipeline.stereo.matcher import GROUP, SHADERS, Matcher, Planes, matching_on
from pipeline.stereo.stack import Stack, stack_crops
from rig.camera import Distortion
from rig.progress import discard_progress
from rig.render.compute import ComputeDevice
from tests.pipeline.stereo.ray_scene import Ball, fan, shoot

pytestmark = pytest.mark.gl

MEDIAN_MM = 0.02  # that depth by shaders may differ from that by loops
BALLS = (Ball(), Ball(centre=(15.0, 5.0, 95.0), radius=22.0))


@pytest.fixture(scope="module")
def device() -> Iterator[ComputeDevice]:
    with ComputeDevice.create() as opened:
        yield opened


@pytest.fixture(scope="module")
def crops() -> list[Crop]:
    rig = fan(4, 18.0, Distortion(k1=-0.05, p1=0.001))
    images, silhouettes = shoot(rig, BALLS)
    return make_crops(images, silhouettes, rig, pixel_mm=PIXEL_MM, at_world=np.zeros(3))


@pytest.fixture(scope="module")
def stack(crops: list[Crop]) -> Stack:
    return stack_crops(crops, 1)


@pytest.fixture
def matchers(device: ComputeDevice, crops: list[Crop], stack: Stack) -> Iterator[tuple[Matcher, Matcher]]:
    """By loops, and by shaders, of the second view."""
    neighbours = choose_neighbours([crop.camera for crop in crops], np.zeros(3))
    pattern = square_pattern(2)
    with (
        matching_on(None, stack, neighbours, pattern, CONTRAST_LEVELS) as by_loops,
        matching_on(device, stack, neighbours, pattern, CONTRAST_LEVELS) as by_shaders,
    ):
        yield by_loops.matcher(1), by_shaders.matcher(1)


@pytest.fixture
def room(crops: list[Crop], stack: Stack) -> DepthRange:
    extent = (np.zeros(3), 220.0)
    return find_depth_ranges(crops, stack_crops(crops, COARSEST_LEVEL), stack, None, extent)[1]


def planes(room: DepthRange) -> Planes:
    """Planes as a search might leave them: somewhere in the room, each pixel elsewhere."""
    share = np.random.default_rng(5).random(room.near.shape).astype(np.float32)
    depth = np.where(room.far > 0.0, room.near + share * (room.far - room.near), 0.0).astype(np.float32)
    slopes = np.ascontiguousarray(room.slopes[:, :, :2])
    return Planes(depth, slopes, np.full(depth.shape, -1.0, np.float32), depth > 0.0)


def test_costs_of_a_sweep_are_those_of_the_loops(matchers: tuple[Matcher, Matcher], room: DepthRange) -> None:
    strides = label_strides(room)
    assert strides.max() > 1, "places between are interpolated"
    by_loops, by_shaders = (matcher.sweep(room, strides, LABELS) for matcher in matchers)
    compared = by_loops[room.far > 0.0]
    assert np.ptp(compared) > 0.5
    # A window at the edge of what another view shows falls on either side of it by rounding: seldom, then wholly.
    assert np.mean(np.abs(by_shaders - by_loops) > 1e-3) < 1e-3
    np.testing.assert_array_equal(by_shaders[room.far <= 0.0], by_loops[room.far <= 0.0])


def test_planes_are_taken_over_as_by_the_loops(matchers: tuple[Matcher, Matcher], room: DepthRange) -> None:
    found = []
    for matcher in matchers:
        mine = planes(room)
        black = np.indices(mine.depth.shape).sum(axis=0) % 2 == 0
        for parity, tried in ((0, ~black), (1, black)):
            matcher.propagate(mine, parity, (1, 3), 0.1)
            mine.fresh[tried] = False
        found.append(mine)
    by_loops, by_shaders = found
    changed = np.abs(by_loops.depth - planes(room).depth) > 0.1
    assert changed.sum() > 0.3 * (by_loops.depth > 0.0).sum()
    live = by_loops.depth > 0.0
    assert np.mean(np.abs(by_shaders.depth - by_loops.depth)[live] > 1e-2) < 5e-3
    assert np.mean(np.abs(by_shaders.cost - by_loops.cost)[live] > 1e-3) < 5e-3
    assert np.mean(by_shaders.fresh != by_loops.fresh) < 5e-3


def test_slides_are_those_of_the_loops(matchers: tuple[Matcher, Matcher], room: DepthRange) -> None:
    mine = planes(room)
    by_loops, by_shaders = (np.stack(matcher.slide(1.0, mine.depth, mine.slopes)) for matcher in matchers)
    live = by_loops[1] > 0.0
    assert live.mean() > 0.1
    assert np.mean(np.abs(by_shaders[0] - by_loops[0]) > 1e-2) < 2e-3
    assert np.mean(np.abs(by_shaders[1] / np.maximum(by_loops[1], 1e-9) - 1.0)[live] > 1e-2) < 5e-3
    assert np.mean(np.abs(by_shaders[2] - by_loops[2]) > 1e-3) < 2e-3


def known_in_both(one: tuple[DepthMap, ...], other: tuple[DepthMap, ...]) -> tuple[np.ndarray, float]:
    """Differences in depth (mm) where both know it, and the share of pixels that only one knows."""
    apart = [np.abs(a.depth_mm - b.depth_mm)[a.known & b.known] for a, b in zip(one, other, strict=True)]
    either = sum(np.count_nonzero(a.known ^ b.known) for a, b in zip(one, other, strict=True))
    return np.concatenate(apart), either / max(sum(np.count_nonzero(a.known) for a in one), 1)


@pytest.mark.slow
def test_depth_by_shaders_is_that_of_the_loops(device: ComputeDevice) -> None:
    rig = fan(5, 18.0)
    images, silhouettes = shoot(rig, BALLS)
    by_loops, by_shaders = (
        estimate_depth(images, silhouettes, rig, None, report=discard_progress, device=each) for each in (None, device)
    )
    apart_mm, share = known_in_both(by_loops, by_shaders)
    assert len(apart_mm) > 10_000
    assert np.median(apart_mm) < MEDIAN_MM
    assert np.quantile(apart_mm, 0.99) < 0.5
    assert share < 0.02


def test_what_the_device_cannot_hold_is_compared_by_loops(device: ComputeDevice, stack: Stack) -> None:
    class Small(ComputeDevice):
        def __init__(self) -> None:
            self.largest_array = stack.pairs.nbytes - 1

    with matching_on(Small(), stack, [np.array([1])] * len(stack), square_pattern(2), 30.0) as matching:
        assert matching.device is None


def test_groups_are_as_large_as_the_shaders_say() -> None:
    assert f"local_size_x = {GROUP}, local_size_y = {GROUP}" in (SHADERS / "matching.glsl").read_text()
