"""Computes observations of the deformed head from the silhouettes' outlines.

On smooth and shiny skin dense matching follows highlights, which lie behind a convex surface, so the tip of the nose
comes out 2 to 3 mm too deep. In profile the silhouettes show the tip of the nose to half a pixel. At the rim the
surface's normal is parallel to the image, so the signed distance to the silhouette is an offset along the normal. Only
the face's rim is used. Pixels of hair reduce the rim's weight, since the outline of hair is not that of skin.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.rim import Rim, Topology, Views, find_rim, make_topology
from pipeline.contour_fit.rim_term import OUTSIDE_SCALE
from pipeline.detail.solve import Observed
from pipeline.head_model.model import HeadModel
from pipeline.photometric_fit.patches import HairProbability
from rig.camera import Camera

# Variance of an outline's mean over a pixel of its length: 1 px, alike over 8 px. With 2 and 32 the median and the 95th
# percentile of scan-a are 0.001 and 0.014 mm worse, with 0.5 and 2 the median of scan-a-skin 0.007.
UNIT_PX3 = 8.0
MIN_ROBUST_MM = 1.0  # robust scale, however small that of the points is
INSIDE_PX = 3.0  # so far inside the rim the pixel is read that says whether it is hair's

Outlines = Callable[[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"], float], Observed]


@dataclass(frozen=True, slots=True, eq=False)
class OutlineSearch:
    """Holds the inputs of the comparison with outlines: the topology of the full mesh, the silhouettes' signed
    distances, the cameras corrected by the fit, and the probability of hair by camera."""

    topology: Topology
    views: Views
    hair: HairProbability

    def observe(self, base: Float[np.ndarray, "v 3"], current: Float[np.ndarray, "v 3"], robust_mm: float) -> Observed:
        """Returns the offsets (mm) of the silhouettes from the vertices ``base`` along the normals at the rim. The rim
        is found on the head ``current``; all positions are in the world frame."""
        rim = find_rim(self.topology, current, self.views, averaged=True)
        px_per_mm = np.linalg.norm(rim.gradient, axis=1)
        normal, off = rim.gradient / px_per_mm[:, None], -rim.residual / px_per_mm
        moved = (current - base)[rim.corner]
        moved = (1.0 - rim.blend)[:, None] * moved[:, 0] + rim.blend[:, None] * moved[:, 1]
        scale = max(robust_mm, MIN_ROBUST_MM) * np.where(off < 0.0, OUTSIDE_SCALE, 1.0)
        robust = (1.0 - self._hair_at(rim)) / (1.0 + (off / scale) ** 2) ** 2
        return Observed(
            rim.corner[:, [0, 1, 1]].astype(np.int64),
            np.stack([1.0 - rim.blend, rim.blend, np.zeros(len(off))], axis=1),
            normal,
            (moved * normal).sum(axis=1) + off,
            robust * rim.length * px_per_mm**2 / UNIT_PX3,
        )

    def _hair_at(self, rim: Rim) -> Float[np.ndarray, " s"]:
        share, pixel = np.zeros(len(rim.view)), rim.pixel - INSIDE_PX * rim.normal
        for k, name in enumerate(self.views.names):
            if name in self.hair:
                here = np.flatnonzero(rim.view == k)
                column, row = np.clip(np.rint(pixel[here]), 0, self.views.size[k] - 1).astype(int).T
                share[here] = self.hair[name][row, column]
        return share


def pack_outlines(model: HeadModel, views: Views, cameras: Sequence[Camera], hair: HairProbability) -> OutlineSearch:
    """Prepares the comparison of a deformed head with the silhouettes' outlines.

    ``model``: the model whose full mesh is deformed. ``views``: the silhouettes. ``cameras``: cameras of the views,
    with the fit's corrections. ``hair``: for each camera, the probability that a pixel shows hair.
    """
    level, poses = model.levels["full"], [camera.camera_from_world for camera in cameras]
    moved = replace(
        views,
        rotation=np.stack([pose.rotation for pose in poses]),
        translation=np.stack([pose.translation for pose in poses]),
    )
    return OutlineSearch(make_topology(level.faces, level.face_region), moved, hair)


def corrected(camera: Camera, fit: Fit) -> Camera:
    """Returns the camera with the fit's correction of its pose."""
    return camera.moved(fit.camera_shift.get(camera.name, np.zeros(6)))
