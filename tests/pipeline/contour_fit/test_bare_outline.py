"""A bare skull's outline is the skull's, whoever's it is; that of hair is not, however light."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.contour_fit.bare_outline import fit_bare_outline, mark_bare_cells
from pipeline.contour_fit.clutter import CELL_PX
from pipeline.contour_fit.contour import ContourSolution, solve_contour
from pipeline.head_model.gaussian_process import with_kernel
from pipeline.head_model.model import HeadModel, load_model, with_modes
from pipeline.imaging.silhouette import Silhouette, signed_distance, silhouette_from_mask
from pipeline.settings import FittingSettings
from rig.geometry import Similarity
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.subjects import exact

PX_PER_MM = 1.0
RADIUS, MIDDLE, SIZE = 90.0, 150, 300
TOWER_MM, WIDTH_MM = 12.0, 35.0


def ball(tufts_mm: float = 0.0) -> np.ndarray:
    """A round head; ``tufts_mm`` high waves of 14 mm stand on its outline."""
    row, column = np.indices((SIZE, SIZE)) - MIDDLE
    angle = np.arctan2(row, column)
    return signed_distance(np.hypot(row, column) < RADIUS + tufts_mm * np.sin(40.0 * angle))


def at_outline(cells: np.ndarray) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    column, row = ((MIDDLE + (RADIUS - 2.0) * way(turn)) / CELL_PX for way in (np.cos, np.sin))
    return cells[row.astype(int), column.astype(int)]


def test_smooth_skin_is_a_skull_and_hair_as_light_as_skin_is_none() -> None:
    light = np.ones((SIZE, SIZE), np.float32)
    cells = mark_bare_cells(ball(), light, PX_PER_MM)
    assert at_outline(cells).all()
    assert not cells[MIDDLE // CELL_PX, MIDDLE // CELL_PX]  # far from any outline
    assert not at_outline(mark_bare_cells(ball(tufts_mm=2.5), light, PX_PER_MM)).any()
    no_subject = signed_distance(np.zeros((SIZE, SIZE), bool))
    assert not mark_bare_cells(no_subject, light, PX_PER_MM).any()


def test_smooth_hair_is_no_skull() -> None:
    """Only the lower half is skin: no cell well above its end is a skull's."""
    skin = np.zeros((SIZE, SIZE), np.float32)
    skin[MIDDLE:] = 1.0
    cells = mark_bare_cells(ball(), skin, PX_PER_MM)
    assert not cells[: (MIDDLE - 20) // CELL_PX].any()
    assert cells[(MIDDLE + 40) // CELL_PX :].any()


@pytest.fixture(scope="module")
def model() -> HeadModel:
    return with_kernel(with_modes(load_model(), 60), 60)


@pytest.fixture(scope="module")
def tower(model: HeadModel, renderer) -> tuple[Rig, dict[str, Silhouette], np.ndarray]:
    """A skull that no eigenhead has: the mean head with a dome on its top."""
    rig = exact(default_layout())
    vertices = model.vertices(np.zeros(0)).copy()
    top = vertices[vertices[:, 1].argmax()]
    vertices[:, 1] += TOWER_MM * np.exp(-0.5 * ((vertices - top) ** 2).sum(axis=1) / WIDTH_MM**2)
    with renderer.silhouette_set(rig, model.levels["full"].faces) as drawn:
        masks = drawn.masks(vertices)
    return rig, {name: silhouette_from_mask(mask) for name, mask in masks.items()}, vertices


def solve(model: HeadModel, rig: Rig, silhouettes: dict[str, Silhouette]) -> ContourSolution:
    return solve_contour(model, Similarity.identity(), silhouettes, rig, FittingSettings())


def top_mm(model: HeadModel, solved: ContourSolution) -> float:
    """Height of the crown in the world."""
    vertices = solved.state.world_from_head.apply(model.vertices(solved.state.coefficients))
    return float(vertices[:, 1].max())


def everywhere(silhouettes: dict[str, Silhouette], value: float) -> dict[str, np.ndarray]:
    return {name: np.full(each.mask.shape, value, np.float32) for name, each in silhouettes.items()}


@pytest.mark.gl
def test_a_bare_crown_that_no_eigenhead_has_is_followed(model, tower) -> None:
    rig, silhouettes, truth = tower
    solved = solve(model, rig, silhouettes)
    true_mm = truth[:, 1].max()
    assert top_mm(model, solved) < true_mm - 8.0  # the outlines alone take it for hair
    bare = fit_bare_outline(solved, everywhere(silhouettes, 1.0))
    assert abs(top_mm(model, bare) - true_mm) < 1.0
    assert fit_bare_outline(solved, everywhere(silhouettes, 0.0)) is solved  # hair as smooth as a skull
    assert fit_bare_outline(solved, {}) is solved


@pytest.mark.gl
def test_tufts_of_the_colour_of_skin_do_not_pull(model, tower) -> None:
    rig, silhouettes, _ = tower
    solved = solve(model, rig, silhouettes)
    views = solved.problem.views
    row, column = np.indices((768, 1024))
    waves = (1.5 * np.sin(row / 3.0) * np.cos(column / 3.0)).astype(np.float32).ravel()  # px, 0.7 mm
    tufted = replace(views, distance=views.distance + np.tile(waves, len(views.names)))
    solved = replace(solved, problem=replace(solved.problem, views=tufted))
    assert fit_bare_outline(solved, everywhere(silhouettes, 1.0)) is solved
