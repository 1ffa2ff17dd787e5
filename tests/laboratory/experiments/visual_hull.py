"""Computes the visual hull (figure 1 of the paper): the largest body that casts the silhouettes, to compare with.

The value of a node is its largest signed distance over the views, in mm at its depth; the hull is the surface net of
the zero, so that sub-pixel contours count as they are. A hull, even from 50 views, has no eye sockets and no philtrum;
the paper shows it for that reason.
"""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from pipeline.geometry.projection import project_points
from pipeline.geometry.surface_nets import link_nodes, surface_net
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.visual_hull import hull_extent, usable_cameras
from rig.mesh import Mesh
from rig.rig import Rig

SPACING_MM = 3.0
MAX_NODES = 192  # along a side
MIN_SHARE = 0.5  # of the views must see a point of the hull; where fewer look, anything could be
OUTSIDE_MM = np.float32(1e3)


def visual_hull(silhouettes: Mapping[str, Silhouette], rig: Rig) -> Mesh:
    """Computes the visual hull of the usable silhouettes as a closed mesh (world, mm). It has no faces if they have no
    body in common."""
    centre, edge = hull_extent(silhouettes, rig)
    count = round(min(edge / SPACING_MM, MAX_NODES))
    index = np.argwhere(np.ones((count,) * 3, bool)).astype(np.int32)
    corner, step = centre - edge / 2, edge / (count - 1)
    field, votes = np.full(len(index), -np.inf, np.float32), np.zeros(len(index), int)
    cameras = usable_cameras(silhouettes, rig)
    for camera in cameras:
        nodes = index * step + corner
        columns, rows = project_points(camera, nodes).T
        distance = silhouettes[camera.name].distance
        shown = (columns >= 0) & (rows >= 0) & (columns < distance.shape[1] - 1) & (rows < distance.shape[0] - 1)
        pixels = map_coordinates(distance, (rows[shown], columns[shown]), order=1)
        depths = camera.camera_from_world.apply(nodes[shown])[:, 2]
        field[shown] = np.maximum(field[shown], pixels * depths / camera.intrinsics.fx)
        votes += shown
    field[votes < max(2.0, MIN_SHARE * len(cameras))] = OUTSIDE_MM
    volume = field.reshape((count,) * 3)
    for axis in range(3):  # a closed mesh, also where the images cut the subject off
        np.moveaxis(volume, axis, 0)[[0, -1]] = OUTSIDE_MM
    near = maximum_filter(volume < 0, 3) != minimum_filter(volume < 0, 3)  # nodes of all cells that the surface crosses
    index = np.argwhere(near).astype(np.int32)
    net = surface_net(volume[near], index, link_nodes(index, (count, count, count)))
    return Mesh(net.vertices * step + corner, net.faces)
