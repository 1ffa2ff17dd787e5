"""Decides where the bust ends: along a smooth surface where photographs end, and at a plane behind what cameras see.

Photographs of several cameras end at several planes, whose edges nobody wants to see in a shoulder; and behind neck
and shoulders, where no camera looks, outlines alone leave hoods and slabs. The head goes on to the fitted head's back.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.compute.trace import traced
from pipeline.fusion.grid import Grid, at_points
from pipeline.fusion.grid_kernels import doubled
from pipeline.fusion.prior import near_rim
from pipeline.fusion.view_stack import ViewStack
from pipeline.fusion.vote_kernels import CENTRE
from pipeline.geometry.nearest import PointTree, nearest
from rig.mesh import Mesh

ROUND_MM = 12.0  # standard deviation of the blur that rounds the edges between photographs' ends
THIN_MM, SPARED_MM = 6.0, 4.0  # radius, and by how much a place must stand out: a step of the grid is no rag
BASE_QUANTILE = 0.7  # of the seen points below the head, by height: what lies lower is the base
FAR_MM = 100.0  # distances count up to this one
ONE_SIDED = 0.3  # length of the mean direction to the cameras above which nobody stands behind the subject
BEHIND_QUANTILE, THICK_QUANTILE = 0.998, 0.9  # of seen points (to the front, too), and of their heights: the hair
EVERY = 4  # vertices of the head stand for the others


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Holds at every node of a whole box how far (mm, positive outside) it lies beyond the bust's end."""

    box: Grid
    beyond_mm: Float[np.ndarray, " n"]
    base: Bool[np.ndarray, " n"]  # nodes in the lowest part of what is seen below the head
    before_mm: Float[np.ndarray, " n"] | None = None  # how far nodes below the head lie before its chest; else -inf

    def distance_mm(self, places: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
        """Returns how far (mm, negative inside) points lie beyond the bust's end."""
        return at_points(self.box, self.beyond_mm, places)

    def without_rags(self, box: Grid, field: Float[np.ndarray, "nx ny nz"]) -> "Cut":
        """Returns the cut at half the step, which also takes off what is too thin for a ball of radius ``THIN_MM`` at
        the base of the bust: there the depth of few views frays. ``field`` (mm, negative inside) is the signed distance
        over the whole of ``box``."""
        from scipy.ndimage import distance_transform_edt, gaussian_filter  # 0.3 s, and only a bust needs it

        shape = self.box.shape
        beyond, base = (doubled(each.astype(np.float32).reshape(shape)) for each in (self.beyond_mm, self.base))
        core = eroded(field < 0.0, THIN_MM / box.step_mm)
        thin = gaussian_filter(box.step_mm * np.asarray(distance_transform_edt(~core)), 1.0) - THIN_MM - SPARED_MM
        return Cut(box, np.where(base > 0.5, np.maximum(beyond, thin), beyond).ravel(), base.ravel() > 0.5)


def eroded(solid: Bool[np.ndarray, "nx ny nz"], radius: float) -> Bool[np.ndarray, "nx ny nz"]:
    """Returns the nodes that have none outside the solid within ``radius`` (in steps). The box's own end is no
    outside."""
    out, reach = solid.copy(), int(radius)
    for steps in np.ndindex((2 * reach + 1,) * 3):
        step = np.array(steps) - reach
        if 0 < step @ step <= radius**2:
            here = tuple(slice(max(-n, 0), size - max(n, 0)) for n, size in zip(step, solid.shape, strict=True))
            there = tuple(slice(max(n, 0), size - max(-n, 0)) for n, size in zip(step, solid.shape, strict=True))
            out[here] &= solid[there]
    return out


@traced
def find_cut(box: Grid, views: ViewStack, seen: Float[np.ndarray, "m 3"], head_world: Mesh | None) -> Cut:
    """Determines where the bust ends.

    Args:
        box: a whole box of nodes.
        views: the cameras and their photographs' edges.
        seen: points of the surface that is seen, world frame, mm.
        head_world: the fitted head; without it only photographs' ends count.
    """
    from scipy.ndimage import gaussian_filter  # 0.05 s

    places = box.places()
    edges_mm = np.sort(views.outside(places)[0], axis=0)
    frames = np.clip(edges_mm[min(1, len(edges_mm) - 1)], -FAR_MM, FAR_MM)  # of all cameras but one
    beyond = gaussian_filter(frames.reshape(box.shape), ROUND_MM / box.step_mm).ravel() - SPARED_MM
    if head_world is None:
        return Cut(box, beyond, np.zeros(len(beyond), bool))
    vertices = head_world.vertices[::EVERY]
    tree, low = PointTree.of(vertices), near_rim(head_world, vertices)
    far, near = nearest(tree, seen)
    if low[near].all() or not low[near].any():
        return Cut(box, beyond, np.zeros(len(beyond), bool))
    below, down = low[near], vertices[low].mean(axis=0) - vertices.mean(axis=0)
    base = places @ down > np.quantile(seen[below] @ down, BASE_QUANTILE)
    base[base] = low[nearest(tree, places[base])[1]]
    towards = views.cameras[:, CENTRE:] - np.median(seen, axis=0)
    before = None
    back = -(towards / np.linalg.norm(towards, axis=1, keepdims=True)).mean(axis=0)
    if np.linalg.norm(back) > ONE_SIDED:
        back /= np.linalg.norm(back)
        end = max(np.quantile(seen[below] @ back, BEHIND_QUANTILE), (vertices[low] @ back).max())
        head_end = (vertices @ back).max() + np.quantile(far[~below], THICK_QUANTILE)
        under = low[nearest(tree, places)[1]]
        beyond = np.maximum(beyond, places @ back - np.where(under, end, head_end))
        chest = min(np.quantile(seen[below] @ back, 1.0 - BEHIND_QUANTILE), (vertices[low] @ back).min())
        before = np.where(under, chest - places @ back, -np.inf)
    return Cut(box, beyond, base, before)
