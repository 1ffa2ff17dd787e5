"""Finds the curve at which a bust ends if masks cut the subject off inside the pictures.

Masks of other programs often end at the chest. Near a mask's end depth is unreliable, and the surface would have a
ragged edge. The bust therefore ends at a distance from the head that is a smooth function of direction.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.fusion.view_stack import ViewStack

SECTORS, MIN_SEEN = 72, 20  # around the head; and seen points of a sector that has a rim
FARTHEST = 0.97  # quantile of the distances of a sector's points: what lies beyond is its rim
STEP_MM = 20.0  # outwards from the rim: there outlines that end the bust no longer hold it
RIDGE = (0.0, 0.02, 0.02, 0.05, 0.05, 0.1, 0.1)  # of each term: sectors without a rim follow the others
FRAYED, INSET_MM = 0.15, 6.0  # quantile of the rim's distances to the smooth one, and how far inside it the bust ends
REACH = 1.2  # of the rim's directions: farther out terms of the third order would run away

Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """Holds the lower end of the seen surface: k points (world frame, mm), one in each sector around the head."""

    points: Float[np.ndarray, "k 3"]
    centre: Float[np.ndarray, " 3"]  # of the head
    across: Float[np.ndarray, "3 2"]  # two unit vectors across the direction from the head to its neck

    def share_ended(self, views: ViewStack) -> float:
        """Returns the fraction (0 to 1) of the rim's points beyond which most pictures show no subject."""
        outwards = self.points - self.centre
        frame_mm, outline_mm = views.outside(
            self.points + STEP_MM * outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
        )
        held = frame_mm < 0.0
        return float((2 * (held & (outline_mm > 0.0)).sum(axis=0) > held.sum(axis=0)).mean())

    def beyond_mm(self, places: Points) -> Float[np.ndarray, " n"]:
        """Returns the signed distance (mm, negative inside) of points to the smooth rim."""
        far, direction = self._directions(self.points)
        radius = np.quantile(np.hypot(*direction.T), 0.9)
        terms = _terms(direction / radius)
        middle = far.mean()
        square = terms.T @ terms + len(far) * np.diag(RIDGE)
        factors = np.linalg.solve(square, terms.T @ (far - middle))
        middle += np.quantile(far - middle - terms @ factors, FRAYED) - INSET_MM
        far, direction = self._directions(places)
        return far - middle - _terms(direction / radius) @ factors

    def _directions(self, places: Points) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
        """Returns distances (mm) from the head's centre, and the unit directions' components across its axis."""
        way = places - self.centre
        far = np.linalg.norm(way, axis=1)
        return far, way @ self.across / np.maximum(far, 1e-9)[:, None]


def rim_of(seen: Points, centre: Float[np.ndarray, " 3"], down: Float[np.ndarray, " 3"]) -> Rim | None:
    """Finds the rim of the ``seen`` points below a head (world frame, mm); None if there are too few points. ``down``
    is the unit vector from the head's ``centre`` to its neck."""
    across = np.linalg.svd(down[None])[2][1:].T
    way = seen - centre
    far, angle = np.linalg.norm(way, axis=1), np.arctan2(*(way @ across).T)
    sector = np.floor((angle / (2.0 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    farthest = []
    for number in np.flatnonzero(np.bincount(sector, minlength=SECTORS) >= MIN_SEEN):
        members = np.flatnonzero(sector == number)
        farthest.append(np.median(seen[members[far[members] >= np.quantile(far[members], FARTHEST)]], axis=0))
    return Rim(np.array(farthest), centre, across) if farthest else None


def _terms(direction: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 7"]:
    """Returns the harmonic polynomials of two variables up to third order, whose extrema lie on the boundary."""
    x, y = (direction * np.minimum(1.0, REACH / np.maximum(np.hypot(*direction.T), 1e-9))[:, None]).T
    return np.stack(
        [np.ones(len(x)), x, y, x * x - y * y, 2 * x * y, x**3 - 3 * x * y * y, 3 * x * x * y - y**3], axis=1
    )
