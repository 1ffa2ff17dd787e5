"""Labels against enumeration and against what a seam costs; levelling against a sparse solver."""

from itertools import product

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from pipeline.texturing.neighbourhood import Neighbourhood, neighbours
from pipeline.texturing.seam_levelling import LEVELLING, level_views
from pipeline.texturing.view_selection import add_similar_views, select_views
from pipeline.texturing.view_selection_kernels import RING_SHARE, differences, fill_slots, propagate
from tests.support.scenes import ellipsoid


def chain(count: int) -> Neighbourhood:
    """A path of vertices, each beside the next."""
    rows = [[w for w in (v - 1, v + 1) if 0 <= w < count] for v in range(count)]
    starts = np.cumsum([0] + [len(row) for row in rows]).astype(np.int32)
    return Neighbourhood.of(starts, np.concatenate(rows).astype(np.int32))


def strip(rows: int, columns: int) -> Neighbourhood:
    """A grid of triangles."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel().astype(np.int32)
    below = corner + np.int32(columns)
    faces = np.concatenate([np.stack([corner, corner + 1, below + 1], 1), np.stack([corner, below + 1, below], 1)])
    return Neighbourhood.of(*neighbours(faces, rows * columns))


@pytest.mark.parametrize("seed", range(5))
def test_labels_of_a_chain_are_the_best_of_all(seed: int) -> None:
    """Belief propagation is exact on a tree."""
    rng = np.random.default_rng(seed)
    around = chain(6)
    costs = rng.uniform(0, 1, (6, 3)).astype(np.float32)
    views = np.tile(np.arange(3, dtype=np.int32), (6, 1))
    penalty = np.full(len(around.indices), 0.4, np.float32)
    found = propagate(views, costs, around.starts, around.indices, around.opposite, penalty, 3, 6)

    def total(labels: tuple[int, ...]) -> float:
        return float(costs[np.arange(6), labels].sum() + 0.4 * np.count_nonzero(np.diff(labels)))

    best = min(product(range(3), repeat=6), key=total)
    assert total(tuple(found.tolist())) == pytest.approx(total(best), abs=1e-5)


def test_a_seam_keeps_out_of_where_views_differ() -> None:
    """The first view is better at the left end, the second at the right; between, all is alike but for one place."""
    rows, columns = 5, 30
    around = strip(rows, columns)
    x = np.tile(np.arange(columns) / (columns - 1), rows)
    weights = np.stack([1.0 - 0.4 * x, 0.6 + 0.4 * x]).astype(np.float32)
    codes = np.full((2, rows * columns, 3), 120.0, np.float32)
    middle = np.abs(x - 0.5) < 0.15  # where a seam would otherwise lie
    codes[0, middle] += 12
    codes[1, middle] -= 12
    agreed = np.full((rows * columns, 3), 120.0, np.float32)
    labels, _, _ = select_views(weights, codes, codes, agreed, np.ones((2, 3)), around=around)
    seam = labels[around.rows] != labels[around.indices]
    assert {*labels.tolist()} == {0, 1}
    assert not (middle[around.rows] & middle[around.indices] & seam).any()


def test_a_view_that_the_others_contradict_or_whose_camera_was_raised_much_is_not_chosen() -> None:
    around = strip(4, 6)
    weights = np.full((3, 24), 0.7, np.float32)
    weights[0] = 1.0  # would be the best
    codes = np.full((3, 24, 3), 100.0, np.float32)
    agreed = codes[0].copy()
    assert (select_views(weights, codes, codes, agreed, np.ones((3, 3)), around=around)[0] == 0).all()
    raised = np.array([[2.0] * 3, [0.7] * 3, [0.7] * 3])
    assert (select_views(weights, codes, codes, agreed, raised, around=around)[0] != 0).all()
    for off in (-25.0, 25.0):  # a shadow, a highlight
        codes[0] = 100.0 + off
        assert (select_views(weights, codes, codes, agreed, np.ones((3, 3)), around=around)[0] != 0).all()


Scene = tuple[Neighbourhood, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def random_scene(seed: int, count: int = 40, views: int = 7, noise: float = 0.06) -> Scene:
    """A chain of vertices that most views see, some of which disagree."""
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.05, 0.5, (views, count)) * (rng.random((views, count)) > 0.2)
    weights[0] = np.maximum(weights[0], 0.05)
    agreed = rng.uniform(20, 200, (count, 3))
    codes = agreed + rng.normal(0, noise, (views, count, 3)) * agreed * rng.choice([0.3, 1.5], (views, 1, 1))
    gains = 2.0 ** rng.normal(0, 0.2, (views, 3))
    weights, codes, agreed = (array.astype(np.float32) for array in (weights, codes, agreed))
    return chain(count), weights, codes, agreed, gains


def written_out(scene: Scene, levelled: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cost, quality and disagreement of each view (v, k): what the best view sees better, a bounded share of
    disagreement, and raised cameras."""
    _, weights, codes, agreed, gains = scene
    views, count = weights.shape
    cost, quality, off = np.full((count, views), np.inf), np.zeros((count, views)), np.zeros((count, views))
    for v, k in np.argwhere(weights.T > 0):
        beside = [w for w in (v - 1, v + 1) if 0 <= w < count]
        least = min([weights[k, v], *weights[k, beside]])
        quality[v, k] = (1 - RING_SHARE) * weights[k, v] + RING_SHARE * least
        ordinary = 0.06 * agreed[v] + 2.0
        off[v, k] = max(np.sqrt(np.mean(((c[k, v] - agreed[v]) / ordinary) ** 2)) for c in (codes, levelled))
    for v, k in np.argwhere(weights.T > 0):
        square = off[v, k] ** 2
        raised = abs(np.log2(gains[k].mean()))
        cost[v, k] = 1 - quality[v, k] / quality[v].max() + 2.0 * square / (1 + square) + raised
    return cost, quality, off


@pytest.mark.parametrize("seed", range(4))
def test_without_a_cost_of_seams_the_cheapest_view_is_chosen(seed: int) -> None:
    scene = random_scene(seed)
    around, weights, codes, agreed, gains = scene
    levelled = (0.5 * (codes + agreed)).astype(np.float32)
    labels, views, view_quality = select_views(weights, codes, levelled, agreed, gains, around=around, seam_cost=0.0)
    cost, quality, _ = written_out(scene, levelled)
    for v in range(40):
        order = np.argsort(cost[v])
        count = min(6, np.count_nonzero(np.isfinite(cost[v])))
        assert labels[v] == order[0]
        assert views[v, :count].tolist() == order[:count].tolist()
        np.testing.assert_allclose(view_quality[v, :count], quality[v, order[:count]], rtol=1e-5)
        assert (views[v, count:] == -1).all()
        assert (view_quality[v, count:] == 0).all()


@pytest.mark.parametrize("noise", [0.02, 0.06, 0.4])
@pytest.mark.parametrize("seed", range(4))
def test_seams_cost_more_where_views_differ(seed: int, noise: float) -> None:
    """The best of all labels of a short chain, seams included."""
    scene = random_scene(seed, 6, 3, noise)
    around, weights, codes, agreed, gains = scene
    labels, _, _ = select_views(weights, codes, codes, agreed, gains, around=around, seam_cost=0.3)
    cost, quality, off = written_out(scene, codes)
    unlike = np.minimum((quality * off).sum(axis=1) / quality.sum(axis=1), 3.0)
    seams = 0.3 * (0.3 + 0.5 * (unlike[:-1] + unlike[1:]))

    def total(chosen: tuple[int, ...]) -> float:
        return float(cost[np.arange(6), chosen].sum() + seams[np.diff(chosen) != 0].sum())

    best = min(product(range(3), repeat=6), key=total)
    assert total(tuple(labels.tolist())) == pytest.approx(total(best), abs=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_shares_fall_with_quality_and_with_what_is_more_than_noise(seed: int) -> None:
    around, weights, codes, agreed, gains = random_scene(seed)
    detail = (codes - agreed).astype(np.float32)
    labels, views, quality = select_views(weights, codes, codes, agreed, gains, around=around)
    labels[5] = -1
    off = differences(labels, views, detail, weights, around.starts, around.indices)
    others = [off[v, c] for v, c in np.ndindex(off.shape) if off[v, c] >= 0 and views[v, c] != labels[v]]
    noise = np.median(others)
    shares = np.zeros(off.shape, np.float32)
    for v, c in np.ndindex(off.shape):
        if off[v, c] >= 0 and labels[v] >= 0:
            past = max(off[v, c] / (4.0 * noise) - 1.0, 0.0)
            shares[v, c] = quality[v, c] / quality[v].max() * np.exp(-past)
    wanted = fill_slots(labels, views, shares, 4)
    found = add_similar_views(labels, views, quality, detail, weights, around=around)
    np.testing.assert_array_equal(found[0], wanted[0])
    np.testing.assert_allclose(found[1], wanted[1], rtol=1e-4)


def test_a_vertex_that_no_view_sees_has_no_label() -> None:
    around = strip(3, 4)
    weights = np.ones((2, 12), np.float32)
    weights[:, 5] = 0
    weights[0, :4] = 0
    codes = np.full((2, 12, 3), 90.0, np.float32)
    labels, views, _ = select_views(weights, codes, codes, codes[0], np.ones((2, 3)), around=around)
    assert (labels[5], views[5].tolist()) == (-1, [-1, -1])
    assert (labels[:4] == 1).all()


def test_views_are_averaged_where_they_differ_by_noise_alone() -> None:
    rng = np.random.default_rng(0)
    around, count = strip(20, 20), 400
    detail = rng.normal(0, 3, (3, count, 3)).astype(np.float32)
    eye = np.zeros(count, bool)
    eye[150:170] = True
    detail[0, eye] += rng.normal(0, 40, (20, 3))  # what lies a little elsewhere in the other views
    labels = np.zeros(count, np.int32)
    views = np.tile(np.array([0, 1, 2], np.int32), (count, 1))
    quality = np.ones((count, 3), np.float32)
    weights = np.ones((3, count), np.float32)
    slots, shares = add_similar_views(labels, views, quality, detail, weights, around=around)
    np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-5)
    assert (slots[:, 0] == 0).all()
    assert (shares[eye, 0] > 0.99).all()
    assert np.median(shares[~eye, 0]) < 0.4


def test_levelling_solves_the_screened_poisson_equation() -> None:
    mesh = ellipsoid(2)
    around = Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    rng = np.random.default_rng(1)
    count = len(mesh.vertices)
    weights = (rng.uniform(size=(2, count)) < 0.8).astype(np.float32)
    codes = rng.uniform(100, 160, (2, count, 3)).astype(np.float32)
    agreed = rng.uniform(100, 160, (count, 3)).astype(np.float32)
    found = level_views(weights, codes, agreed, around)
    for k in range(2):
        seen = weights[k] > 0
        joined = seen[around.rows] & seen[around.indices]
        entries = (np.full(joined.sum(), LEVELLING), (around.rows[joined], around.indices[joined]))
        beside = scipy.sparse.csr_array(entries, shape=(count, count))
        system = scipy.sparse.diags_array(1 + beside.sum(axis=1)) - beside
        aims = np.where(seen[:, None], agreed - codes[k], 0.0)
        wanted = scipy.sparse.linalg.splu(system.tocsc()).solve(aims.astype(float))
        np.testing.assert_allclose(found[k, :, :3], wanted, atol=0.2)
