"""The renderer against the numpy rasteriser of ``tests/support/oracles.py`` and against a sphere's known outline."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.camera import Camera, Distortion, Intrinsics
from rig.errors import InputError
from rig.geometry import RigidTransform, look_at
from rig.mesh import Mesh
from rig.render.context import WrongThread
from rig.render.renderer import HEADLIGHT, Renderer, is_closed
from rig.render.tile_packing import BLOCK_PX, ImageTooLarge, pack
from rig.rig import Rig
from tests.support import oracles

pytestmark = pytest.mark.gl

UP = np.array([0.0, 1.0, 0.0])
LENS = Distortion(-0.12, 0.05, 1e-3, -2e-3, 0.01)


def sphere(level: int, radius: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Closed, outward triangles, 20 * 4^level of them."""
    ball = trimesh.creation.icosphere(level, radius)
    return np.asarray(ball.vertices, float), np.asarray(ball.faces)


def fan(count: int, sizes=((160, 120),), lens: Distortion = LENS, focal: float = 1.6) -> Rig:
    """Cameras on an arc around the origin, sizes taken in turn, all with off-centre principal points."""
    cameras = []
    for i in range(count):
        width, height = sizes[i % len(sizes)]
        angle = 0.3 * (i - count / 2)
        centre = 900.0 * np.array([np.sin(angle), 0.15 * (i % 3 - 1), np.cos(angle)])
        intrinsics = Intrinsics(width, height, focal * width, focal * width, 0.47 * width, 0.52 * height, lens)
        cameras.append(Camera(f"cam{i:02}", intrinsics, look_at(centre, np.array([5.0, -8.0, 3.0]), UP)))
    return Rig(tuple(cameras))


def lumpy_head(level: int = 3) -> Mesh:
    """No symmetry left: a mirrored or turned picture cannot pass for the right one."""
    vertices, faces = sphere(level)
    unit = vertices / 100.0
    bump = 1 + 0.35 * np.exp(-8 * ((unit - (0.6, 0.3, 0.74)) ** 2).sum(1)) - 0.2 * unit[:, 1] ** 3 + 0.1 * unit[:, 0]
    return Mesh(vertices * bump[:, None] * (0.8, 1.2, 1.0), faces)


def ambiguous(mask: np.ndarray) -> np.ndarray:
    """Pixels next to another value: where 1/256 px of fixed-point snapping may decide."""
    padded = np.pad(mask, 1, mode="edge")
    shifts = [padded[j : j + mask.shape[0], i : i + mask.shape[1]] for j in range(3) for i in range(3)]
    return np.any([shift != mask for shift in shifts], axis=0)


def assert_masks_agree(got: np.ndarray, want: np.ndarray) -> None:
    # OpenGL snaps vertices to 1/256 px or finer: per outline pixel the two differ with a chance of about 1/256.
    differs = got != want
    assert not (differs & ~ambiguous(want)).any()
    assert differs.sum() <= 1 + 0.02 * ambiguous(want).sum()


def test_masks_equal_the_oracle_with_distortion_and_mixed_sizes(renderer):
    mesh, rig = lumpy_head(), fan(7, sizes=((160, 120), (97, 131), (240, 61)))
    with renderer.silhouette_set(rig, mesh.faces) as silhouettes:
        masks = silhouettes.masks(mesh.vertices)
    for camera in rig:
        want = np.isfinite(oracles.camera_depth(camera, mesh.vertices, mesh.faces))
        assert want.sum() > 300
        assert_masks_agree(masks[camera.name], want)


def test_open_mesh_shows_its_inside(renderer):
    mesh, rig = lumpy_head(), fan(3)
    faces = mesh.faces[mesh.vertices[mesh.faces].mean(axis=1)[:, 2] < 10]  # the front cut off: cameras see back faces
    assert is_closed(mesh.faces)
    assert not is_closed(faces)
    with renderer.silhouette_set(rig, faces) as silhouettes:
        masks = silhouettes.masks(mesh.vertices)
    for camera in rig:
        assert_masks_agree(masks[camera.name], np.isfinite(oracles.camera_depth(camera, mesh.vertices, faces)))


def test_scale_halves_the_image_with_its_pixel_centres(renderer):
    mesh, rig = lumpy_head(), fan(2, sizes=((320, 240),))
    with renderer.silhouette_set(rig, mesh.faces, scale=0.5) as silhouettes:
        masks = silhouettes.masks(mesh.vertices)
    for camera in rig.scaled(0.5):
        assert masks[camera.name].shape == (120, 160)
        assert_masks_agree(masks[camera.name], np.isfinite(oracles.camera_depth(camera, mesh.vertices, mesh.faces)))


def test_sphere_is_its_conic(renderer):
    """The outline of a sphere: rays at asin(r / distance) from its centre. Proves half pixel and row order."""
    radius, centre = 100.0, np.array([40.0, 55.0, -20.0])
    vertices, faces = sphere(5, radius)
    rig = fan(3, sizes=((200, 150),))
    with renderer.silhouette_set(rig, faces) as silhouettes:
        masks = silhouettes.masks(vertices + centre)
    for camera in rig:
        k = camera.intrinsics
        x, y = np.meshgrid(np.arange(k.width), np.arange(k.height))
        rays = camera.rays_world(np.stack([x.ravel(), y.ravel()], 1).astype(float))
        to_centre = centre - camera.centre_world
        distance = np.linalg.norm(to_centre)
        off = np.arccos(rays @ to_centre / distance) - np.arcsin(radius / distance)  # rad; negative inside
        off_px = (off * k.fx).reshape(k.height, k.width)
        # The polyhedron lies inside the sphere by at most radius * (1 - cos(edge / 2)) = 0.014 mm = 0.006 px; the
        # radian-to-pixel factor and distortion are good to 20 %; 0.02 px leaves room for the snapping of 1/256 px.
        assert np.array_equal(masks[camera.name][np.abs(off_px) > 0.02], (off_px < 0)[np.abs(off_px) > 0.02])


def test_what_is_behind_a_camera_stays_out(renderer):
    """A strip through the camera: what is behind it stays out."""
    rig = fan(4, sizes=((120, 90),), lens=Distortion())
    camera = rig.cameras[1]
    world_from_camera = camera.camera_from_world.inverse()
    strip = world_from_camera.apply(np.array([(-40, 30, -800), (40, 30, -800), (-40, 30, 700), (40, 30, 700)], float))
    with renderer.silhouette_set(rig, np.array([(0, 1, 2), (1, 3, 2)])) as silhouettes:
        masks = silhouettes.masks(strip)
    k = camera.intrinsics
    x, y = np.meshgrid((np.arange(k.width) - k.cx) / k.fx, (np.arange(k.height) - k.cy) / k.fy)
    with np.errstate(divide="ignore"):
        depth = np.where(y > 0, 30 / y, np.inf)
    want = (depth > 1) & (depth < 700) & (np.abs(x * depth) < 40)
    assert_masks_agree(masks[camera.name], want)
    assert want.any()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(offset=st.tuples(*[st.floats(-700, 700)] * 3))
def test_anywhere_in_front_it_equals_the_oracle(renderer, offset):
    """Off the image, across its border, half out: always the oracle's mask, and nothing in the neighbour's tile."""
    rig = fan(3, sizes=((96, 72),), lens=Distortion(-0.1, 0.02))
    vertices, faces = sphere(2, 120.0)
    vertices = vertices + offset
    with renderer.silhouette_set(rig, faces) as silhouettes:
        masks = silhouettes.masks(vertices)
    for camera in rig:
        if camera.camera_from_world.apply(vertices)[:, 2].min() > 300:  # nearer, a facet is too large for the lens
            pixels = camera.project(vertices)
            faces_seen = faces[np.isfinite(pixels[faces]).all((1, 2))]
            want = np.isfinite(oracles.camera_depth(camera, vertices, faces_seen))
            assert_masks_agree(masks[camera.name], want)


def test_no_point_folds_back_past_the_max_valid_radius(renderer):
    """A lens with k1 = -0.4 turns at r = 0.91: a sphere at r = 2 would come back near r = -1.2, in the image."""
    intrinsics = Intrinsics(200, 200, 80.0, 80.0, 99.5, 99.5, Distortion(k1=-0.4))
    camera = Camera("wide", intrinsics, RigidTransform.identity())
    rig = Rig((camera,))
    vertices, faces = sphere(2, 30.0)
    with renderer.silhouette_set(rig, faces) as silhouettes:
        assert not silhouettes.masks(vertices + np.array([1000.0, 0.0, 500.0]))["wide"].any()
        assert silhouettes.masks(vertices + np.array([300.0, 0.0, 500.0]))["wide"].any()


def test_xor_is_the_weighted_sum_and_repeats_to_the_bit(renderer):
    mesh, rig = lumpy_head(), fan(5, sizes=((160, 120), (97, 131)))
    rng = np.random.default_rng(7)
    moved = mesh.vertices + np.array([4.0, -3.0, 2.0])
    with renderer.silhouette_set(rig, mesh.faces) as silhouettes:
        masks = silhouettes.masks(mesh.vertices)
        weights = {name: (1.0 / rng.uniform(1, 50, mask.shape) ** 2).astype(np.float32) for name, mask in masks.items()}
        silhouettes.set_inputs(masks, weights)
        assert np.array_equal(silhouettes.xor_costs(mesh.vertices), np.zeros(len(rig)))
        first, again, shifted = silhouettes.xor_costs(moved), silhouettes.xor_costs(moved), silhouettes.masks(moved)
        gone = silhouettes.xor_costs(mesh.vertices + np.array([0.0, 1e4, 0.0]))
    want = [weights[n][masks[n] != shifted[n]].sum(dtype=float) for n in rig.names]
    np.testing.assert_allclose(first, want, rtol=1e-5)
    assert np.array_equal(first, again)
    np.testing.assert_allclose(gone, [weights[n][masks[n]].sum(dtype=float) for n in rig.names], rtol=1e-5)


def test_sixty_four_cameras_are_packed_without_overlap():
    rig = fan(64, sizes=((1024, 768), (2048, 1536), (640, 480)))
    pages = pack(rig.cameras, 4096)
    assert sorted(index for page in pages for index in page.cameras) == list(range(64))
    for page in pages:
        assert page.width <= 4096
        assert page.height <= 4096
        taken = np.zeros((page.height // BLOCK_PX, page.width // BLOCK_PX), int)
        for left, top, width, height in page.tiles // BLOCK_PX:
            taken[top : top + height, left : left + width] += 1
        assert taken.max() == 1


def test_several_pages_give_the_same_costs(renderer, monkeypatch):
    mesh, rig = lumpy_head(2), fan(5)
    results = []
    for side in (8192, 256):
        monkeypatch.setattr("rig.render.tile_packing.PAGE_PX", side)
        with renderer.silhouette_set(rig, mesh.faces) as silhouettes:
            masks = silhouettes.masks(mesh.vertices)
            weights = {name: np.ones(mask.shape, np.float32) for name, mask in masks.items()}
            silhouettes.set_inputs(masks, weights)
            results.append((masks, silhouettes.xor_costs(mesh.vertices + np.array([6.0, 0.0, 0.0]))))
    assert all(np.array_equal(results[0][0][n], results[1][0][n]) for n in rig.names)
    assert np.array_equal(results[0][1], results[1][1])


def test_too_large_an_image_is_refused():
    with pytest.raises(ImageTooLarge, match="camera cam00 has 5000 x 400 pixels"):
        pack(fan(1, sizes=((5000, 400),)).cameras, 4096)


def test_missing_inputs_are_named(renderer):
    mesh, rig = lumpy_head(2), fan(2)
    with renderer.silhouette_set(rig, mesh.faces) as silhouettes:
        with pytest.raises(InputError, match="set_inputs"):
            silhouettes.xor_costs(mesh.vertices)
        with pytest.raises(InputError, match="no mask for camera cam01"):
            silhouettes.set_inputs({"cam00": np.zeros((120, 160), bool)}, {})
        with pytest.raises(InputError, match="vertices: there are 3,"):
            silhouettes.masks(mesh.vertices[:3])


def test_depth_equals_the_oracle(renderer):
    mesh, rig = lumpy_head(), fan(4, sizes=((160, 120), (97, 131)))
    depth = renderer.depth(rig, mesh.vertices, mesh.faces)
    for camera in rig:
        want = oracles.camera_depth(camera, mesh.vertices, mesh.faces)
        both = np.isfinite(want) & np.isfinite(depth[camera.name])
        assert_masks_agree(np.isfinite(depth[camera.name]), np.isfinite(want))
        # 1/256 px of snapping is 0.015 mm sideways; on a slope of 80 degrees that is 0.09 mm of depth.
        error = np.abs(want[both] - depth[camera.name][both])
        assert np.median(error) < 0.005
        assert np.quantile(error, 0.99) < 0.1


def test_colour_shows_vertex_colours_and_coverage(renderer):
    mesh, rig = lumpy_head(), fan(2)
    side = np.where(mesh.vertices[:, :1] > 0, (200, 40, 40), (40, 40, 200)).astype(np.uint8)
    images = renderer.colour(rig, Mesh(mesh.vertices, mesh.faces, side))
    for camera in rig:
        image = images[camera.name]
        want = oracles.camera_depth(camera, mesh.vertices, mesh.faces)
        # Antialiased coverage against counted pixel centres: both estimate one area.
        assert abs(image[:, :, 3].sum() / 255 - np.isfinite(want).sum()) < 0.01 * np.isfinite(want).sum()
        x = camera.project(np.array([(50.0, 0.0, 60.0), (-50.0, 0.0, 60.0)])).round().astype(int)
        assert image[x[0][1], x[0][0], :3].tolist() == [200, 40, 40]
        assert image[x[1][1], x[1][0], :3].tolist() == [40, 40, 200]
        edge = (image[:, :, 3] > 0) & (image[:, :, 3] < 255)
        assert edge.any()
        assert image[edge][:, :3].max(axis=1).min() >= 115  # red and blue may mix; a quarter of either with black is 50
    lit = renderer.colour(rig, mesh, light=HEADLIGHT)["cam00"]
    inside = lit[lit[:, :, 3] == 255][:, 0]
    assert inside.max() > 180
    assert inside.min() < 150


def test_it_belongs_to_its_thread_and_ends():
    caught = []

    def elsewhere(other: Renderer) -> None:
        try:
            other.depth(fan(1), *sphere(1))
        except WrongThread as error:
            caught.append(str(error))

    with Renderer.create() as another:
        thread = threading.Thread(target=elsewhere, args=(another,))
        thread.start()
        thread.join()
    assert len(caught) == 1
    with pytest.raises(WrongThread, match="closed"):
        another.depth(fan(1), *sphere(1))


def test_two_renderers_side_by_side(renderer):
    mesh, rig = lumpy_head(2), fan(2)
    with Renderer.create() as another:
        one, two = (r.depth(rig, mesh.vertices, mesh.faces)["cam01"] for r in (renderer, another))
    assert np.array_equal(one, two)
    assert np.array_equal(renderer.depth(rig, mesh.vertices, mesh.faces)["cam01"], one)


def test_without_egl_one_clear_error_names_the_packages():
    """The loader asks this variable for its drivers: with none there, EGL cannot start, as on a bare machine."""
    code = "from rig.render.renderer import Renderer\nfrom rig.errors import EigenheadError\n"
    code += "try:\n Renderer.create()\nexcept EigenheadError as e:\n print(type(e).__name__, e)"
    environment = {**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("EglUnavailable")
    assert "libegl1 libegl-mesa0 libgl1-mesa-dri" in done.stdout
