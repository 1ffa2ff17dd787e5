"""Outlines beside depths that reach beyond them: by as much as windows widen, and by more."""

import cv2
import numpy as np
import pytest

from pipeline.fusion.view_stack import SILENT_PX, WIDENED_PX, ViewStack, silence_contradicted, stack_views
from pipeline.fusion.vote_kernels import OUTLINE, PIXEL_STEP
from pipeline.imaging.silhouette import silhouette_from_mask
from tests.support.ellipsoid_depths import Ellipsoid, Scene, scene
from tests.support.scenes import fan


@pytest.fixture(scope="module")
def ball() -> Scene:
    return scene([Ellipsoid((0, 0, 0), (60, 60, 60))], fan(400, 300))


def narrower(made: Scene, by_px: int) -> ViewStack:
    """The views with a mask of cam03 that ends so much within the truth."""
    mask = made.silhouettes["cam03"].mask.view(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by_px + 1, 2 * by_px + 1))
    eaten = cv2.erode(mask, disc) > 0
    return stack_views(made.maps, {**made.silhouettes, "cam03": silhouette_from_mask(eaten)}, made.rig)


def silent(views: ViewStack) -> list[int]:
    ends = [*views.starts[1:], len(views.depth_mm)]
    return [
        int((PIXEL_STEP * views.shown[first:last, OUTLINE] == SILENT_PX).sum())
        for first, last in zip(views.starts, ends, strict=False)
    ]


def test_an_outline_stands_against_depths_that_windows_widened(ball: Scene) -> None:
    found, shares = silence_contradicted(narrower(ball, int(WIDENED_PX) - 5))
    assert silent(found) == [0] * len(ball.maps)
    assert not shares.any()


def test_an_outline_far_within_what_others_see_says_nothing(ball: Scene) -> None:
    views = narrower(ball, int(WIDENED_PX) + 12)
    found, shares = silence_contradicted(views)
    third = [depth_map.camera.name for depth_map in ball.maps].index("cam03")
    assert [n for n, count in enumerate(silent(found)) if count] == [third]
    assert shares[third] > 0.05
    assert np.array_equal(views.shown[:, :OUTLINE], found.shown[:, :OUTLINE])
