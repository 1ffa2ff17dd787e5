"""Finds views whose picture of the face is unlike the others': of another moment, expression or person.

Every view gives each vertex of the fitted head a colour. Over a region of the face, the brightness from one view is
correlated with the mean of the others'. Views of one moment are alike but for gloss and shade (0.9 to 1.0); a mouth
that is open in one of them makes that 0.2 to 0.6, another person -0.5 to 0.3.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32

MIN_LIKENESS = 0.62  # of the others' to each other: 0.73 and more in 33 clean captures, below 0.63 with an open jaw
AGREEING = 0.7  # correlation of the others, below which none can be judged by them: of spectacles before a face 0.65
MIN_SHARE = 0.28  # of a region, which a view must show to be compared: profiles show half, cameras behind a temple
SEEN = 0.2  # of the weight of the best view, with which another one shows a vertex
DARK = 0.02  # linear; noise below it is no likeness

Plane = Float32[np.ndarray, "k n"]


def find_unlike(
    weights: Plane, colours: Float32[np.ndarray, "k n 3"], regions: Sequence[Bool[np.ndarray, " n"]]
) -> dict[int, float]:
    """Returns the views, by their row, that are unlike the others, each with its likeness to them (a correlation). A
    view is left out before the next one is sought; two views do not tell which of them is odd.

    ``weights``: of each view at each vertex, 0 where it does not show the face. ``colours``: linear, cameras balanced.
    """
    level = np.log(np.maximum(colours.mean(axis=2), 0.0) + DARK)
    left, found = list(range(len(weights))), dict[int, float]()
    while len(left) > 2:
        odd = min(_judge(weights[left][:, region], level[left][:, region]) for region in regions)
        if odd[0] >= MIN_LIKENESS:
            break
        found[left.pop(odd[2])] = odd[1]
    return found


def _judge(weights: Plane, level: Plane) -> tuple[float, float, int]:
    """Returns of the view that is least like the others: its likeness as a share of theirs, its likeness, its row."""
    alike = _likeness(weights, level)
    if np.isnan(alike).all():
        return np.inf, np.nan, 0
    odd = int(np.nanargmin(alike))
    rest = _likeness(np.delete(weights, odd, axis=0), np.delete(level, odd, axis=0))
    agreeing = float(np.nanmedian(rest)) if np.isfinite(rest).any() else 0.0
    return float(alike[odd]) / agreeing if agreeing > AGREEING else np.inf, float(alike[odd]), odd


def _likeness(weights: Plane, level: Plane) -> Float[np.ndarray, " k"]:
    """Returns the correlation of each view's ``level`` with the mean of the others'; NaN of a view with too little."""
    total, weighted, best = weights.sum(axis=0), (weights * level).sum(axis=0), weights.max(axis=0)
    found = np.full(len(weights), np.nan)
    for k, weight in enumerate(weights):
        others = total - weight
        both = (weight > SEEN * best) & (others > SEEN * best)
        if not both.any() or both.sum() < MIN_SHARE * np.count_nonzero(best):
            continue
        shared = np.minimum(weight, others)[both]
        mean = (weighted - weight * level[k])[both] / others[both]
        one, two = (each - np.average(each, weights=shared) for each in (level[k, both], mean))
        spread = float((shared * one**2).sum() * (shared * two**2).sum())
        found[k] = float((shared * one * two).sum()) / max(np.sqrt(spread), 1e-9)
    return found
