"""Relief that two surfaces do not both show is noise; what both show is the skin's."""

import numpy as np
import pytest

from pipeline.fusion.fusion import BustSurface
from pipeline.part_labels.codes import Part
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments.surface.relief import SMOOTH_MM, compare_relief, heights_mm, split_views

STEP_MM, SIDE = 1.5, 60


def sheet(height_mm: np.ndarray, seen: np.ndarray | None = None, shift_mm: float = 0.0) -> BustSurface:
    """A level piece of skin of that height, its vertices ``shift_mm`` aside."""
    row, column = np.mgrid[:SIDE, :SIDE]
    vertices = np.stack([column * STEP_MM + shift_mm, row * STEP_MM, height_mm], axis=2).reshape(-1, 3).astype(float)
    corner = (row * SIDE + column)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + SIDE], 1), np.stack([corner + 1, corner + SIDE + 1, corner + SIDE], 1)]
    )
    views = np.full(SIDE * SIDE, 3, np.uint8) if seen is None else np.where(seen.ravel(), 3, 0).astype(np.uint8)
    part = np.where(views > 0, Part.SKIN, Part.UNSEEN).astype(np.uint8)
    return BustSurface(Mesh(vertices, faces.astype(np.int32)), np.ones(len(vertices)), part, views)


def pores() -> np.ndarray:
    row, column = np.mgrid[:SIDE, :SIDE] * STEP_MM
    return 0.1 * np.sin(2.0 * np.pi * row / 4.0) * np.sin(2.0 * np.pi * column / 4.5)


def test_relief_that_both_show_is_no_noise() -> None:
    found = compare_relief(sheet(np.zeros((SIDE, SIDE))), sheet(pores()), sheet(pores())).figures()
    assert found["unrepeated_rms_mm"] < 1e-9
    assert 0.03 < found["repeated_rms_mm"] < 0.06  # a sine's 0.05, less what the mean about it follows


def test_relief_of_one_is_noise_and_what_is_wider_than_relief_is_not() -> None:
    rng, level = np.random.default_rng(2), np.zeros((SIDE, SIDE))
    row, column = np.mgrid[:SIDE, :SIDE] * STEP_MM
    tilted = 0.8 + 0.01 * row - 0.02 * column  # another pose: no relief
    one, two = (rng.normal(0.0, 0.2, (SIDE, SIDE)) for _ in range(2))
    found = compare_relief(sheet(level), sheet(one), sheet(two + tilted)).figures()
    assert found["unrepeated_rms_mm"] == pytest.approx(0.2, rel=0.1)  # less the mean's share
    assert found["repeated_rms_mm"] < 0.04


def test_only_what_both_measured_is_compared() -> None:
    level = np.zeros((SIDE, SIDE))
    left = np.mgrid[:SIDE, :SIDE][1] < SIDE // 2
    found = compare_relief(sheet(level), sheet(level, left), sheet(level))
    assert 0.4 < len(found.first_mm) / SIDE**2 < 0.55
    whole = sheet(level)
    above = heights_mm(
        whole.mesh_world.vertices, whole.mesh_world.normals(), sheet(np.full((SIDE, SIDE), 2.0 * SMOOTH_MM))
    )
    assert np.isnan(above).all()  # another surface


def test_halves_share_no_view_and_stand_in_between_each_other() -> None:
    rig = default_layout()
    first, second = split_views(rig, Similarity(1.0, np.eye(3), rig.centre_world()))
    assert set(first).isdisjoint(second)
    assert set(first) | set(second) == set(rig.names)
    assert abs(len(first) - len(second)) <= 1
