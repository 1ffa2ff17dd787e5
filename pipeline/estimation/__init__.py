"""The one estimator of the project: robust least squares over a sum of terms, by Levenberg-Marquardt.

Enters: terms (each with its equation), a start, how a step moves it. Leaves: a ``Solution`` with its evidence. Knows
nothing of heads, cameras or boards; what is estimated is the caller's type.
"""
