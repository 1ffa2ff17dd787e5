"""Irises in space, of eyes that are traced ray by ray: where they are, where they look, and why one is not seen."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float

from pipeline.faces.detection import FaceDetection
from pipeline.faces.irises import (
    BEHIND_MM,
    EYEBALL_MM,
    Iris,
    UnseenEye,
    find_irises,
    looking_together,
    pupils_px,
    reject_gazes,
)
from pipeline.faces.limbus import EyeView
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.points import LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS
from rig.camera import Camera, Intrinsics
from rig.colour_space import srgb_from_linear
from rig.geometry import RigidTransform, Similarity, look_at, rotation_from_vector
from rig.image import ImageRgb
from rig.rig import Rig

SKIN, WHITE, BROWN, PUPIL = (0.44, 0.27, 0.19), (0.50, 0.47, 0.44), (0.10, 0.055, 0.025), (0.01, 0.01, 0.01)
LIMBUS_MM, HALF_LENGTH_MM, HALF_HEIGHT_MM = 5.85, 14.0, 5.5
CENTRES = {"right": np.array([-31.0, 0.0, -10.0]), "left": np.array([32.0, 0.5, -10.0])}
TARGET = np.array([150.0, -60.0, 1100.0])
DIRECTIONS = ((0.0, 0.0), (0.0, 0.6), (0.0, -0.6), (0.55, 0.1), (-0.55, 0.1))
SIZE = (320, 140)


def gaze_of(side: str, target: Float[np.ndarray, " 3"] = TARGET) -> Float[np.ndarray, " 3"]:
    away = target - CENTRES[side]
    return away / np.linalg.norm(away)


def studio(count: int = 5, focal_px: float = 2100.0) -> Rig:
    """Cameras 1.2 m away, x to the subject's left, y up."""
    width, height = SIZE
    lens = Intrinsics(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    towards = [np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)]) for a, b in DIRECTIONS[:count]]
    poses = [look_at(1200.0 * away, np.zeros(3), np.array([0.0, 1.0, 0.0])) for away in towards]
    return Rig(tuple(Camera(f"cam{k}", lens, pose) for k, pose in enumerate(poses)))


def lid_edges(side: str) -> Float[np.ndarray, "16 3"]:
    """The edges of an eye's lids, in the plane of its corners, in the order of the network."""
    outwards = -1.0 if side == "right" else 1.0
    along = np.concatenate([np.linspace(1.0, -1.0, 9), np.linspace(1.0, -1.0, 9)[1:-1]]) * outwards
    sign = np.concatenate([-np.ones(9), np.ones(7)])
    height = HALF_HEIGHT_MM * sign * (1.0 - along**2)
    return CENTRES[side] + np.stack([HALF_LENGTH_MM * along, height, np.full(16, EYEBALL_MM - 2.0)], axis=1)


def picture(camera: Camera, rng: np.random.Generator, gazes: Mapping[str, np.ndarray], *, irises: bool) -> ImageRgb:
    """What a camera sees: a plane of skin with two holes, behind each a ball."""
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays, eye = camera.rays_world(np.stack([x.ravel(), y.ravel()], axis=1).astype(float)), camera.centre_world
    colour = np.tile(SKIN, (len(rays), 1))
    for side, centre in CENTRES.items():
        plane = eye + ((centre[2] + EYEBALL_MM - 2.0 - eye[2]) / rays[:, 2])[:, None] * rays - centre
        hole = np.abs(plane[:, 1]) < HALF_HEIGHT_MM * (1.0 - (plane[:, 0] / HALF_LENGTH_MM) ** 2)
        nearest = (centre - eye) @ rays.T
        depth = EYEBALL_MM**2 - ((centre - eye) ** 2).sum() + nearest**2
        seen = hole & (depth > 0.0) & irises
        at = eye + (nearest - np.sqrt(np.maximum(depth, 0.0)))[:, None] * rays - centre
        off = np.linalg.norm(np.cross(at, gazes[side]), axis=1) + 100.0 * (at @ gazes[side] < 0.0)
        inside = np.clip((LIMBUS_MM + 0.35 - off) / 0.7, 0.0, 1.0)[:, None]
        ball = np.array(WHITE) + inside * (np.array(BROWN) - np.array(WHITE))
        ball[off < 2.0] = PUPIL
        colour[seen] = ball[seen]
    levels = 255.0 * srgb_from_linear(colour) + rng.normal(0.0, 3.0, colour.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8).reshape(height, width, 3)


def scene(
    rig: Rig, *, target: Float[np.ndarray, " 3"] = TARGET, irises: bool = True
) -> tuple[MatchedFaces, dict[str, ImageRgb]]:
    """The face as the networks would place it, to two pixels, and its pictures."""
    rng, gazes = np.random.default_rng(5), {side: gaze_of(side, target) for side in CENTRES}
    points = np.zeros((468, 3))
    faces = {}
    for side, corners in (("right", RIGHT_EYE_CORNERS), ("left", LEFT_EYE_CORNERS)):
        points[list(corners)] = lid_edges(side)[[0, 8]] + rng.normal(0.0, 1.5, (2, 3))
    for camera in rig:
        marks = [CENTRES[side] + BEHIND_MM * gazes[side] for side in CENTRES for _ in range(5)]
        found = camera.project(np.array(marks)) + rng.normal(0.0, 1.0, (10, 2))
        lids = camera.project(np.concatenate([lid_edges(side) for side in CENTRES])) + rng.normal(0.0, 0.8, (32, 2))
        empty = np.zeros((468, 2))
        faces[camera.name] = FaceDetection(empty, 30.0, np.zeros(4), 0.0, found, lids)
    none = np.zeros((468, 3, 3))
    face = MatchedFaces(faces, {}, {}, {}, {}, points, none, np.zeros((0, 468, 3)), {}, Similarity.identity(), 1.0)
    return face, {camera.name: picture(camera, rng, gazes, irises=irises) for camera in rig}


def angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0))))


@pytest.mark.parametrize(
    "target", [(150.0, -60.0, 1100.0), (-300.0, 100.0, 900.0), (0.0, 0.0, 450.0), (650.0, -60.0, 1100.0)]
)
def test_irises_are_where_they_are_and_look_where_they_look(target: tuple[float, float, float]) -> None:
    rig = studio()
    face, images = scene(rig, target=np.array(target))
    for side, iris in find_irises(face, images, rig, frozenset()).items():
        assert isinstance(iris, Iris)
        gaze = gaze_of(side, np.array(target))
        off = iris.centre - CENTRES[side] - BEHIND_MM * gaze
        assert np.linalg.norm(off) < 0.3
        assert (np.abs(off) < 4.0 * iris.centre_std_mm).all()
        assert angle_deg(iris.gaze, gaze) < min(3.0, 4.0 * iris.gaze_std_deg)
        assert iris.radius_mm == pytest.approx(LIMBUS_MM, abs=0.2)
        assert np.linalg.norm(iris.eyeball - CENTRES[side]) < 0.6
        assert len(iris.views) >= 3


def test_an_eye_that_is_not_seen_says_why() -> None:
    rig = studio()
    face, images = scene(rig)
    found = find_irises(face, images, rig, frozenset({"left"}))
    assert found["left"] == UnseenEye("closed")
    assert isinstance(found["right"], Iris)
    alone = replace(face, detections={"cam0": face.detections["cam0"]})
    assert find_irises(alone, images, rig, frozenset())["right"] == UnseenEye("few-views")
    coarse = studio(focal_px=700.0)
    assert find_irises(*scene(coarse), coarse, frozenset())["left"] == UnseenEye("coarse")
    assert find_irises(*scene(rig, irises=False), rig, frozenset())["right"] == UnseenEye("unclear")


def iris(azimuth_deg: float, elevation_deg: float) -> Iris:
    """An iris that looks so, known to 2 degrees."""
    covariance = np.diag([0.1] * 3 + [np.radians(2.0)] * 3 + [0.1]) ** 2
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    gaze = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    return Iris(np.zeros(3), gaze, 5.85, covariance, ("cam0", "cam1"))


def test_gazes_that_nobody_has_are_not_told() -> None:
    ahead, none = np.array([0.0, 0.0, 1.0]), UnseenEye("unclear")
    pair = {"right": iris(5.0, 0.0), "left": iris(-5.0, 0.0)}
    assert reject_gazes(pair, ahead) == pair
    assert reject_gazes({"right": iris(7.0, 0.0), "left": iris(-7.0, 0.0)}, ahead) == {"right": none, "left": none}
    alone = {"right": UnseenEye("closed"), "left": iris(0.0, 18.0)}
    assert reject_gazes(alone, ahead) == alone
    assert reject_gazes({"right": UnseenEye("closed"), "left": iris(0.0, 25.0)}, ahead) == alone | {"left": none}
    both_up = {"right": iris(0.0, 25.0), "left": iris(0.0, 25.0)}  # the one confirms the other
    assert reject_gazes(both_up, ahead) == both_up
    assert reject_gazes({"right": none, "left": none}, ahead) == {"right": none, "left": none}


def test_eyes_help_each_other_unless_they_squint() -> None:
    right, left = looking_together(iris(1.5, 2.0), iris(-1.5, -2.0), np.eye(3))
    elevations = np.degrees(np.arcsin([right.gaze[1], left.gaze[1]]))
    np.testing.assert_allclose(elevations, (0.22, -0.22), atol=0.02)  # 2 degrees each beside 1 between them
    assert right.gaze_std_deg < iris(0.0, 0.0).gaze_std_deg
    squint = iris(1.5, 9.0), iris(-1.5, -9.0)
    assert looking_together(*squint, np.eye(3)) == squint


@pytest.mark.slow
def test_the_gaze_turns_with_the_world() -> None:
    turn = rotation_from_vector(np.array([0.3, -1.1, 0.4]))
    motion = RigidTransform(turn, np.array([30.0, -500.0, 90.0]))
    rig = studio()
    face, images = scene(rig)
    there = find_irises(face, images, rig, frozenset())["right"]
    moved = Rig(tuple(replace(camera, camera_from_world=camera.camera_from_world @ motion.inverse()) for camera in rig))
    turned = replace(
        face,
        points_world=motion.apply(face.points_world),
        world_from_face=Similarity(1.0, motion.rotation, motion.translation),
    )
    here = find_irises(turned, images, moved, frozenset())["right"]
    assert isinstance(there, Iris)
    assert isinstance(here, Iris)
    np.testing.assert_allclose(here.centre, motion.apply(there.centre[None])[0], atol=0.02)
    np.testing.assert_allclose(here.gaze, motion.rotation @ there.gaze, atol=0.005)


SIDE_PX, FOCAL_PX, AWAY_MM = 80, 2400.0, 1200.0  # 2 px/mm
AXES = np.eye(3)[:2]
IRIS_LIGHT, PUPIL_LIGHT, WHITE_LIGHT, LAMP_LIGHT = 0.15, 0.02, 1.0, 3.0  # brightness, by the white's


def eye(
    pupil_mm: tuple[float, float], *, dark: float = PUPIL_LIGHT, lamp_mm: tuple[float, float] | None = None
) -> EyeView:
    """An eye in the plane z = 0, straight ahead, as a view has it."""
    middle = (SIDE_PX - 1) / 2
    lens = Intrinsics(SIDE_PX, SIDE_PX, FOCAL_PX, FOCAL_PX, middle, middle)
    pose = look_at(np.array([0.0, 0.0, AWAY_MM]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    x, y = np.meshgrid(np.arange(SIDE_PX) - middle, middle - np.arange(SIDE_PX))
    across, up = x * AWAY_MM / FOCAL_PX, y * AWAY_MM / FOCAL_PX
    brightness = np.where(np.hypot(across, up) < 5.85, IRIS_LIGHT, WHITE_LIGHT)
    brightness[np.hypot(across - pupil_mm[0], up - pupil_mm[1]) < 2.0] = dark
    if lamp_mm is not None:
        brightness[np.hypot(across - lamp_mm[0], up - lamp_mm[1]) < 0.5] = LAMP_LIGHT
    plane = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    return EyeView(Camera("cam0", lens, pose), np.zeros(2), brightness.astype(np.float32), plane, plane)


@pytest.mark.parametrize("highlight", [None, (-1.2, 1.0)])
def test_a_pupil_is_found_beside_a_highlight(highlight: tuple[float, float] | None) -> None:
    views = [eye(place, lamp_mm=highlight) for place in ((0.6, -0.4), (-0.5, 0.3))]
    found = pupils_px(views, np.zeros(3), AXES)
    for view, place, pixel in zip(views, ((0.6, -0.4), (-0.5, 0.3)), found, strict=True):
        assert pixel is not None
        assert np.linalg.norm(pixel - view.camera.project(np.array([[*place, 0.0]]))[0]) < 0.5


def test_an_iris_without_a_pupil_has_none() -> None:
    assert pupils_px([eye((0.0, 0.0), dark=IRIS_LIGHT)], np.zeros(3), AXES) == [None]
    assert pupils_px([], np.zeros(3), AXES) == []
