"""Cameras and points of the wedge, against rays that were drawn by nothing but the project's own convention."""

import numpy as np
import pytest

from calibration.adjustment.gauge import image_distance
from calibration.scene.matching import Matches
from calibration.scene.structure import explain_missing_view
from tests.support.textured_wedge import on_wedge, solved, wedge_rig


def test_the_cameras_are_the_true_ones_and_their_principal_points_count_as_the_pixels_do() -> None:
    # 1,500 points at 0.06 px: the cameras are known to a few hundredths of a pixel.
    assert image_distance(solved().rig, wedge_rig(), scale=True).max() < 0.1
    structure = solved().structure
    k = structure.rig.cameras[0].intrinsics
    assert (k.cx, k.cy) == ((k.width - 1) / 2, (k.height - 1) / 2)
    assert np.abs(np.median(structure.residuals(), axis=0)).max() < 0.02


def test_observed_pixels_have_their_origin_in_a_pixels_centre() -> None:
    """Where a point is seen in one camera, the true rays say where it is in the others. Cameras are rolled by 0, 90 and
    180 degrees, so that half a pixel, the same in every picture, would miss by up to a pixel."""
    truth, structure = wedge_rig(), solved().structure
    names, misses = structure.rig.names, []
    for point in range(len(structure.points)):
        seen = np.flatnonzero(structure.point_of == point)
        first, *others = (truth[names[index]] for index in structure.camera_of[seen])
        there = on_wedge(first, structure.pixels[seen[:1]])
        misses += [o.project(there)[0] - px for o, px in zip(others, structure.pixels[seen[1:]], strict=True)]
    assert len(misses) > 2000
    assert np.abs(np.median(misses, axis=0)).max() < 0.03
    assert np.median(np.linalg.norm(misses, axis=1)) < 0.2


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("dark", "the view has only 12 distinct points"),
        ("alone", "none of the view's 900 points is found in another view"),
        ("far", "the view has at most 20 points in common with another view (near)"),
        ("farther", "the view has at most 30 points in common with another view (far, which did not join either)"),
    ],
)
def test_a_view_that_does_not_join_is_told_why(name: str, reason: str) -> None:
    features = {"near": 2000, "dark": 12, "alone": 900, "far": 800, "farther": 700}
    matched = {("near", "far"): 20, ("far", "farther"): 30, ("near", "alone"): 0}
    if name == "far":
        matched["far", "farther"] = 10
    matches = Matches((), False, dict.fromkeys(features, (640, 480)), features, matched, 0)
    assert explain_missing_view(name, matches, ("near",)).text.startswith(reason)
