"""Decides where the bust ends: along a smooth surface where photographs end, and at a plane behind what cameras see.

Photographs of several cameras end at several planes, whose edges nobody wants to see in a shoulder; and what lies
behind neck and shoulders, where no camera looks, is known by no one: outlines alone leave hoods and slabs there. The
head itself goes on to its back, whose shape the fitted head has.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.grid import Grid, at_points
from pipeline.fusion.prior import near_rim
from pipeline.fusion.view_stack import ViewStack
from pipeline.fusion.vote_kernels import CENTRE, FRAME, PIXEL_STEP
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.projection_kernels import LENS
from rig.mesh import Mesh

ROUND_MM = 20.0  # standard deviation of the blur that rounds the edges between photographs' ends
INSET_MM = 3.0  # from the photographs' ends: windows that reach over them match badly
FAR_MM = 100.0  # distances count up to this one
ONE_SIDED = 0.3  # length of the mean direction to the cameras above which nobody stands behind the subject
BEHIND_QUANTILE = 0.99  # of seen points: single ones lie anywhere
EVERY = 4  # vertices of the head stand for the others


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Holds at every node of a whole box how far (mm, positive outside) it lies beyond the bust's end."""

    box: Grid
    beyond_mm: Float[np.ndarray, " n"]

    def distance_mm(self, places: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
        """Returns how far (mm, negative inside) points lie beyond the bust's end."""
        return at_points(self.box, self.beyond_mm, places)


@traced
def find_cut(box: Grid, views: ViewStack, seen: Float[np.ndarray, "m 3"], head_world: Mesh | None) -> Cut:
    """Determines where the bust ends.

    Args:
        box: a whole box of nodes.
        views: the cameras and their photographs' edges.
        seen: points of the surface that is seen, world frame, mm.
        head_world: the fitted head; without it nothing is cut behind the subject.
    """
    from scipy.ndimage import gaussian_filter  # 0.05 s, and only a bust needs it

    places = box.places()
    frames = gaussian_filter(outside_photographs(places, views).reshape(box.shape), ROUND_MM / box.step_mm)
    beyond = frames.ravel() + INSET_MM
    towards = views.cameras[:, CENTRE:] - np.median(seen, axis=0)
    back = -(towards / np.linalg.norm(towards, axis=1, keepdims=True)).mean(axis=0)
    if head_world is None or np.linalg.norm(back) < ONE_SIDED:
        return Cut(box, beyond)
    back /= np.linalg.norm(back)
    vertices = head_world.vertices[::EVERY]
    tree, low = PointTree.of(vertices), near_rim(head_world, vertices)
    below = low[nearest(tree, seen)[1]]
    if not low.any() or not below.any():
        return Cut(box, beyond)
    end = max(float(np.quantile(seen[below] @ back, BEHIND_QUANTILE)), float((vertices[low] @ back).max()))
    under = low[nearest(tree, places)[1]]
    return Cut(box, np.where(under, np.maximum(beyond, places @ back - end), beyond))


def outside_photographs(places: Float[np.ndarray, "n 3"], views: ViewStack) -> Float[np.ndarray, " n"]:
    """Returns how far (mm, negative inside) points lie outside the photographs of all cameras but one."""

    def outside(view: int) -> Float[np.ndarray, " n"]:
        camera, size = views.cameras[view], views.sizes[view][::-1]
        x, y, z = camera[:9].reshape(3, 3) @ places.T + camera[9:12, None]
        fx, fy, cx, cy = camera[LENS : LENS + 4]
        depth = np.maximum(z, 1.0)
        pixel = np.stack([fx * x / depth + cx, fy * y / depth + cy], axis=1)
        within = np.clip(pixel, 0, size - 1.0)
        column, row = (within + 0.5).astype(int).T
        edge = PIXEL_STEP * views.shown[views.starts[view] + row * size[0] + column, FRAME]
        return np.where(z > 1.0, (edge + np.linalg.norm(pixel - within, axis=1)) * depth / fx, FAR_MM)

    edges = np.stack(map_in_threads(outside, len(views.cameras)))
    second = np.partition(edges, min(1, len(edges) - 1), axis=0)[min(1, len(edges) - 1)]
    return np.clip(second, -FAR_MM, FAR_MM)
