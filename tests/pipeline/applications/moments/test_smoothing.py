"""The smoother against dense equations, and on courses that rest, blink and fail."""

import numpy as np

from pipeline.applications.moments.smoothing import _factor, _inverse_diagonal, _solve, smooth

BLINK = np.array([0.35, 0.85, 1.0, 0.9, 0.6, 0.3, 0.1])
NOISE = 0.01


def test_the_factor_solves_and_inverts_five_diagonals() -> None:
    rng, count = np.random.default_rng(0), 12
    information, held = rng.uniform(0.5, 2.0, (count, 2)), rng.uniform(0.5, 2.0, (count - 2, 2))
    right, second = rng.standard_normal((count, 2)), np.diff(np.eye(count), 2, axis=0)
    factor = _factor(information, held)
    for k in range(2):
        dense = np.diag(information[:, k]) + second.T @ np.diag(held[:, k]) @ second
        np.testing.assert_allclose(_solve(factor, right)[:, k], np.linalg.solve(dense, right[:, k]), atol=1e-10)
        np.testing.assert_allclose(_inverse_diagonal(factor)[:, k], np.diag(np.linalg.inv(dense)), atol=1e-10)


def test_a_course_at_rest_is_smoothed_and_a_blink_is_kept() -> None:
    true = np.zeros((200, 1))
    for at in (50, 120):
        true[at : at + len(BLINK), 0] = BLINK
    measured = true + NOISE * np.random.default_rng(1).standard_normal(true.shape)
    found, _ = smooth(measured, np.full_like(true, 0.05), np.zeros(200, bool), [np.array([0])])
    # Noise of one frame in n that are averaged falls by sqrt(n); at this stiffness n is 9 or more.
    assert (found - true)[70:110].std() < NOISE / 3.0
    for at in (50, 120):
        blink = slice(at, at + len(BLINK))
        assert np.abs(found[blink, 0] - BLINK).max() < 4.0 * NOISE
        assert found[blink, 0].argmax() == BLINK.argmax()


def test_a_failed_frame_follows_from_its_neighbours_with_a_larger_deviation() -> None:
    time = np.arange(100)
    true = np.sin(time / 8.0)[:, None]
    measured = true + NOISE * np.random.default_rng(2).standard_normal(true.shape)
    failed = np.isin(time, (60, 61, 62))
    measured[failed] = 7.0
    deviation = np.where(failed[:, None], np.inf, 2.0 * NOISE)
    found, spread = smooth(measured, deviation, failed, [np.array([0])])
    assert np.isfinite(spread).all()
    assert spread[61, 0] > spread[~failed].max()
    assert np.abs(found - true)[failed].max() < 3.0 * spread[61, 0]


def test_frames_that_failed_at_the_beginning_follow_from_what_rests() -> None:
    rng, failed = np.random.default_rng(3), np.isin(np.arange(12), (0, 1, 2, 3, 7))
    measured = np.zeros((12, 50))
    measured[4:6] = rng.uniform(0.0, 0.1, (2, 50))  # the other frames are at a weight's bound
    deviation = np.where(failed[:, None], np.inf, rng.uniform(0.15, 0.2, measured.shape))
    found, spread = smooth(measured, deviation, failed, list(np.arange(50)[:, None]))
    assert np.abs(found).max() < 0.6  # a straight line to the first frame
    assert spread[failed].min() > 0.14
