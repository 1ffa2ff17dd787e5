"""Photographs in the colours that a chart says are true."""

import numpy as np

from pipeline.imaging.colour_chart import Chart, ChartCorrection, true_colours
from pipeline.texturing.chart_colours import (
    ChartColours,
    combine_charts,
    correct_capture,
    correct_picture,
    levelled_by_chart,
    measure_charts,
)
from pipeline.texturing.light import BAND_FACTORS, Light, harmonics
from rig.camera import Camera
from rig.capture import Capture
from rig.colour_space import srgb_from_linear
from rig.studio.scene.layout import default_layout
from tests.pipeline.imaging.test_colour_chart import photograph, placed

MATRIX = np.array([[1.4, -0.1, 0.0], [-0.05, 1.1, 0.02], [0.0, -0.1, 1.6]])


def grey(value: int) -> np.ndarray:
    return np.full((4, 6, 3), value, np.uint8)


def seen_in(camera: Camera, tint: np.ndarray) -> Chart:
    grid = np.stack(np.meshgrid(np.arange(6) - 2.5, 1.5 - np.arange(4)), axis=-1).reshape(-1, 2) * 46.0
    points = np.column_stack([grid, np.zeros(24)])
    return Chart(camera.project(points), true_colours() @ tint.T)


def test_a_picture_is_multiplied_in_linear_light_and_clipped() -> None:
    linear = np.array([[[0.2, 0.3, 0.1], [0.9, 0.9, 0.9]]])
    codes = np.rint(255 * srgb_from_linear(linear)).astype(np.uint8)
    found = correct_picture(codes, MATRIX)
    np.testing.assert_allclose(found, 255 * srgb_from_linear(np.clip(linear @ MATRIX.T, 0, 1)), atol=2)
    assert found[0, 1, 2] == 255


def test_a_chart_corrects_its_camera_and_the_mean_the_others() -> None:
    rig = default_layout()
    one, other, bare = rig.names[3:6]
    charts = {one: [seen_in(rig[one], np.diag([0.5, 0.8, 0.8]))], other: [seen_in(rig[other], np.eye(3))], bare: []}
    colours, warnings = combine_charts(charts, rig)
    assert colours is not None
    assert not warnings
    assert set(colours.cameras) == {one, other}
    np.testing.assert_allclose(colours.cameras[one].matrix, np.diag([2.0, 1.25, 1.25]), atol=1e-6)
    np.testing.assert_allclose(colours.normal_world, [0, 0, 1], atol=1e-3)
    shown = correct_capture(Capture(images={name: grey(128) for name in (one, other, bare)}), colours).images
    assert np.abs(shown[other].astype(int) - 128).max() <= 1
    assert shown[one][0, 0, 0] > shown[bare][0, 0, 0] > shown[other][0, 0, 0]
    assert shown[one][0, 0, 0] > shown[one][0, 0, 1]


def test_the_charts_of_all_plates_are_looked_for() -> None:
    rig, wall = default_layout(), photograph(placed(0.01, 0.0), np.eye(3))
    plates = {"cam04": (wall,), "cam05": (wall, photograph(placed(200, 5), np.diag([0.5, 0.8, 0.8])))}
    colours, warnings = measure_charts(Capture(images={}, backgrounds=plates), rig)
    assert colours is not None
    assert not warnings
    assert set(colours.cameras) == {"cam05"}
    np.testing.assert_allclose(colours.cameras["cam05"].matrix, np.diag([2.0, 1.25, 1.25]), atol=0.03)


def test_without_a_chart_there_is_a_warning() -> None:
    colours, warnings = measure_charts(Capture(images={}, backgrounds={"cam05": (grey(1),)}), default_layout())
    assert colours is None
    assert [warning.code for warning in warnings] == ["no-chart"]
    assert warnings[0].text.startswith("no clean plate shows a ColorChecker Classic")


def test_light_is_levelled_to_what_falls_on_the_chart() -> None:
    coefficients = np.random.default_rng(0).normal(0, 0.3, (9, 3))
    coefficients[0] = 4.0
    normal = np.array([0.6, 0.0, 0.8])
    found = levelled_by_chart(Light(coefficients, 0.1), normal)
    np.testing.assert_allclose((harmonics(normal[None]) * BAND_FACTORS) @ found.coefficients, [[1.0, 1.0, 1.0]])
    assert found.on_chart
    np.testing.assert_allclose(found.coefficients / found.coefficients[0], coefficients / coefficients[0])


def test_a_correction_is_what_it_says() -> None:
    colours = ChartColours({"a": ChartCorrection(MATRIX, 0.01)}, np.array([0.0, 0.0, 1.0]))
    shown = correct_capture(Capture(images={"a": grey(90)}, texture_sets={"cross": {"a": grey(90)}}), colours)
    assert shown.images["a"].dtype == np.uint8
    assert shown.images["a"][0, 0].tolist() == correct_picture(grey(90), MATRIX)[0, 0].tolist()
    np.testing.assert_array_equal(shown.texture_sets["cross"]["a"], shown.images["a"])
