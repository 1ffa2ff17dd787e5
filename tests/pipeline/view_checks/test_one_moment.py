"""Views of another moment or of another person are found by the face's picture: on a painted face whose truth is known
to the millimetre, and on heads in the studio."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from scipy.spatial import Delaunay

from pipeline.faces.detection import FaceDetection
from pipeline.faces.matching import match_faces
from pipeline.faces.networks import load_networks
from pipeline.faces.points import point_table
from pipeline.faces.subject import SubjectFaces, find_subject
from pipeline.head_model.model import load_model
from pipeline.view_checks.one_moment import MAX_OFFSET_MM, check_one_moment, without_views
from rig.camera import Camera
from rig.geometry import Similarity
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject, random_look
from rig.studio.sensor.preset import PRESET

SHAPE = point_table().shape_mm
FIVE = default_layout().scaled(0.5).subset(["cam00", "cam03", "cam04", "cam05", "cam06"])
THREE = FIVE.subset(["cam00", "cam05", "cam06"])
Pictures = dict[str, ImageRgb]


def paint(camera: Camera, moved_mm: Float[np.ndarray, " 3"], seed: int = 0) -> ImageRgb:
    """A picture of a mean face with specks of 4 mm; each seed is another person's skin. 0.4 mm between its points
    leaves no pixel of 1 mm without one."""
    grid = np.stack(np.meshgrid(np.arange(-70.0, 70.0, 0.4), np.arange(-85.0, 90.0, 0.4)), axis=-1)
    mesh = Delaunay(SHAPE[:, :2])
    flat = grid.reshape(-1, 2)
    triangle = mesh.find_simplex(flat)
    two = np.einsum("nij,nj->ni", mesh.transform[triangle, :2], flat - mesh.transform[triangle, 2])
    weights = np.column_stack([two, 1.0 - two.sum(axis=1)])
    points = (weights[..., None] * SHAPE[mesh.simplices[triangle]]).sum(axis=1) + moved_mm
    specks = gaussian_filter(np.random.default_rng(seed).standard_normal(grid.shape[:2]), 10.0)
    values = 128.0 + 40.0 * (specks / specks.std()).reshape(-1)
    k = camera.intrinsics
    pixels = np.rint(camera.project(points)).astype(int)
    shown = (triangle >= 0) & (pixels >= 0).all(axis=1) & (pixels < (k.width, k.height)).all(axis=1)
    total, count = np.zeros((k.height, k.width)), np.zeros((k.height, k.width))
    np.add.at(total, tuple(pixels[shown, ::-1].T), values[shown])
    np.add.at(count, tuple(pixels[shown, ::-1].T), 1.0)
    grey = np.where(count > 0, total / np.maximum(count, 1.0), 60.0)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def shot(
    rig: Rig, moved_mm: Mapping[str, tuple[float, float, float]], others: frozenset[str] = frozenset()
) -> tuple[SubjectFaces, Pictures]:
    """The faces and pictures of one shot, in which the face of some cameras is elsewhere or another person's."""
    images, found = {}, {}
    for camera in rig:
        step = np.array(moved_mm.get(camera.name, (0.0, 0.0, 0.0)))
        images[camera.name] = paint(camera, step, 1 if camera.name in others else 0)
        pixels = camera.project(SHAPE + step)
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        found[camera.name] = (FaceDetection(pixels, np.zeros(468), 40.0, box, 0.0),)
    return SubjectFaces(found, match_faces(found, rig), rig.names), images


@pytest.mark.parametrize("rig", [FIVE, THREE], ids=["five", "three"])
def test_views_of_one_moment_are_not_named(rig: Rig) -> None:
    subject, images = shot(rig, {})
    assert check_one_moment(subject, images, rig).odd == ()


def test_a_face_that_moved_is_named_with_how_far() -> None:
    subject, images = shot(FIVE, {"cam03": (0.0, 10.0, 0.0)})
    check = check_one_moment(subject, images, FIVE)
    assert [view.camera for view in check.odd] == ["cam03"]
    assert check.certain
    # Across the face, to half a cell of a drawing and what the landmarks' noise of 1.2 mm leaves.
    assert check.odd[0].offset_mm == pytest.approx(10.0, abs=2.0)


def test_the_points_without_the_view_are_those_of_the_others() -> None:
    subject, _ = shot(FIVE, {"cam03": (0.0, 10.0, 0.0)})
    alone, _ = shot(FIVE.subset([name for name in FIVE.names if name != "cam03"]), {})
    left = without_views(subject, ["cam03"], FIVE).matched
    assert left is not None
    assert alone.matched is not None
    assert "cam03" not in left.detections
    np.testing.assert_allclose(left.points_world, alone.matched.points_world, atol=1e-6)


def test_another_person_who_sits_elsewhere_is_named() -> None:
    subject, images = shot(FIVE, {"cam04": (14.0, -12.0, 5.0)}, frozenset({"cam04"}))
    check = check_one_moment(subject, images, FIVE)
    assert [view.camera for view in check.odd] == ["cam04"]
    assert check.odd[0].offset_mm > MAX_OFFSET_MM


def test_two_views_that_contradict_each_other_are_both_doubtful() -> None:
    rig = FIVE.subset(["cam00", "cam03"])
    subject, images = shot(rig, {"cam03": (0.0, 8.0, 0.0)})
    check = check_one_moment(subject, images, rig)
    assert {view.camera for view in check.odd} == set(rig.names)
    assert not check.certain


@pytest.mark.slow
@pytest.mark.gl
def test_a_jaw_that_opened_and_a_head_that_moved_are_named_in_the_studio(renderer: Renderer) -> None:
    model, networks = load_model(), load_networks()
    full, look = model.levels["full"], random_look(np.random.default_rng(5))

    def photograph(cameras: Rig, weights: Mapping[str, float], moved_mm: float) -> Mapping[str, ImageRgb]:
        vertices = model.posed_vertices(np.zeros(0), weights)
        marks = {name: vertices[row] for name, row in model.landmarks.items()}
        subject = Subject(Mesh(vertices, full.faces), marks, full.face_region)
        pose = Similarity(1.0, np.eye(3), np.array([moved_mm, 0.0, 0.0]))
        preset = replace(PRESET, plates=1)
        rng = np.random.default_rng(3)
        return simulate(
            subject, cameras, preset, rng, renderer=renderer, look=look, world_from_head=pose
        ).capture.images

    clean = photograph(FIVE, {}, 0.0)
    front = FIVE.subset(["cam00"])
    for weights, moved_mm, part in (({}, 0.0, None), ({}, 10.0, "face"), ({"jawOpen": 1.0}, 0.0, "mouth")):
        images = {**clean, **(photograph(front, weights, moved_mm) if part else {})}
        check = check_one_moment(find_subject(images, FIVE, networks), images, FIVE)
        assert [(view.camera, view.part) for view in check.odd] == ([("cam00", part)] if part else [])
