"""Faults planted in the studio's rig, and good rigs that none may be found in."""

from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np
import pytest

from rig.camera import Distortion
from rig.geometry import RigidTransform, rotation_from_vector
from rig.plausibility import rig_faults
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.changed_rigs import relensed, reposed
from tests.support.layouts import ARRANGEMENTS_DEG, arrangement
from tests.support.scenes import fan

GL = np.diag([1.0, -1.0, -1.0])
STUDIO = default_layout()


def scaled(factor):
    return reposed(STUDIO, lambda pose: RigidTransform(pose.rotation, factor * pose.translation))


def north(distance_mm):
    return reposed(STUDIO, lambda pose: pose @ RigidTransform(np.eye(3), np.array([0.0, distance_mm, 0.0])))


def lensed(rig, name, lens):
    return relensed(rig, lambda intrinsics: replace(intrinsics, distortion=lens), name)


def of_other_size(factor):
    keys = ("fx", "fy", "cx", "cy")
    return relensed(STUDIO, lambda k: replace(k, **{key: factor * getattr(k, key) for key in keys}))


def recorded(lens, **intrinsics):
    straight = relensed(STUDIO, lambda k: replace(k, distortion=Distortion(), **intrinsics), "cam05")
    return Rig(tuple(replace(c, recorded=lens) if c.name == "cam05" else c for c in straight))


def in_another_world(rig, rng):
    world_from_new = RigidTransform(rotation_from_vector(rng.normal(0, 1, 3)), rng.normal(0, 800, 3))
    return reposed(rig, lambda pose: pose @ world_from_new)


def test_good_rigs_have_no_faults_in_any_world():
    rng = np.random.default_rng(0)
    for rig in (STUDIO, north(1e5), fan(), *map(arrangement, ARRANGEMENTS_DEG)):
        assert rig_faults(rig) == []
        for _ in range(5):
            some = rig.subset(rng.choice(rig.names, rng.integers(3, len(rig) + 1), replace=False))
            assert rig_faults(in_another_world(some, rng)) == []


def test_strong_but_real_lenses_and_fisheyes_have_no_faults():
    wide = relensed(STUDIO, lambda k: replace(k, fx=600.0, fy=600.0))
    assert rig_faults(lensed(wide, "cam03", Distortion(k1=-0.3, k2=0.1, k3=-0.015))) == []
    assert rig_faults(lensed(STUDIO, "cam03", Distortion(k1=0.5, k2=-0.3))) == []
    width = STUDIO["cam05"].intrinsics.width
    for share in (1.2, 0.5, 0.26):  # of the picture's width; the last sees 220 degrees
        fisheye = RecordedLens("kannala-brandt", (-0.03, 0.011, -0.004, 0.0007))
        assert rig_faults(recorded(fisheye, fx=share * width, fy=share * width)) == []
    assert rig_faults(recorded(RecordedLens("rational", (0.12, -0.05, 1e-3, -8e-4, 0.01, 0.31, 0.02, 0.003)))) == []


ONE_PLACE = reposed(STUDIO, lambda pose: RigidTransform(pose.rotation, -pose.rotation @ np.array([1.0, 2.0, 3.0])))
TOO_LARGE = "*translations must be in millimetres: "
FAULTS = {
    **{
        f"k1 of {k1:g}": (lensed(STUDIO, "cam05", Distortion(k1=k1)), "cam05: the lens is absurd (k1 = *")
        for k1 in (50.0, -50.0, 1e6)
    },
    "a fisheye of 1e11": (
        recorded(RecordedLens("kannala-brandt", (1e11, 0.0, 0.0, 0.0))),
        "cam05: the lens is absurd (k1 = 1e+11, k2 = 0, k3 = 0, k4 = 0*",
    ),
    "a fisheye of -30": (
        recorded(RecordedLens("kannala-brandt", (-30.0, 0.0, 0.0, 0.0))),
        "cam05: the lens is absurd (k1 = -30*",
    ),
    "a rational lens": (
        recorded(RecordedLens("rational", (0.0, 0.0, 0.0, 0.0, 0.0, -1000.0, 0.0, 0.0))),
        "cam05: the lens is absurd (k1 = *k4 = -1000*",
    ),
    "no principal points": (
        relensed(STUDIO, lambda k: replace(k, cx=0.0, cy=0.0)),
        "every principal point (cx, cy) is 0*",
    ),
    "shares of the picture": (
        relensed(STUDIO, lambda k: replace(k, fx=1.2, fy=1.6, cx=0.5, cy=0.5)),
        "fx, fy, cx and cy are fractions of the pictures' size*",
    ),
    **{
        f"pictures of {size} times the size": (
            of_other_size(size),
            f"the intrinsics are of pictures {size:.2f} times as large*by {1 / size:.2f},*",
        )
        for size in (2.0, 0.5, 0.25)
    },
    **{
        name: (scaled(1 / unit), f"*look like {name}*multiply them by {unit}*")
        for unit, name in ((10, "centimetres"), (100, "decimetres"), (1000, "metres"))
    },
    "centimetres or inches": (scaled(1 / 10), "*multiply them by 10, or by 25.4 if they are*"),
    "inches or centimetres": (scaled(1 / 25.4), "*multiply them by 25.4, or by 10 if they are*"),
    "100 times too far": (scaled(100), f"{TOO_LARGE}divide their translations by 100"),
    "1000 times too far": (scaled(1000), f"{TOO_LARGE}divide their translations by 1000"),
    "1e8 times too far": (scaled(1e8), f"{TOO_LARGE}look for one that is wrong"),
    "coordinates on the globe": (north(5.3e9), "*5.3e+03 km from the world's origin*"),  # of which meshes hold 24 bits
    "all at one place": (ONE_PLACE, "*every camera stands at one place*"),
}


@pytest.mark.parametrize(("rig", "sentence"), FAULTS.values(), ids=FAULTS)
def test_a_fault_of_the_whole_rig_or_of_one_lens_is_one_sentence(rig, sentence):
    (fault,) = rig_faults(rig)
    assert fnmatchcase(fault.text, sentence)


def test_a_focal_length_in_mm_is_named_and_not_its_lens():
    in_mm = relensed(STUDIO, lambda k: replace(k, fx=50.0, fy=50.0))
    for camera, fault in zip(STUDIO, rig_faults(in_mm), strict=True):
        assert fault.text.startswith(f"{camera.name}: a focal length of 50 px is absurd")


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
    for rig in (STUDIO, in_another_world(STUDIO, rng), arrangement("a")):
        (fault,) = rig_faults(reposed(rig, written))
        assert word in fault.text
