"""The compiled loops' bilinear reading against scipy's, and its slopes against differences of it."""

import numpy as np
from scipy.ndimage import map_coordinates

from pipeline.imaging.sampling_kernels import INSIDE, bilinear_slopes, cell, held, sample, sample_row
from rig.jit import njit

HEIGHT, WIDTH = 23, 31
IMAGE = np.random.default_rng(1).normal(size=(HEIGHT, WIDTH))


@njit(cache=False)
def _read(image, places):
    out = np.empty(len(places))
    for n in range(len(places)):
        out[n] = sample(image, held(places[n, 0], image.shape[1]), held(places[n, 1], image.shape[0]))
    return out


@njit(cache=False, fastmath=True)
def _read_row(images, start, width, height, places):
    out = np.empty(len(places))
    for n in range(len(places)):
        column, right = cell(places[n, 0], width)
        row, down = cell(places[n, 1], height)
        out[n] = sample_row(images, start + row * width + column, width, right, down)
    return out


def expected(places: np.ndarray) -> np.ndarray:
    return map_coordinates(IMAGE, places[:, ::-1].T, order=1, mode="nearest")


def inside(count: int = 500) -> np.ndarray:
    return np.random.default_rng(2).uniform((0.0, 0.0), (WIDTH - INSIDE, HEIGHT - INSIDE), (count, 2))


def test_reading_is_scipy_s_and_beyond_the_image_its_border_is_read() -> None:
    np.testing.assert_allclose(_read(IMAGE, inside()), expected(inside()), atol=1e-13)
    whole = np.stack(np.meshgrid(np.arange(WIDTH - 1.0), np.arange(HEIGHT - 1.0)), axis=-1).reshape(-1, 2)
    np.testing.assert_array_equal(_read(IMAGE, whole), IMAGE[:-1, :-1].ravel())
    places = np.random.default_rng(3).uniform(-5.0, 36.0, (500, 2))
    # A place is held a thousandth of a pixel before the far edge: off by that share of the step between two pixels.
    step = max(np.abs(np.diff(IMAGE, axis=axis)).max() for axis in (0, 1))
    np.testing.assert_allclose(_read(IMAGE, places), expected(places), atol=2.0 * (INSIDE - 1.0) * step)


def test_a_row_of_images_is_read_like_an_image_and_goes_on_linearly_beyond_it() -> None:
    images = np.concatenate([np.full(40, np.nan), IMAGE.ravel(), np.full(40, np.nan)])
    np.testing.assert_allclose(_read_row(images, 40, WIDTH, HEIGHT, inside()), expected(inside()), atol=1e-13)
    corner = np.array([[WIDTH - 1.0, HEIGHT - 1.0]])
    np.testing.assert_allclose(_read_row(images, 40, WIDTH, HEIGHT, corner), IMAGE[-1, -1], atol=1e-13)
    beyond = np.array([[WIDTH - 0.5, 4.0], [-0.5, 4.0]])
    steps = 0.5 * np.array([IMAGE[4, -1] - IMAGE[4, -2], IMAGE[4, 0] - IMAGE[4, 1]])
    np.testing.assert_allclose(_read_row(images, 40, WIDTH, HEIGHT, beyond), IMAGE[4, [-1, 0]] + steps, atol=1e-13)


def test_slopes_are_differences_of_values() -> None:
    a, b, c, d = IMAGE[0, 0], IMAGE[0, 1], IMAGE[1, 0], IMAGE[1, 1]
    places = np.array([[0.3, 0.6], [0.3 + 1e-6, 0.6], [0.3, 0.6 + 1e-6]])
    middle, across, along = _read(IMAGE, places)
    differences = ((across - middle) / 1e-6, (along - middle) / 1e-6)
    # Linear in each direction: only rounding, 1e-16 / 1e-6, is left of the difference.
    np.testing.assert_allclose(bilinear_slopes(a, b, c, d, 0.3, 0.6), differences, atol=1e-8)
