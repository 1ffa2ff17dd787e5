"""A population that is updated by heads comes nearer to theirs, and only as far as the heads are known."""

import numpy as np
import pytest

from pipeline.applications.verification.delivered_heads import Population, pooled, updated
from pipeline.head_model.pca import orthogonalised, principal_components

VERTICES = 240
PLACES = np.random.default_rng(1).uniform(-100.0, 100.0, (VERTICES, 3))


def smooth_fields(rng: np.random.Generator, count: int, amplitude_mm: float) -> np.ndarray:
    """Random displacements of the vertices that neighbours share over 40 mm."""
    centres = PLACES[rng.choice(VERTICES, 40, replace=False)]
    near = np.exp(-((PLACES[:, None] - centres) ** 2).sum(axis=2) / (2 * 40.0**2))
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    return amplitude_mm * np.einsum("vc,ncx->nvx", near, rng.standard_normal((count, 40, 3)))


def draws(population: Population, rng: np.random.Generator, count: int) -> np.ndarray:
    return population.mean + np.tensordot(rng.standard_normal((count, len(population.modes))), population.modes, 1)


def left_mm(population: Population, heads: np.ndarray, modes: int = 12) -> float:
    """How far heads are from the first modes."""
    basis = population.modes[:modes].reshape(-1, VERTICES * 3)
    basis = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    offsets = (heads - population.mean).reshape(len(heads), -1)
    return float(np.linalg.norm((offsets - offsets @ basis.T @ basis).reshape(-1, 3), axis=1).mean())


def predicted_mm(population: Population, heads: np.ndarray) -> float:
    """How far the left halves of heads are from what their right halves, known to 0.5 mm, let expect."""
    right = PLACES[:, 0] > 0
    flat, offsets = (
        population.modes.reshape(len(population.modes), -1),
        (heads - population.mean).reshape(len(heads), -1),
    )
    basis = flat[:, np.repeat(right, 3)] / 0.5
    weights = np.linalg.inv(np.eye(len(flat)) + basis @ basis.T)
    expected = (offsets[:, np.repeat(right, 3)] / 0.5) @ basis.T @ weights @ flat
    return float(np.linalg.norm((offsets - expected).reshape(len(heads), -1, 3), axis=2)[:, ~right].mean())


@pytest.fixture
def known() -> Population:
    rng = np.random.default_rng(2)
    return Population(PLACES, orthogonalised(smooth_fields(rng, 30, 3.0))[0])


@pytest.fixture
def others() -> Population:
    """A population with a mean and modes of its own."""
    rng = np.random.default_rng(3)
    return Population(PLACES + smooth_fields(rng, 1, 4.0)[0], orthogonalised(smooth_fields(rng, 8, 3.0))[0])


def found(known: Population, heads: np.ndarray, deviation_mm: np.ndarray) -> Population:
    components = updated(known, heads, deviation_mm)
    return Population(components.mean, components.modes)


@pytest.mark.parametrize("count", [4, 12, 40])
def test_unseen_heads_are_nearer_to_it_than_to_either_alone(known: Population, others: Population, count: int) -> None:
    rng = np.random.default_rng(count)
    heads, unseen = draws(others, rng, count), draws(others, rng, 30)
    after = left_mm(found(known, heads, np.full((count, VERTICES), 0.1)), unseen)
    alone = principal_components(heads)
    assert after < 0.85 * left_mm(known, unseen)
    if count == 4:  # with many heads of 8 modes nothing is left to learn
        assert after < left_mm(Population(alone.mean, alone.modes), unseen)


def test_where_a_deviation_is_stated_an_error_counts_for_less(known: Population, others: Population) -> None:
    rng = np.random.default_rng(4)
    heads, unseen = draws(others, rng, 30), draws(others, rng, 40)
    spoilt = heads.copy()
    spoilt[::2] += smooth_fields(rng, 15, 3.0)
    deviation = np.full((30, VERTICES), 0.1)
    silent = predicted_mm(found(known, spoilt, deviation), unseen)
    deviation[::2] = 3.0
    stated = predicted_mm(found(known, spoilt, deviation), unseen)
    assert stated < 0.85 * silent


def test_heads_of_which_nothing_is_known_change_nothing(known: Population, others: Population) -> None:
    heads = draws(others, np.random.default_rng(5), 10)
    now = found(known, heads, np.full((10, VERTICES), 1e4))
    first = pooled(known, heads)
    moved = np.linalg.norm(now.mean - known.mean, axis=1).mean()
    assert moved < 0.5 * np.linalg.norm(first.mean - known.mean, axis=1).mean()


def test_exact_heads_give_the_posterior_of_the_textbook(known: Population, others: Population) -> None:
    heads = draws(others, np.random.default_rng(6), 25)
    count, prior_mean, prior_spread = 25, 5.0, 20.0
    flat, mean = heads.reshape(count, -1), known.mean.ravel()
    average = flat.mean(axis=0)
    scatter = (flat - average).T @ (flat - average) + prior_spread * known.modes.reshape(
        -1, mean.size
    ).T @ known.modes.reshape(-1, mean.size)
    scatter += count * prior_mean / (count + prior_mean) * np.outer(average - mean, average - mean)
    now = updated(known, heads, np.full((count, VERTICES), 1e-4))
    modes = now.modes.reshape(len(now.modes), -1)
    np.testing.assert_allclose(modes.T @ modes, scatter / (count - 1 + prior_spread), atol=1e-3)
    np.testing.assert_allclose(
        now.mean.ravel(), (count * average + prior_mean * mean) / (count + prior_mean), atol=1e-4
    )
    np.testing.assert_allclose(now.mean + np.tensordot(now.scores, now.modes, 1), heads, atol=1e-3)
