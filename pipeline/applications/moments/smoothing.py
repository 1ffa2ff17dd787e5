"""Smooths each unknown of a sequence over time, using earlier and later frames, as strongly as its noise requires.

For an unknown x, measured as y_t with standard deviation s_t in each of T frames, the smooth course minimises this
cost:

    sum_t (x_t - y_t)^2 / s_t^2 + sum_t log(q^2 + a_t^2) ,    a_t = x_t+1 - 2 x_t + x_t-1

Here q is a multiple of the noise in the acceleration a_t. The logarithm suppresses accelerations that noise can explain
and hardly changes larger ones, so blinks are not flattened. The unknowns of a group, such as the three rotation angles,
share one weight for their accelerations. The minimum is found by iteratively reweighted least squares with a
pentadiagonal Cholesky factor, which also gives the standard deviations. A frame without a measurement is interpolated,
assuming accelerations typical of the sequence."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

STIFFNESS = 0.1  # q by the noise
ROUNDS = 12
QUIET = 0.25  # quantile of accelerations that are noise: people rest between movements
QUIET_NORMAL = 0.3186 * 6.0**0.5  # the same quantile for unit noise
MIN_NOISE = (
    1e-3  # of a deviation, that noise is at least: a weight that stays 0 has none, and would be infinitely stiff
)
Courses = Float[np.ndarray, "t p"]


def smooth(
    measured: Courses, deviation: Courses, failed: Bool[np.ndarray, " t"], groups: Sequence[Int[np.ndarray, " g"]]
) -> tuple[Courses, Courses]:
    """Returns the smoothed courses and their standard deviations.

    Args:
        measured: the measured courses; values at failed frames are ignored.
        deviation: the standard deviation of each measurement, from all sources of error.
        failed: a mask of the frames without a measurement.
        groups: groups of unknowns that accelerate together; each unknown must be in one group.
    """
    known = np.flatnonzero(~failed)
    if len(measured) < 3 or len(known) < 2:
        return measured, deviation
    course = np.stack([np.interp(np.arange(len(measured)), known, column[known]) for column in measured.T], axis=1)
    spread = np.stack([np.interp(np.arange(len(measured)), known, column[known]) for column in deviation.T], axis=1)
    jerks = np.abs(np.diff(course, 2, axis=0))[~(failed[:-2] | failed[1:-1] | failed[2:])]
    level = np.quantile(jerks, QUIET, axis=0) / QUIET_NORMAL if len(jerks) else np.median(spread, axis=0)
    noise = spread * np.clip(level / np.median(spread, axis=0), MIN_NOISE, 1.0)
    information = np.where(failed[:, None], 0.0, noise**-2)
    least = (STIFFNESS * np.median(noise, axis=0)) ** 2
    held, found = np.ones((len(course) - 2, course.shape[1])), course
    for _ in range(ROUNDS):
        held = 1.0 / _together(least + np.diff(found, 2, axis=0) ** 2, groups)
        found = _solve(_factor(information, held), information * course)
    usual = (np.diff(found, 2, axis=0) ** 2).mean(axis=0)
    near = failed[:-2] | failed[1:-1] | failed[2:]
    held = np.where(near[:, None], np.minimum(held, 1.0 / (least + usual)), held)
    variance = _inverse_diagonal(_factor(information, held))
    lasting = np.where(failed[:, None], spread**2, np.maximum(spread**2 - noise**2, 0.0))  # cannot be smoothed
    return found, np.sqrt(lasting + variance)


def _together(squares: Courses, groups: Sequence[Int[np.ndarray, " g"]]) -> Courses:
    out = np.empty_like(squares)
    for rows in groups:
        out[:, rows] = squares[:, rows].mean(axis=1, keepdims=True)
    return out


def _factor(information: Courses, held: Float[np.ndarray, "t-2 p"]) -> tuple[Courses, Courses, Courses]:
    """Returns the factorization L D L^T of the pentadiagonal matrices: D, and the two subdiagonals of L."""
    count = len(information)
    main, first, second = information.copy(), np.zeros_like(information), np.zeros_like(information)
    main[:-2] += held
    main[1:-1] += 4.0 * held
    main[2:] += held
    first[1:-1] -= 2.0 * held  # row t, column t - 1
    first[2:] -= 2.0 * held
    second[2:] += held
    for t in range(count):
        if t > 1:
            second[t] /= main[t - 2]
            first[t] -= second[t] * main[t - 2] * first[t - 1]
            main[t] -= second[t] ** 2 * main[t - 2]
        if t > 0:
            first[t] /= main[t - 1]
            main[t] -= first[t] ** 2 * main[t - 1]
    return main, first, second


def _solve(factor: tuple[Courses, Courses, Courses], right: Courses) -> Courses:
    (main, first, second), found = factor, right.copy()
    count = len(found)
    for t in range(1, count):
        found[t] -= first[t] * found[t - 1]
        if t > 1:
            found[t] -= second[t] * found[t - 2]
    found /= main
    for t in range(count - 2, -1, -1):
        found[t] -= first[t + 1] * found[t + 1]
        if t < count - 2:
            found[t] -= second[t + 2] * found[t + 2]
    return found


def _inverse_diagonal(factor: tuple[Courses, Courses, Courses]) -> Courses:
    """Returns the diagonal of the inverse Z = L^-T D^-1 + (1 - L^T) Z, of which only five diagonals are needed
    (Takahashi, Fagan and Chen 1973)."""
    main, first, second = factor
    count = len(main)
    same, beside, beyond = 1.0 / main, np.zeros_like(main), np.zeros_like(main)  # Z at (t, t), (t, t+1), (t, t+2)
    for t in range(count - 2, -1, -1):
        one = first[t + 1]
        two = second[t + 2] if t < count - 2 else np.zeros_like(one)
        after = beside[t + 1] if t < count - 2 else np.zeros_like(one)
        last = same[t + 2] if t < count - 2 else np.zeros_like(one)
        beside[t] = -one * same[t + 1] - two * after
        beyond[t] = -one * after - two * last
        same[t] = 1.0 / main[t] - one * beside[t] - two * beyond[t]
    return same
