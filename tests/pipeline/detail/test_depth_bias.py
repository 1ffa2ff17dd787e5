"""What windows make of a surface, planted and taken off again."""

import numpy as np
import pytest

from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.depth_bias import measure_bias, points_on_face, remove_window_bias
from pipeline.part_labels.codes import Part
from pipeline.stereo.depth_map import REACH_MM, WINDOW_MM, WindowBias, subtract_bias, windowed_height
from rig.mesh import Mesh

NOISE_MM = 0.1


def bumpy_wall() -> Mesh:
    """Waves of 12 mm length and 2 mm height on a grid of 0.8 mm, facing +z."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(100) * 0.8, np.arange(100) * 0.8, indexing="ij"))
    z = np.sin(2 * np.pi * x / 12.0) * np.sin(2 * np.pi * y / 12.0)
    at = np.arange(100 * 100).reshape(100, 100)
    a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return Mesh(np.column_stack([x, y, z]), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def seen_through_windows(wall: Mesh, common_mm: float, share: float) -> SurfacePoints:
    """Every second vertex, where windows would see it."""
    rows, normals = np.arange(0, len(wall.vertices), 2), wall.normals()
    noise = np.random.default_rng(3).normal(0.0, NOISE_MM, len(rows))
    off = common_mm + share * windowed_height(wall.vertices, normals)[rows] + noise
    points = wall.vertices[rows] + off[:, None] * normals[rows]
    return SurfacePoints(points, normals[rows], np.full(len(rows), NOISE_MM), np.full(len(rows), Part.SKIN, np.uint8))


def test_the_mean_over_a_window_lies_below_a_dome_by_its_curvature() -> None:
    """r^2 / 2R below the top at a distance r. Of a Gaussian cut off at rho, r^2 is 2 sigma^2 (1 - t / (e^t - 1)) in the
    mean, with t = rho^2 / 2 sigma^2."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-20, 21.0), np.arange(-20, 21.0)))
    vertices = np.column_stack([x, y, np.sqrt(80.0**2 - x**2 - y**2)])
    top = int(np.argmin(np.hypot(x, y)))
    found = windowed_height(vertices, vertices / 80.0)[top]
    t = REACH_MM**2 / (2 * WINDOW_MM**2)
    assert found == pytest.approx(-(WINDOW_MM**2) / 80.0 * (1 - t / np.expm1(t)), rel=0.03)


def test_a_planted_bias_is_taken_off() -> None:
    wall = bumpy_wall()
    surface = seen_through_windows(wall, -0.12, 0.9)
    everywhere = np.ones(len(wall.vertices), bool)
    seen = points_on_face(surface, wall, everywhere)
    bias = measure_bias(seen)
    assert bias.common_mm == pytest.approx(-0.12, abs=0.02)
    assert bias.share == pytest.approx(0.9, abs=0.05)
    found = remove_window_bias(surface, seen, bias)
    inside = (np.abs(surface.points[:, :2] - 40.0) < 30.0).all(axis=1)
    true, normals = wall.vertices[::2], wall.normals()[::2]

    def off(points: np.ndarray) -> np.ndarray:
        return ((points - true) * normals).sum(axis=1)[inside]

    assert np.sqrt(np.mean(off(surface.points) ** 2)) > 2.5 * NOISE_MM
    assert np.sqrt(np.mean(off(found.points) ** 2)) < 1.1 * NOISE_MM
    assert abs(off(found.points).mean()) < 0.01


@pytest.mark.parametrize("part", [Part.HAIR, Part.SKIN])
def test_without_enough_of_the_face_nothing_moves(part: int) -> None:
    wall = bumpy_wall()
    seen = seen_through_windows(wall, 0.2, 0.5)
    surface = SurfacePoints(seen.points, seen.normals, seen.deviation_mm, np.full(len(seen.points), part, np.uint8))
    face = np.full(len(wall.vertices), part == Part.HAIR)  # skin that is no face, or a face without skin
    assert measure_bias(points_on_face(surface, wall, face)) == WindowBias()


def test_a_surface_that_windows_flattened_stands_out_again() -> None:
    """Its own mean tells the rest: half of a share of one half, of a quarter, and so on."""
    wall = bumpy_wall()
    normals, bias = wall.normals(), WindowBias(-0.1, 0.4)
    flat = wall.vertices + (bias.common_mm + bias.share * windowed_height(wall.vertices, normals))[:, None] * normals
    measured = wall.vertices[:, 0] > 20.0
    found = subtract_bias(Mesh(flat, wall.faces), measured, bias)
    inside = (np.abs(wall.vertices[:, :2] - 40.0) < 15.0).all(axis=1)

    def off(points: np.ndarray) -> float:
        return float(np.sqrt(np.mean(((points - wall.vertices) * normals).sum(axis=1)[inside] ** 2)))

    assert off(found.vertices) < 0.4 * off(flat)
    np.testing.assert_array_equal(found.vertices[~measured], flat[~measured])
