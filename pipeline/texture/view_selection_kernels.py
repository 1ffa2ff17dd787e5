"""Compiled loops of ``pipeline.texture.view_selection`` and ``pipeline.texture.seam_levelling``."""

import numpy as np

from pipeline.compiled import njit

NEVER = np.float32(1e6)  # cost of a view that does not see a vertex
RING_SHARE = 0.7  # of a view's quality that the neighbours decide: beside an occluding edge it soon sees something else


@njit(cache=True, nogil=True)
def ring_quality(weights: np.ndarray, starts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Quality of each view (k, v): its own weight, and the least of the neighbours', which ends beside occlusions."""
    cameras, count = weights.shape
    out = np.zeros((count, cameras), np.float32)
    for v in range(count):
        for k in range(cameras):
            own = weights[k, v]
            if own <= 0:
                continue
            least = own
            for e in range(starts[v], starts[v + 1]):
                least = min(least, weights[k, indices[e]])
            out[v, k] = own * (1 - RING_SHARE) + least * RING_SHARE
    return out


@njit(cache=True, nogil=True)
def best_candidates(costs: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """The ``most`` cheapest views of each vertex, cheapest first (-1 where there are fewer), and their costs."""
    count, cameras = costs.shape
    views = np.full((count, most), -1, np.int32)
    found = np.full((count, most), NEVER, np.float32)
    for v in range(count):
        for k in range(cameras):
            cost = costs[v, k]
            if cost >= NEVER or cost >= found[v, most - 1]:
                continue
            place = most - 1
            while place > 0 and found[v, place - 1] > cost:
                found[v, place], views[v, place] = found[v, place - 1], views[v, place - 1]
                place -= 1
            found[v, place], views[v, place] = cost, k
    return views, found


@njit(cache=True, nogil=True)
def propagate(
    views: np.ndarray,
    costs: np.ndarray,
    starts: np.ndarray,
    indices: np.ndarray,
    opposite: np.ndarray,
    penalty: np.ndarray,
    cameras: int,
    sweeps: int,
) -> np.ndarray:
    """Min-sum belief propagation with a Potts term; the place of each vertex's label among its candidates.

    ``penalty`` is what a change of view costs along each directed edge, ``opposite`` the same edge the other way. A
    message is kept at its edge, for the candidates of its receiver, less what it says of every other label.
    """
    count, most = views.shape
    messages = np.zeros((len(indices), most), np.float32)  # of edge e = (v, w): what w tells v
    belief, by_view = np.zeros(most, np.float32), np.full(cameras, NEVER, np.float32)
    for sweep in range(sweeps):
        for step in range(count):
            v = step if sweep % 2 == 0 else count - 1 - step
            for c in range(most):
                belief[c] = costs[v, c]
                for e in range(starts[v], starts[v + 1]):
                    belief[c] += messages[e, c]
            for e in range(starts[v], starts[v + 1]):
                least = NEVER
                for c in range(most):
                    if views[v, c] >= 0:
                        told = belief[c] - messages[e, c]
                        by_view[views[v, c]] = told
                        least = min(least, told)
                back, receiver = opposite[e], indices[e]
                limit = least + penalty[e]
                for c in range(most):
                    label = views[receiver, c]
                    told = by_view[label] if label >= 0 else NEVER
                    messages[back, c] = min(told, limit) - limit
            for c in range(most):
                if views[v, c] >= 0:
                    by_view[views[v, c]] = NEVER
    chosen = np.full(count, -1, np.int32)
    for v in range(count):
        least = NEVER
        for c in range(most):
            if views[v, c] >= 0:
                total = costs[v, c]
                for e in range(starts[v], starts[v + 1]):
                    total += messages[e, c]
                if chosen[v] < 0 or total < least:
                    least, chosen[v] = total, c
    return chosen


@njit(cache=True, nogil=True)
def level(
    aims: np.ndarray,
    trust: np.ndarray,
    steps: np.ndarray,
    strengths: np.ndarray,
    starts: np.ndarray,
    indices: np.ndarray,
    sweeps: int,
    factor: float,
) -> np.ndarray:
    """Corrections (v, 4) that minimise ``trust |c_v - aim_v|^2 + strength |c_v - c_w - step_vw|^2``, over-relaxed
    Gauss-Seidel there and back."""
    count = len(aims)
    out = aims.copy()
    for sweep in range(sweeps):
        for turn in range(count):
            v = turn if sweep % 2 == 0 else count - 1 - turn
            share = trust[v]
            a, b, c = share * aims[v, 0], share * aims[v, 1], share * aims[v, 2]
            for e in range(starts[v], starts[v + 1]):
                strength, w = strengths[e], indices[e]
                a += strength * (out[w, 0] + steps[e, 0])
                b += strength * (out[w, 1] + steps[e, 1])
                c += strength * (out[w, 2] + steps[e, 2])
                share += strength
            if share > 0:
                move = factor / share
                out[v, 0] += factor * -out[v, 0] + move * a
                out[v, 1] += factor * -out[v, 1] + move * b
                out[v, 2] += factor * -out[v, 2] + move * c
    return out
