"""What patches say of cameras: image motions against differences, sums against dense matrices, slopes of pictures."""

import numpy as np
import pytest

from pipeline.photometric_fit.depth_search import camera_sensitivity
from pipeline.photometric_fit.patch_kernels import read, read_with_slopes
from rig.camera import Camera
from rig.studio.scene.layout import default_layout

STEP = 1e-5


@pytest.fixture(scope="module")
def planted() -> dict[str, np.ndarray | tuple[Camera, ...]]:
    """Five patches about the middle of the rig, seen by two or three of four cameras."""
    rng = np.random.default_rng(3)
    view = np.array([[0, 1, 2], [3, 0, -1], [2, 3, 1], [1, 3, -1], [0, 2, 3]])
    rows = rng.normal(size=(5, 6, 12))
    shades = rng.normal(size=(5, 3, 12))
    return {
        "cameras": tuple(default_layout())[:4],
        "view": view,
        "value": np.where(view >= 0, rng.uniform(0.3, 1.0, view.shape), 0.0),
        "slopes": rows @ rows.transpose(0, 2, 1) * np.repeat(view >= 0, 2, axis=1)[:, :, None],
        "mixed": rows @ shades.transpose(0, 2, 1),
        "places": rng.normal(scale=40.0, size=(5, 3)),
        "axes": np.linalg.qr(rng.normal(size=(5, 3, 3)))[0][:, 0],
    }


def test_a_patch_moves_in_its_images_as_differences_say(planted: dict) -> None:
    cameras, view, places, axes = (planted[name] for name in ("cameras", "view", "places", "axes"))
    grams = planted["slopes"], planted["mixed"]
    found = camera_sensitivity(view, planted["value"], grams, places, axes, cameras)
    for n, j in np.argwhere(view >= 0):
        camera = cameras[view[n, j]]
        for c in range(6):
            by = STEP * np.eye(6)[c]
            ends = [camera.moved(sign * by).project(places[n][None])[0] for sign in (1.0, -1.0)]
            expected = (ends[0] - ends[1]) / (2.0 * STEP)
            np.testing.assert_allclose(found.slides[n, 2 * j : 2 * j + 2, c], expected, rtol=1e-5, atol=1e-4)


def test_the_cameras_sums_are_those_of_dense_matrices(planted: dict) -> None:
    view, cameras = planted["view"], planted["cameras"]
    grams = planted["slopes"], planted["mixed"]
    found = camera_sensitivity(view, planted["value"], grams, planted["places"], planted["axes"], cameras)
    information = np.arange(1.0, 6.0)
    matrix, gradient = np.zeros((24, 24)), np.zeros(24)
    for n in range(len(view)):
        dense = np.zeros((6, 24))
        for row in range(6):
            if view[n, row // 2] >= 0:
                dense[row, 6 * view[n, row // 2] :][:6] = found.slides[n, row]
        matrix += information[n] * dense.T @ found.stiff[n] @ dense
        gradient -= information[n] * dense.T @ found.slope[n]
    equations = found.cameras(information)
    np.testing.assert_allclose(equations[0], matrix, rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
    np.testing.assert_allclose(equations[1], gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())


def test_slopes_of_a_picture_are_differences_of_what_is_read_everywhere() -> None:
    height, width = 9, 12
    image = np.random.default_rng(5).uniform(0.0, 255.0, height * width).astype(np.float32)

    def at(x: float, y: float) -> float:
        return read(image, 0, width, height, x, y)

    for x in np.linspace(-1.5, width + 0.5, 29):
        for y in np.linspace(-1.5, height + 0.5, 23):
            expected = at(x, y), 0.5 * (at(x + 1.0, y) - at(x - 1.0, y)), 0.5 * (at(x, y + 1.0) - at(x, y - 1.0))
            found = read_with_slopes(image, 0, width, height, x, y)
            np.testing.assert_allclose(found, expected, atol=255.0 * 1e-6)
