"""The one estimator of the project: robust least squares over a sum of terms, by Levenberg-Marquardt.

Enters: terms, each with its equation; a start; a function that applies a step to it. Leaves: a ``Solution`` with its
evidence. The room knows nothing of heads, cameras or boards; the caller chooses the type that is estimated.
"""
