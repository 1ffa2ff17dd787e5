"""The experiments' own parts: kept rows, stopped searches, planted optima; and each short command once, end to end."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import rosen

from rig.mesh import Mesh
from tests.laboratory.experiments import markdown, records
from tests.laboratory.experiments.paper import views
from tests.laboratory.experiments.paper.tables import correlation
from tests.laboratory.experiments.peers import peers, soft_rasteriser
from tests.laboratory.experiments.pictures import heads
from tests.laboratory.experiments.records import Records, key_of
from tests.laboratory.runner import run
from tests.laboratory.table import EXPERIMENTS
from tests.support.scenes import ellipsoid
from tests.support.shared_data import shared


def test_a_stopped_run_goes_on_and_another_key_of_sources_and_values_starts_anew(tmp_path: Path) -> None:
    computed = []

    def compute(value: int) -> dict[str, int]:
        computed.append(value)
        return {"value": value}

    assert Records(tmp_path / "new", "rows", "a").row("one", lambda: compute(1)) == {"value": 1}
    again = Records(tmp_path / "new", "rows", "a")
    assert again.row("one", lambda: compute(2)) == {"value": 1}
    assert again.row("two", lambda: compute(3)) == {"value": 3}
    assert Records(tmp_path / "new", "rows", "b").row("one", lambda: compute(4)) == {"value": 4}
    assert computed == [1, 3, 4]
    assert key_of(records, 1) == key_of(records, 1)
    assert len({key_of(records, 1), key_of(markdown, 1), key_of(records, 2), key_of(records)}) == 4


def test_a_table_shows_three_digits_whole_numbers_and_gaps_and_no_correlation_of_too_few_rows() -> None:
    text = markdown.table(("what", "value"), [["a", 0.123456], ["b", 7.0], ["c", 12345.6], ["d", None]])
    assert text.splitlines()[2:] == ["| a | 0.123 |", "| b | 7 |", "| c | 12346 |", "| d | - |"]
    assert correlation([{"a": 1.0, "b": 2.0}] * 2, "a", "b") is None
    assert correlation([{"a": x, "b": -2.0 * x} for x in (1.0, 2.0, 4.0)], "a", "b") == pytest.approx(-1.0)


@pytest.mark.parametrize("adaptive", [False, True])
def test_scipys_simplex_is_stopped_by_the_relative_spread_and_asks_no_point_twice(adaptive: bool) -> None:
    evaluated: list[bytes] = []

    def hill(x: np.ndarray) -> float:
        evaluated.append(x.tobytes())
        return 1.0 + rosen(x)

    counted = peers.Counted(hill)
    found = peers.nelder_mead(counted, np.array([-1.0, 1.0, 0.5]), adaptive=adaptive)
    assert counted.calls == len(evaluated) == len(set(evaluated)) < 1000
    # The spread of 1e-4 about the least value of 1 leaves the valley's floor known to about that.
    assert rosen(found) < 1e-3


def test_scipys_simplex_ends_at_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "LIMIT", 60)
    counted = peers.Counted(lambda x: float(np.random.default_rng(len(str(x))).uniform(0.5, 1.0) + (x**2).sum()))
    peers.nelder_mead(counted, np.full(6, 3.0), adaptive=False)
    # It is looked at after ten moves; one that shrinks costs as many evaluations as there are points, and two more.
    assert 60 <= counted.calls < 60 + peers.CHECKED_EVERY * 9


def test_pairs_are_the_pixels_near_the_outline_and_the_triangles_near_them() -> None:
    triangle = np.array([[10.2, 8.1], [30.7, 11.9], [17.3, 25.4]], np.float32)
    rows, columns = np.mgrid[:36, :44]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    signed = _signed_distance(triangle.astype(float), pixels).reshape(36, 44)
    mask, coverage, reach = signed < 0, np.zeros((36, 44), np.float32), 2.0
    pairs = soft_rasteriser.find_pairs(triangle, np.array([[0, 1, 2]]), mask[None], coverage[None], reach)
    near = {tuple(pixel) for pixel in pairs.pixel.astype(int).tolist()}
    everything_near = {(x, y) for y, x in np.argwhere(np.abs(signed) < reach - 1.0)}
    assert everything_near <= near
    assert not {(x, y) for y, x in np.argwhere(np.abs(signed) > reach + 2.0)} & near
    assert set(pairs.row.tolist()) <= set(range(len(pairs.pixel)))
    paired = {tuple(pixel) for pixel in pairs.pixel[pairs.row].astype(int).tolist()}
    assert everything_near <= paired  # and each of them has met the triangle
    assert (pairs.corner == [0, 1, 2]).all()


def _signed_distance(triangle: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance to a triangle's border, negative inside: an oracle of a few lines."""
    distances, sides = [], []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        edge, to = triangle[b] - triangle[a], points - triangle[a]
        along = np.clip(to @ edge / (edge @ edge), 0, 1)
        distances.append(np.linalg.norm(to - along[:, None] * edge, axis=1))
        sides.append(edge[0] * to[:, 1] - edge[1] * to[:, 0] > 0)
    inside = (sides[0] == sides[1]) & (sides[1] == sides[2])
    return np.where(inside, -1, 1) * np.min(distances, axis=0)


def test_soft_coverage_is_that_of_the_paper() -> None:
    pytest.importorskip("jax")
    triangle = np.array([[2.0, 3.0], [17.0, 5.0], [8.0, 15.0]], np.float32)
    points = np.random.default_rng(0).uniform(0, 20, (200, 2)).astype(np.float32)
    found = soft_rasteriser.signed_square(np.tile(triangle, (200, 1, 1)), points)
    expected = _signed_distance(triangle.astype(float), points.astype(float))
    np.testing.assert_allclose(found, -np.sign(expected) * expected**2, atol=1e-3)


def test_a_optimal_views_are_the_informative_ones() -> None:
    """Views 0 to 2 each measure one of three unknowns well; 3 and 4 measure all of them badly."""
    information = np.stack([np.diag(np.eye(3)[i] * 100.0) for i in range(3)] + [0.3 * np.eye(3)] * 2)
    assert views.a_optimal([(information, np.eye(3))], 3, 0.1 * np.eye(3)) == [0, 1, 2]
    weighed = np.diag([0.0, 1.0, 0.0])  # only the second unknown matters
    assert views.a_optimal([(information, weighed)], 1, 0.1 * np.eye(3)) == [1]
    # Exchanges repair a greedy choice: the best alone is worst beside the two that measure one unknown each.
    information = np.stack([np.diag([3.0, 3.0]), np.diag([100.0, 0.0]), np.diag([0.0, 100.0])])
    assert views.a_optimal([(information, np.eye(2))], 1, 0.1 * np.eye(2)) == [0]
    assert views.a_optimal([(information, np.eye(2))], 2, 0.1 * np.eye(2)) == [1, 2]


def test_heads_stand_side_by_side() -> None:
    body = ellipsoid(3)
    picture = heads([[("one", body), ("two", Mesh(1.1 * body.vertices, body.faces))]])
    assert picture.shape == (480, 720, 3)
    assert picture[240, 180].max() < 240  # a head, and no paper
    assert (picture[2, 715] == (245, 245, 245)).all()


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.parametrize(
    ("name", "figure", "most"),
    [
        ("convergence", "section52_largest_mm", 0.3),
        ("alignment", "off_mm_mean", 3.0),
        ("table1", "contour_l2_max", 1e3),
    ],
)
def test_a_short_run_leaves_rows_a_table_and_figures(tmp_path: Path, name: str, figure: str, most: float) -> None:
    options = ["--simplex", "0"] if name == "table1" else []
    found, _ = run(name, EXPERIMENTS[name], ["--subjects", "2", "--out", str(tmp_path), *options])
    assert 0.0 < found["figures"][figure] < most
    assert all(np.isfinite(value) for value in found["figures"].values())
    assert (tmp_path / f"{name}.md").read_text().startswith("| ")
    assert len(json.loads((tmp_path / f"{name}.json").read_text())["rows"]) >= 2
    json.dumps(found, allow_nan=False)
    if name == "table1":
        assert (tmp_path / "table1-figure4.png").stat().st_size > 10_000
        assert (tmp_path / "table1-figure5.png").stat().st_size > 5_000


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.gl
def test_intervals_are_counted_at_every_level_for_both_populations(tmp_path: Path) -> None:
    data = shared("data/ict-facekit").parent
    options = ["--subjects", "1", "--shared", str(data), "--out", str(tmp_path)]
    found = run("hidden", EXPERIMENTS["hidden"], options)[0]["figures"]
    for level in ("span", "kernel", "photo", "fine"):
        assert 0.5 < found[f"all_{level}_seen_all_within_95"] <= 1.0
    assert found["studio_fine_seen_face_median_mm"] < 0.2
    assert found["draws_fine_seen_face_median_mm"] < 0.3
    assert (tmp_path / "hidden.md").read_text().startswith("| ")
