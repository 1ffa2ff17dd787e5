"""Holds the project's only estimator: robust least squares over a sum of terms, by Levenberg-Marquardt.

In: terms, each with its equation; a start; a function that applies a step to a value. Out: a ``Solution`` with its
evidence. This package knows nothing of heads, cameras or boards; the caller chooses the estimated type.
"""
