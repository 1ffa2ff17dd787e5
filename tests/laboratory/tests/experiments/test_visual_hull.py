import numpy as np

from pipeline.geometry.projection import depth_map
from pipeline.imaging.silhouette import silhouette_from_mask
from rig.mesh import boundary_edges
from tests.laboratory.experiments.visual_hull import visual_hull
from tests.support.photographs import trace
from tests.support.scenes import SEMI_AXES, ellipsoid, fan


def test_the_hull_holds_the_body_and_casts_its_silhouettes() -> None:
    rig = fan(640, 480, (-150, -110, -75, -40, 0, 40, 75, 110, 150))
    silhouettes = {camera.name: silhouette_from_mask(trace(camera, 0.0)[1]) for camera in rig}
    hull = visual_hull(silhouettes, rig)
    assert len(boundary_edges(hull.faces)) == 0
    # Nothing of the ellipsoid lies outside the hull: in every direction the hull reaches at least as far, less half a
    # pixel of the masks (0.5 mm) and what a net of 3 mm cuts off a sharp edge.
    directions = ellipsoid(2).vertices / np.linalg.norm(ellipsoid(2).vertices, axis=1, keepdims=True)
    reach = (hull.vertices @ directions.T).max(axis=0)
    support = np.linalg.norm(directions * SEMI_AXES, axis=1)
    assert (reach > support - 1.5).all()
    assert np.median(reach - support) < 6.0
    for camera in rig:
        drawn = np.isfinite(depth_map(camera, hull.vertices, hull.faces)[0])
        mask = silhouettes[camera.name].mask
        assert np.count_nonzero(drawn & mask) / np.count_nonzero(drawn | mask) > 0.985
