"""The extremum between samples: the parabola through three equidistant values."""

from typing import TypeVar

import numpy as np

Values = TypeVar("Values", float, np.ndarray)


def second_difference(before: Values, middle: Values, after: Values) -> Values:
    """Returns the parabola's second derivative, per step squared: negative at a peak."""
    return before - 2.0 * middle + after


def vertex_offset(before: Values, after: Values, curvature: Values) -> Values:
    """Returns the vertex's distance from the middle value, in steps towards ``after``.

    Args:
        before: value a step before the middle one.
        after: value a step behind it.
        curvature: ``second_difference`` of the three, which must not be 0; callers bound it by what their noise allows.
    """
    return 0.5 * (before - after) / curvature
