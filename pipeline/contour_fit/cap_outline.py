"""Takes a thin cap off the outlines: along it an outline is that of the skull, farther out by the cap's thickness."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.contour_fit.bare_outline import REACH_MM, cells_along, largest_outline, share_inside
from pipeline.contour_fit.clutter import CELL_PX
from pipeline.contour_fit.rim import Views
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.cap import Cap
from rig.rig import Rig

SHOWN = 0.5  # of what lies just inside an outline, from which on the cap makes it


@dataclass(frozen=True, slots=True, eq=False)
class CapOutline:
    """Holds the silhouettes as they are without the cap, and the square cells (``CELL_PX`` pixels wide) near the
    outline that it makes, by camera."""

    silhouettes: Mapping[str, Silhouette]
    cells: Mapping[str, Bool[np.ndarray, "_ _"]]


def without_cap(
    silhouettes: Mapping[str, Silhouette], cap: Cap, rig: Rig, at_world: Float[np.ndarray, " 3"]
) -> CapOutline:
    """Moves the outlines inwards by the cap's thickness where the cap makes them.

    Args:
        silhouettes: by camera.
        cap: where each camera sees it.
        rig: the cameras as calibrated.
        at_world: about the middle of the head, mm.
    """
    moved, cells = dict(silhouettes), {}
    for name in silhouettes.keys() & cap.masks.keys():
        camera, seen = rig[name], silhouettes[name]
        px_per_mm = camera.intrinsics.fx / float(camera.camera_from_world.apply(at_world[None])[0, 2])
        outline = largest_outline(seen.distance)
        if outline is None:
            continue
        shown = share_inside(seen.distance, cap.masks[name].astype(np.float32), outline, px_per_mm) > SHOWN
        cells[name] = cells_along(outline, shown, seen.distance.shape, REACH_MM * px_per_mm)
        distance = seen.distance + cap.thickness_mm * px_per_mm * _at_pixels(cells[name], seen.distance.shape)
        moved[name] = replace(seen, mask=seen.mask & (distance < 0), distance=distance.astype(np.float32))
    return CapOutline(moved, cells)


def cells_of_views(cells: Mapping[str, Bool[np.ndarray, "_ _"]], views: Views) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """Returns the cells of each view of a contour problem, none of them marked where a camera has none."""
    empty = {
        name: np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), bool)
        for name, (width, height) in zip(views.names, views.size, strict=True)
    }
    return tuple(cells.get(name, empty[name]) for name in views.names)


def _at_pixels(cells: Bool[np.ndarray, "r c"], shape: tuple[int, int]) -> np.ndarray:
    rows, columns = cells.shape
    whole = cv2.resize(cells.astype(np.float32), (columns * CELL_PX, rows * CELL_PX), interpolation=cv2.INTER_LINEAR)
    return whole[: shape[0], : shape[1]]
