"""Faults planted in the studio's rig, and good rigs that none may be found in."""

from dataclasses import replace

import numpy as np
import pytest

from rig.camera import Distortion
from rig.geometry import RigidTransform, rotation_from_vector
from rig.plausibility import rig_faults
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.layouts import ARRANGEMENTS_DEG, arrangement
from tests.support.scenes import fan

GL = np.diag([1.0, -1.0, -1.0])


def posed(rig, pose):
    return Rig(tuple(replace(camera, camera_from_world=pose(camera.camera_from_world)) for camera in rig))


def lensed(rig, name, lens):
    changed = [
        replace(c, intrinsics=replace(c.intrinsics, distortion=lens)) if c.name == name else c for c in rig.cameras
    ]
    return Rig(tuple(changed))


def in_another_world(rig, rng):
    world_from_new = RigidTransform(rotation_from_vector(rng.normal(0, 1, 3)), rng.normal(0, 800, 3))
    return posed(rig, lambda pose: pose @ world_from_new)


def test_good_rigs_have_no_faults_in_any_world():
    rng = np.random.default_rng(0)
    for rig in (default_layout(), fan(), *map(arrangement, ARRANGEMENTS_DEG)):
        assert rig_faults(rig) == []
        for _ in range(5):
            some = rig.subset(rng.choice(rig.names, rng.integers(3, len(rig) + 1), replace=False))
            assert rig_faults(in_another_world(some, rng)) == []


def test_strong_but_real_lenses_have_no_faults():
    rig = default_layout()
    wide = Rig(tuple(replace(c, intrinsics=replace(c.intrinsics, fx=600.0, fy=600.0)) for c in rig))
    assert rig_faults(lensed(wide, "cam03", Distortion(k1=-0.3, k2=0.1, k3=-0.015))) == []
    assert rig_faults(lensed(rig, "cam03", Distortion(k1=0.5, k2=-0.3))) == []


@pytest.mark.parametrize("k1", [50.0, -50.0, 1e6])
def test_an_absurd_lens_is_named(k1):
    (fault,) = rig_faults(lensed(default_layout(), "cam05", Distortion(k1=k1)))
    assert fault.text.startswith("cam05: the lens is absurd (k1 = ")


def recorded(rig, name, lens, **intrinsics):
    return Rig(tuple(
        replace(c, recorded=lens, intrinsics=replace(c.intrinsics, distortion=Distortion(), **intrinsics))
        if c.name == name else c for c in rig
    ))  # fmt: skip


@pytest.mark.parametrize(
    ("lens", "text"),
    [
        (RecordedLens("kannala-brandt", (1e11, 0.0, 0.0, 0.0)), "k1 = 1e+11, k2 = 0, k3 = 0, k4 = 0"),
        (RecordedLens("kannala-brandt", (-30.0, 0.0, 0.0, 0.0)), "k1 = -30"),
        (RecordedLens("rational", (0.0, 0.0, 0.0, 0.0, 0.0, -1000.0, 0.0, 0.0)), "k4 = -1000"),
    ],
)
def test_an_absurd_recorded_lens_is_named(lens, text):
    (fault,) = rig_faults(recorded(default_layout(), "cam05", lens))
    assert fault.text.startswith("cam05: the lens is absurd (k1 = ")
    assert text in fault.text


def test_fisheyes_and_rational_lenses_of_real_cameras_have_no_faults():
    rig = default_layout()
    width = rig["cam05"].intrinsics.width
    for share in (1.2, 0.5, 0.26):  # of the picture's width; the last sees 220 degrees
        fisheye = RecordedLens("kannala-brandt", (-0.03, 0.011, -0.004, 0.0007))
        assert rig_faults(recorded(rig, "cam05", fisheye, fx=share * width, fy=share * width)) == []
    rational = RecordedLens("rational", (0.12, -0.05, 1e-3, -8e-4, 0.01, 0.31, 0.02, 0.003))
    assert rig_faults(recorded(rig, "cam05", rational)) == []


def test_principal_points_that_nobody_gave_are_named_once():
    rig = default_layout()
    bare = Rig(tuple(replace(c, intrinsics=replace(c.intrinsics, cx=0.0, cy=0.0)) for c in rig))
    (fault,) = rig_faults(bare)
    assert fault.code == "principal-points-missing"


def test_intrinsics_as_shares_of_the_picture_are_named_once():
    shares = [replace(c, intrinsics=replace(c.intrinsics, fx=1.2, fy=1.6, cx=0.5, cy=0.5)) for c in default_layout()]
    (fault,) = rig_faults(Rig(tuple(shares)))
    assert fault.code == "intrinsics-are-shares"


@pytest.mark.parametrize(("factor", "size_share"), [(2.0, "2.00 times"), (0.5, "0.50 times"), (0.25, "0.25 times")])
def test_intrinsics_of_pictures_of_another_size_are_named_with_the_factor(factor, size_share):
    rig = default_layout()
    keys = ("fx", "fy", "cx", "cy")
    other = [
        replace(c, intrinsics=replace(c.intrinsics, **{key: factor * getattr(c.intrinsics, key) for key in keys}))
        for c in rig
    ]
    (fault,) = rig_faults(Rig(tuple(other)))
    assert fault.text.startswith(f"the intrinsics are of pictures {size_share} as large")
    assert f"by {1 / factor:.2f}," in fault.text


def test_a_focal_length_in_mm_is_named_and_not_its_lens():
    rig = default_layout()
    in_mm = Rig(tuple(replace(c, intrinsics=replace(c.intrinsics, fx=50.0, fy=50.0)) for c in rig))
    for camera, fault in zip(rig, rig_faults(in_mm), strict=True):
        assert fault.text.startswith(f"{camera.name}: a focal length of 50 px is absurd")


@pytest.mark.parametrize(("unit", "name"), [(10, "centimetres"), (100, "decimetres")])
def test_other_units_are_recognised_by_what_the_pictures_show(unit, name):
    (fault,) = rig_faults(posed(default_layout(), lambda pose: RigidTransform(pose.rotation, pose.translation / unit)))
    assert f"look like {name}" in fault.text
    assert f"multiply them by {unit}" in fault.text


@pytest.mark.parametrize("unit", [10, 25.4])
def test_centimetres_and_inches_are_both_named_for_either_may_be_meant(unit):
    (fault,) = rig_faults(posed(default_layout(), lambda pose: RigidTransform(pose.rotation, pose.translation / unit)))
    other = 25.4 if unit == 10 else 10
    assert f"multiply them by {unit}, or by {other} if they are" in fault.text


@pytest.mark.parametrize(
    ("factor", "remedy"),
    [
        (100, "divide their translations by 100"),
        (1000, "divide their translations by 1000"),
        (1e8, "look for one that is wrong"),
    ],
)
def test_translations_that_are_too_large_are_named_with_the_remedy(factor, remedy):
    (fault,) = rig_faults(
        posed(default_layout(), lambda pose: RigidTransform(pose.rotation, pose.translation * factor))
    )
    assert fault.text.endswith(f"translations must be in millimetres: {remedy}")


def test_cameras_far_from_the_origin_are_named_since_meshes_hold_24_bits():
    """As in coordinates on the globe, 5300 km north of the equator."""
    for north_mm, words in ((1e5, None), (5.3e9, "5.3e+03 km from the world's origin")):
        shifted = RigidTransform(np.eye(3), np.array([0.0, north_mm, 0.0]))
        faults = rig_faults(posed(default_layout(), lambda pose, world=shifted: pose @ world))
        assert bool(faults) == (words is not None)
        assert words is None or words in faults[0].text


def test_cameras_at_one_place_are_named():
    place = np.array([1.0, 2.0, 3.0])
    one = posed(default_layout(), lambda pose: RigidTransform(pose.rotation, -pose.rotation @ place))
    (fault,) = rig_faults(one)
    assert "every camera stands at one place" in fault.text


def test_metres_are_recognised():
    (fault,) = rig_faults(posed(default_layout(), lambda pose: RigidTransform(pose.rotation, pose.translation / 1000)))
    assert "look like metres" in fault.text
    assert "multiply them by 1000" in fault.text


@pytest.mark.parametrize(
    ("written", "word"),
    [
        (lambda pose: pose.inverse(), "world_from_camera "),
        (lambda pose: RigidTransform(pose.rotation, pose.inverse().translation), "place in translation"),
        (lambda pose: RigidTransform(GL @ pose.rotation, GL @ pose.translation), "y up and z backwards"),
        (
            lambda pose: RigidTransform(pose.rotation.T @ GL, pose.inverse().translation),
            "world_from_camera with y up and z backwards",
        ),
        (lambda pose: RigidTransform(pose.rotation, -pose.translation), "translations of the wrong sign"),
    ],
    ids=["inverse", "centres", "GL", "inverse GL", "negated"],
)
def test_another_convention_is_recognised_by_trying_it(written, word):
    rng = np.random.default_rng(3)
    for rig in (default_layout(), in_another_world(default_layout(), rng), arrangement("a")):
        (fault,) = rig_faults(posed(rig, written))
        assert word in fault.text
