"""The subject's face through a whole rig: drawn heads and posters as cameras see them, and real recordings."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Float

from pipeline.faces.landmark_map import LandmarkMap, built_in_map
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.networks import FaceNetworks, load_networks
from pipeline.faces.points import point_table
from pipeline.faces.subject import DISTANCE_SHARE, find_subject, match_alone, place_from_one_view
from rig.camera import Camera, Distortion, Intrinsics
from rig.capture import ImageRgb
from rig.formats.cameras.cameras_file import read_rig_file
from rig.formats.captures.capture_folder import read_capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.pictures.images import read_image
from rig.geometry import RigidTransform, Similarity, look_at, rotation_from_vector, vector_from_rotation
from rig.rig import Rig
from tests.support.drawn_faces import EYES_MM, photographed_face, relief_mm, seen_face
from tests.support.shared_data import shared

ICT_VERTICES = 11248  # come first in the truths that are drawn from ICT-FaceKit
EVERY = 9
DIRECTIONS_DEG = ((0, 0), (-30, 5), (30, 10), (0, 25), (-50, 0), (180, 0))
HEAD = Similarity(1.0, rotation_from_vector(np.array([0.05, 0.1, 0.0])), np.array([5.0, -10.0, 0.0]))


def studio() -> Rig:
    """Five cameras around the front, and one behind."""
    cameras = []
    for k, (azimuth, elevation) in enumerate(np.radians(DIRECTIONS_DEG)):
        away = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        pose = look_at(1000.0 * away, np.zeros(3), np.array([0.0, 1.0, 0.0]))
        size = (480, 640) if k == 2 else (640, 480)
        lens = Intrinsics(*size, 900.0, 900.0, (size[0] - 1) / 2, (size[1] - 1) / 2)
        cameras.append(Camera(f"cam{k}", lens, pose))
    return Rig(tuple(cameras))


@pytest.fixture(scope="module")
def pictures() -> dict[str, ImageRgb]:
    return {camera.name: photographed_face(camera, HEAD) for camera in studio()}


def eyes_world() -> np.ndarray:
    x, y = np.array(EYES_MM).T
    return HEAD.apply(np.stack([x, y, relief_mm(x, y)], axis=1))


def assert_on_eyes(points_world: np.ndarray, tolerance_mm: float = 9.0) -> None:
    found = np.stack([points_world[[33, 133]].mean(axis=0), points_world[[362, 263]].mean(axis=0)])
    # A drawn head is no member of a population: the network's idea of a face is 3 to 6 mm off.
    assert np.linalg.norm(found - eyes_world(), axis=1).max() < tolerance_mm


def test_a_head_is_found_in_all_views_but_from_behind(networks: FaceNetworks, pictures: dict[str, ImageRgb]) -> None:
    found = find_subject(pictures, studio(), networks)
    assert found.matched is not None
    assert set(found.matched.detections) == set(found.expected) == {"cam0", "cam1", "cam2", "cam3", "cam4"}
    assert_on_eyes(found.matched.points_world)
    assert np.degrees(np.arccos(found.matched.facing_world @ HEAD.rotation[:, 2])) < 5.0
    assert 0.7 < found.matched.relief < 1.4
    front = found.matched.detections["cam0"]
    assert front.irises_px is not None
    drawn = studio()["cam0"].project(eyes_world())
    assert np.linalg.norm(front.irises_px[[0, 5]] - drawn, axis=1).max() < 4.0
    again = find_subject(pictures, studio(), load_networks()).matched
    assert again is not None
    assert again.points_world.tobytes() == found.matched.points_world.tobytes()
    assert again.covariances.tobytes() == found.matched.covariances.tobytes()


def test_a_poster_alone_is_nobody(networks: FaceNetworks) -> None:
    rig = studio()
    poster = Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -50.0]))
    found = find_subject({c.name: photographed_face(c, poster, flat=True) for c in rig}, rig, networks)
    assert sum(map(bool, found.found.values())) >= 3  # it is seen, and told to be flat
    assert found.matched is None


@pytest.mark.parametrize("names", [("cam0", "cam1"), ("cam1", "cam2"), ("cam3", "cam4"), ("cam0", "cam2", "cam5")])
def test_a_few_views_are_enough(networks: FaceNetworks, pictures: dict[str, ImageRgb], names: tuple[str, ...]) -> None:
    found = find_subject({name: pictures[name] for name in names}, studio(), networks)
    assert found.matched is not None
    assert set(found.matched.detections) == set(names) - {"cam5"}
    # A view is off by 0.6 % of a face and more, 1.5 mm; rays that meet at 30 degrees make 5 mm of depth of it, twice.
    assert_on_eyes(found.matched.points_world, 15.0)


def test_pictures_without_a_face_have_none_and_no_pictures_neither(networks: FaceNetworks) -> None:
    rig = studio()
    empty = {c.name: np.full((c.intrinsics.height, c.intrinsics.width, 3), 120, np.uint8) for c in rig}
    found = find_subject(empty, rig, networks)
    assert (found.matched, found.expected, any(found.found.values())) == (None, (), False)
    found = find_subject({}, studio(), networks)
    assert (dict(found.found), found.matched, found.expected) == ({}, None, ())


def test_one_view_alone_tells_how_the_face_is_turned(networks: FaceNetworks, pictures: dict[str, ImageRgb]) -> None:
    """The face in one view of a ring, hair in the others: where it looks is known, its distance by its size."""
    found = find_subject({name: pictures[name] for name in ("cam0", "cam5")}, studio(), networks)
    assert len(found.found["cam0"]) == 1
    assert found.matched is not None
    assert set(found.matched.detections) == {"cam0"}
    placed = found.matched.world_from_face
    assert np.degrees(np.arccos(placed.rotation[:, 2] @ HEAD.rotation[:, 2])) < 15.0
    assert np.linalg.norm(placed.translation[:2] - HEAD.apply(np.zeros((1, 3)))[0, :2]) < 25.0


@pytest.mark.slow
def test_small_faces_are_found_where_none_is_large(networks: FaceNetworks) -> None:
    """At twice the distance in pictures of twice the size: a sixteenth of their width."""
    cameras = []
    for name, azimuth in (("left", -0.2), ("right", 0.2)):
        pose = look_at(
            2500.0 * np.array([np.sin(azimuth), 0.0, np.cos(azimuth)]), np.zeros(3), np.array([0.0, 1.0, 0.0])
        )
        cameras.append(Camera(name, Intrinsics(1280, 960, 800.0, 800.0, 639.5, 479.5), pose))
    rig = Rig(tuple(cameras))
    found = find_subject({camera.name: photographed_face(camera, HEAD) for camera in rig}, rig, networks)
    assert found.matched is not None
    assert found.matched.detections["left"].size_px < 90.0


def test_progress_is_told_and_may_end_the_search(networks: FaceNetworks, pictures: dict[str, ImageRgb]) -> None:
    shares: list[float] = []
    find_subject(pictures, studio(), networks, report=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0

    def stop(share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_subject(pictures, studio(), networks, report=stop)


def chi_square(
    found: MatchedFaces, of_model: LandmarkMap, true: Float[np.ndarray, "468 3"], axes: Float[np.ndarray, "3 3"]
) -> float:
    """Squares of errors by their covariance, a degree of freedom: of each point's own noise, each view's, and the
    map's. Of every ``EVERY``-th point that does not slide: with all, a covariance of few modes would be rounding."""
    which = np.flatnonzero(~of_model.slides)[::EVERY]
    errors = (found.points_world - true)[which] @ axes - of_model.offset_mm[which]
    views = (found.shared_mm[:, which] @ axes).reshape(len(found.shared_mm), -1)
    of_points = np.zeros((len(which), 3, len(which), 3))
    of_points[np.arange(len(which)), :, np.arange(len(which)), :] = axes.T @ found.covariances[which] @ axes
    covariance = of_model.covariance(which) + views.T @ views + of_points.reshape(errors.size, -1)
    return float(errors.ravel() @ np.linalg.solve(covariance, errors.ravel()) / errors.size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fewest", "names"),
    [
        ("draw-b", 10, None),
        ("beard-smile", 10, None),
        ("three-brows", 3, None),
        ("circle-hair", 8, None),
        ("draw-b", 3, ("cam00", "cam03", "cam04")),
        ("beard-smile", 2, ("cam00", "cam05")),
        ("circle-hair", 3, ("cam01", "cam07", "cam13", "cam19", "cam22", "cam04")),
    ],
)
def test_points_lie_on_true_heads_as_well_as_they_say(name: str, fewest: int, names: tuple[str, ...] | None) -> None:
    """Captures of another renderer, of heads that the tables were not measured on: the views that were found, and
    errors against each point's own place on the true head, by their covariance."""
    folder = shared("data/captures")
    capture, rig = read_capture(folder / name)
    images = {camera: image for camera, image in capture.images.items() if names is None or camera in names}
    found = find_subject(images, rig, load_networks()).matched
    assert found is not None
    assert len(found.detections) >= fewest
    truth = folder / f"{name}.truth"
    of_model = built_in_map("ict-facekit")
    axes = np.array(json.loads((truth / "meta.json").read_text())["world_from_head"]["rotation"])
    true = of_model.points(read_mesh(truth / "head.ply").vertices[:ICT_VERTICES])
    assert np.median(np.linalg.norm(found.points_world - true, axis=1)) < 5.0
    # 1 where the covariance is right; its noise is measured at wide angles, and views that are near err alike.
    assert 0.2 < chi_square(found, of_model, true, axes) < 1.5


@pytest.mark.slow
def test_a_living_person_before_four_cameras() -> None:
    """A man who holds a board before four cameras: found in every moment in which two of them see his face, and as
    large each time. Eyes' middles are 62 to 70 mm apart in most men."""
    folder = shared("data/multicam-board")
    rig = read_rig_file(folder / "camera_array.toml")
    networks, distances, missed = load_networks(), [], []
    for shot in range(0, 26, 2):
        images = {name: read_image(folder / name / f"shot{shot:02}.jpg") for name in rig.names}
        matched = find_subject(images, rig, networks).matched
        if matched is None:
            missed.append(shot)
        else:
            distances.append(matched.eye_distance_mm)
    assert set(missed) <= {18}  # the board hides his face from all but one
    assert 62.0 < np.median(distances) < 70.0
    assert np.std(distances) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True])
def test_a_statue_on_its_side_is_found_without_a_scale(turned: bool) -> None:
    """The plaster Buddha, grey pictures, most of them on their side; all of them turned once more."""
    from tests.support.published_poses import read_projections

    folder = shared("data/buddha")
    images, cameras = {}, []
    for name, matrix in list(read_projections(folder / "projections.json").items())[8:24]:
        image = read_image(folder / "images" / f"{name}.jpg")
        if turned:
            quarter = np.array([[0.0, -1.0, image.shape[0] - 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
            image, matrix = np.ascontiguousarray(np.rot90(image, -1)), quarter @ matrix
        images[name] = image
        cameras.append(_camera(name, matrix, image.shape))
    found = find_subject(images, Rig(tuple(cameras)), load_networks(), eye_distance_mm=None).matched
    assert found is not None
    assert len(found.detections) >= 3
    assert 0.6 < found.relief < 1.4


def _camera(name: str, matrix: np.ndarray, shape: tuple[int, ...]) -> Camera:
    """A projection matrix as a camera."""
    lens, motion, *_ = cv2.decomposeProjectionMatrix(matrix * np.sign(np.linalg.det(matrix[:, :3])))
    lens /= lens[2, 2]
    translation = np.linalg.solve(lens, matrix[:, 3] * np.sign(np.linalg.det(matrix[:, :3])))
    scale = np.linalg.norm(np.linalg.solve(lens, matrix[:, :3])[2])
    intrinsics = Intrinsics(shape[1], shape[0], lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2])
    return Camera(name, intrinsics, RigidTransform(motion, translation / scale))


LENS = Distortion(-0.12, 0.05, 1e-3, -8e-4, 0.01)
TURNS = ((0.0, 0.0, 0.0), (0.3, -0.4, 0.1), (-0.4, 0.7, 1.5), (0.1, 0.2, 3.0))


def camera() -> Camera:
    pose = look_at(np.array([200.0, 300.0, 1000.0]), np.array([20.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    return Camera("front", Intrinsics(1024, 768, 1500.0, 1480.0, 520.0, 377.0, LENS), pose)


@pytest.mark.parametrize("turn", TURNS)
def test_a_planted_pose_comes_back(turn: tuple[float, float, float]) -> None:
    face = Similarity(1.0, rotation_from_vector(np.array(turn)), np.array([30.0, -20.0, 10.0]))
    found = place_from_one_view(seen_face(face, camera(), np.random.default_rng(0)), camera())
    assert found is not None
    assert np.degrees(np.linalg.norm(vector_from_rotation(found.rotation.T @ face.rotation))) < 0.7
    # 468 points with 1 px of noise: a size to 0.02 %; the bias, taken off in three rounds, leaves more.
    assert np.linalg.norm(found.translation - face.translation) < 6.0
    assert found.scale == 1.0


def test_a_child_is_taken_for_an_adult_farther_away() -> None:
    child = Similarity(0.8, np.eye(3), np.zeros(3))
    found = place_from_one_view(seen_face(child, camera(), np.random.default_rng(0)), camera())
    assert found is not None
    away = np.linalg.norm(found.translation - camera().centre_world) / np.linalg.norm(camera().centre_world)
    assert abs(away - 1.0 / 0.8) < 0.02


def test_points_outside_the_lens_are_no_pose() -> None:
    """A lens whose model turns back at 1.1 of the focal length: nothing is seen beyond."""
    face = seen_face(Similarity.identity(), camera(), np.random.default_rng(0))
    narrow = replace(camera(), intrinsics=replace(camera().intrinsics, distortion=Distortion(k1=-0.28)))
    far_off = replace(face, landmarks_px=face.landmarks_px + (3000.0, 0.0))
    assert place_from_one_view(face, narrow) is not None
    assert place_from_one_view(far_off, narrow) is None
    assert match_alone("front", far_off, narrow) is None


def test_what_one_view_leaves_open_is_said() -> None:
    """Along the rays a tenth of the distance, across them what pixels leave: a child's points are among the likely."""
    child = Similarity(0.9, rotation_from_vector(np.array([0.1, -0.2, 0.0])), np.array([10.0, 5.0, 0.0]))
    found = match_alone("front", seen_face(child, camera(), np.random.default_rng(0)), camera())
    assert found is not None
    assert list(found.detections) == ["front"]
    modes = found.shared_mm.reshape(len(found.shared_mm), -1)
    error = found.points_world - child.apply(point_table().shape_mm)
    assert np.linalg.norm(error, axis=1).mean() > 90.0  # taken for an adult, farther away
    covariance = modes.T @ modes
    for k, block in enumerate(found.covariances):
        covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += block
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), error.ravel())
    assert (whitened**2).mean() < 2.0
    along = found.points_world - camera().centre_world
    assert np.allclose(found.shared_mm[0], DISTANCE_SHARE * along)
