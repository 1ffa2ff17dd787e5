"""Holds the least-squares estimator that the whole project uses: Levenberg-Marquardt on a sum of robust terms.

The input is the terms of the cost, a starting value, and a function that applies a step to a value. The output is a
``Solution``: the best value, and how the search ended. This package contains nothing about heads or cameras; the caller
chooses the type of the estimated value."""
