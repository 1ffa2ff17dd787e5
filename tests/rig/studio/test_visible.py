"""Points that cameras see, where geometry knows which they are: two spheres, one before the other."""

import numpy as np
import pytest
import trimesh

from rig.mesh import Mesh
from rig.studio.scene.layout import default_layout
from rig.studio.scene.visible import AREA_MM2, LEAST_FACING, PARTS, part_masks, sample_surface, visible_points

SMALL, LARGE = 20.0, 80.0
AHEAD = np.array([0.0, 0.0, 150.0])  # of the large sphere's middle


def ball(radius: float, centre: np.ndarray) -> Mesh:
    made = trimesh.creation.icosphere(5, radius)
    return Mesh(np.asarray(made.vertices) + centre, np.asarray(made.faces, np.int32))


def misses(eye: np.ndarray, points: np.ndarray, margin: float) -> np.ndarray:
    """Rays from an eye to points that pass the small sphere at a distance (negative ``margin``: within it)."""
    rays = points - eye
    along = ((AHEAD - eye) * rays).sum(1) / (rays * rays).sum(1)
    return np.linalg.norm(eye + along[:, None] * rays - AHEAD, axis=1) > SMALL + margin


def test_samples_are_even_and_face_outwards() -> None:
    points, normals = sample_surface(ball(LARGE, np.zeros(3)), AREA_MM2, np.random.default_rng(0))
    assert len(points) == pytest.approx(4 * np.pi * LARGE**2 / AREA_MM2, rel=0.01)
    assert (normals * points).sum(1).min() > 0.999 * LARGE
    assert np.linalg.norm(points.mean(0)) < 3 * LARGE / np.sqrt(len(points))


@pytest.mark.gl
def test_views_are_the_cameras_that_a_sphere_faces_and_nothing_hides(renderer) -> None:
    rig = default_layout().scaled(0.5)
    surfaces = {"head": ball(LARGE, np.zeros(3)), "hair": ball(SMALL, AHEAD)}
    seen = visible_points(rig, surfaces, renderer=renderer, rng=np.random.default_rng(0))
    assert seen.views.min() == 2
    for code, (name, centre) in enumerate((("head", np.zeros(3)), ("hair", AHEAD))):
        assert PARTS[code] == name
        points, views = seen.points[seen.part == code].astype(float), seen.views[seen.part == code]
        outwards = points - centre
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        least, most = np.zeros(len(points), int), np.zeros(len(points), int)
        for camera in rig:
            towards = camera.centre_world - points
            facing = (outwards * towards).sum(1) / np.linalg.norm(towards, axis=1)
            clear = name == "hair"
            least += (facing > LEAST_FACING + 0.03) & (clear | misses(camera.centre_world, points, 1.5))
            most += (facing > LEAST_FACING - 0.03) & (clear | misses(camera.centre_world, points, -1.5))
        assert (views >= least).all()
        assert (views <= most).all()


@pytest.mark.gl
def test_part_masks_name_the_nearest_surface_and_call_strands_hair(renderer) -> None:
    rig = default_layout().subset(["cam00", "cam09"]).scaled(0.25)
    surfaces = {"head": ball(LARGE, np.zeros(3)), "clothes": ball(SMALL, AHEAD)}
    size = (rig["cam00"].intrinsics.height, rig["cam00"].intrinsics.width)
    masks = {"cam00": np.ones(size, bool), "cam09": np.zeros(size, bool)}
    found = part_masks(rig, surfaces, masks, renderer=renderer)
    assert not found["cam09"].any()
    at = rig["cam00"].project(np.array([AHEAD, (0.9 * LARGE, 0.0, 0.0)]))
    (small, large) = np.rint(at).astype(int)
    assert found["cam00"][small[1], small[0]] == 3
    assert found["cam00"][large[1], large[0]] == 1
    assert found["cam00"][2, 2] == 2  # covered, by no surface
