"""Measures the deformed head again with image patches that follow its surface, to correct the bias of dense matching.

Dense matching uses planar windows, so curved skin comes out too flat and too deep (``pipeline.stereo.depth_map``). A
patch of the deformed head (``pipeline.photometric_fit.patches``) has the surface's shape, so it warps correctly into
all its views. The patches are narrower than in the fit, and correct the surface by tenths of a millimetre. Where no
patch of the head matches, the dense stereo points are used.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from pipeline.compute.array_cache import cached_arrays
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.rim import Views, pack_views
from pipeline.detail.outline_points import corrected
from pipeline.head_model.model import HeadModel
from pipeline.photometric_fit.depth_search import DEPTH_LEVEL, Round, find_places, pixels_per_mm, visibility_of
from pipeline.photometric_fit.images import Photographs, load_photographs
from pipeline.photometric_fit.patches import HairProbability, Patches, arrays_of, make_patches, under_hair
from pipeline.photometric_fit.refine import RADIUS_WINDOWS
from rig.camera import Camera
from rig.mesh import Mesh, vertex_normals
from rig.rig import Rig

SAMPLE_MM, CENTRE_MM = 0.7, 1.6  # distance of samples and of patches
SEARCH = Round(window_mm=1.2, blur_mm=0.3, reach_mm=0.8, steps=9)  # 1.6 and 2 mm wide ones were 0.005 mm worse


@dataclass(frozen=True, slots=True, eq=False)
class PatchMeasurements:
    """Holds n vertices of the full mesh, and the measured distance of the surface along their normals."""

    vertex: Int[np.ndarray, " n"]
    distance_mm: Float[np.ndarray, " n"]
    information: Float[np.ndarray, " n"]  # mm^-2, overlap of the patches taken off


@dataclass(frozen=True, slots=True, eq=False)
class PatchSearch:
    """Holds the inputs of a search with patches: the photographs, the cameras with the fit's corrections, and a model's
    patches."""

    model: HeadModel
    patches: Patches
    photographs: Photographs
    views: Views
    cameras: tuple[Camera, ...]
    hair: HairProbability

    def measure(self, vertices: Float[np.ndarray, "v 3"]) -> PatchMeasurements:
        """Measures the surface in the photographs near a head (world frame, mm). Patches without a clear match in
        several views, and those under hair, are left out."""
        level, coarse = self.model.levels["full"], self.model.levels[DEPTH_LEVEL]
        head, hiding = Mesh(vertices, level.faces), Mesh(vertices[coarse.rows], coarse.faces)
        speaks = self.photographs.speaks
        seen_by = visibility_of(head, hiding, self.cameras, self.views, self.patches, speaks)
        scale = pixels_per_mm(self.cameras, vertices.mean(axis=0))
        found = find_places(self.photographs, self.patches, seen_by, self.views, scale, each=SEARCH)
        centres = self.model.vertices(np.zeros(0))[self.patches.centre]
        hidden = under_hair(self.patches, self.hair, self.views.names, seen_by.pixel, seen_by.facing > 0, centres)
        kept = np.flatnonzero(found.several & found.clear & ~hidden)
        overlap = max(1.0, 4.0 * np.pi * SEARCH.window_mm**2 / CENTRE_MM**2)
        information = 1.0 / (overlap * found.variance[kept])
        return PatchMeasurements(self.patches.centre[kept], found.place[kept], information)


def prepare_patch_search(
    model: HeadModel,
    fit: Fit,
    images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
    distances: Mapping[str, Float32[np.ndarray, "h w"]],
    hair: HairProbability,
    rig: Rig,
) -> PatchSearch:
    """Prepares the patch search: chooses patches on ``model``, and loads the photographs of views with a silhouette.

    ``model``: the model on whose full mesh the patches lie. ``fit``: holds the cameras' corrections. ``images``: sRGB
    photographs by camera. ``distances``: signed distances to the silhouettes (px), by camera. ``hair``: for each
    camera, the probability that a pixel shows hair. ``rig``: the cameras as calibrated.
    """
    views = pack_views(rig, dict(distances))
    cameras = tuple(corrected(rig[name], fit) for name in views.names)
    return PatchSearch(model, _patches(model), load_photographs(images, views), views, cameras, hair)


@lru_cache(maxsize=1)  # studios work with one model
def _patches(model: HeadModel) -> Patches:
    level, mean = model.levels["full"], model.vertices(np.zeros(0))
    sizes = {"sample_mm": SAMPLE_MM, "centre_mm": CENTRE_MM, "radius_mm": RADIUS_WINDOWS * SEARCH.window_mm}
    kept = cached_arrays(
        "fine-patches",
        (mean, level.faces, level.face_region, sizes),
        lambda: arrays_of(make_patches(model, **sizes)),
        made_by=(make_patches, vertex_normals),
    )
    return Patches(**kept)
