"""Finds the extremum between samples, by the parabola through three equidistant values."""

from typing import TypeVar

import numpy as np

Values = TypeVar("Values", float, np.ndarray)


def second_difference(before: Values, middle: Values, after: Values) -> Values:
    """Returns the second derivative of the parabola, per step squared; it is negative at a peak."""
    return before - 2.0 * middle + after


def vertex_offset(before: Values, after: Values, curvature: Values) -> Values:
    """Returns the distance of the parabola's vertex from the middle value, in steps towards ``after``.

    Args:
        before: the value one step before the middle one.
        after: the value one step behind the middle one.
        curvature: ``second_difference`` of the three. It must not be 0; callers bound it by the noise of their values.
    """
    return 0.5 * (before - after) / curvature
