"""Pictures as pinholes would have taken them: dots lie where a pinhole sees them, and what no lens saw is black."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.results.view_dataset import pinhole_of, undistorted_picture, undistorted_share
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import RigidTransform
from tests.support.dataset_readers import dot_centre, with_dots

WIDE = Intrinsics(320, 240, 260.0, 268.0, 150.3, 126.8, Distortion(k1=-0.25, k2=0.06, p1=0.002, p2=-0.001))
POINTS = np.array([(x, y, 800.0) for x in (-380.0, 0.0, 330.0) for y in (-280.0, 20.0, 250.0)])


@pytest.mark.parametrize("centred", [False, True])
def test_dots_lie_where_the_pinhole_sees_them(centred: bool) -> None:
    camera = Camera("cam00", WIDE, RigidTransform.identity())
    pinhole = replace(camera, intrinsics=pinhole_of(WIDE, centred=centred))
    taken = with_dots(np.zeros((240, 320, 3), np.uint8), camera, POINTS)
    straight = undistorted_picture(taken, WIDE, pinhole.intrinsics)
    expected = pinhole.project(POINTS)
    assert np.abs(expected - camera.project(POINTS)).max() > 5.0  # or the lens would not matter
    errors = [np.hypot(*(dot_centre(straight, pixel) - pixel)) for pixel in expected]
    assert max(errors) < 0.01


def test_a_centred_pinhole_is_known_by_its_field_of_view_alone_and_a_pinholes_picture_stays_as_it_is() -> None:
    pinhole = pinhole_of(WIDE, centred=True)
    assert (pinhole.fx, pinhole.cx, pinhole.cy) == (pinhole.fy, 159.5, 119.5)
    assert pinhole.distortion.is_zero
    assert pinhole.fx == pytest.approx(np.sqrt(260.0 * 268.0))
    pinhole = pinhole_of(WIDE)
    picture = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    assert undistorted_picture(picture, pinhole, pinhole) is picture
    assert pinhole_of(pinhole) == pinhole


def test_what_the_lens_did_not_see_is_black_and_no_subject() -> None:
    shifted = replace(pinhole_of(WIDE), cx=WIDE.cx + 40.0)  # sees 40 pixels more on the left
    white, subject = np.full((240, 320, 3), 200, np.uint8), np.ones((240, 320), np.float32)
    picture = undistorted_picture(white, pinhole_of(WIDE), shifted)
    share = undistorted_share(subject, pinhole_of(WIDE), shifted)
    assert (picture[:, :39] == 0).all()
    assert (share[:, :39] == 0).all()
    assert (picture[:, 41:] == 200).all()
    assert (share[:, 41:] == 1).all()
    folding = replace(WIDE, distortion=Distortion(k1=-1.5))  # turns back at a radius of 0.47
    assert (undistorted_picture(white, folding, pinhole_of(folding))[0, 0] == 0).all()
