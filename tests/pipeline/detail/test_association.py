"""Points and their places on a surface, against the plain search over all triangles."""

import numpy as np

from pipeline.detail.association import Target
from rig.mesh import vertex_normals
from tests.support.closest_points import closest_on_triangles_naive
from tests.support.subdivided_spheres import subdivided_sphere


def test_the_place_is_the_closest_of_all_triangles() -> None:
    vertices, _, nodes = subdivided_sphere()
    vertices, faces = nodes.coarse.shape @ vertices, nodes.coarse.faces
    rng = np.random.default_rng(1)
    normals = rng.standard_normal((60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * rng.uniform(74.0, 86.0, (60, 1))
    target = Target.of(vertices, vertex_normals(vertices, faces), faces)
    found = target.closest(points, normals, reach_mm=20.0, least_agreement=0.5)
    assert (found.row == np.arange(60)).all()
    for i in range(60):
        foot, _ = closest_on_triangles_naive(np.repeat(points[i : i + 1], len(faces), 0), vertices[faces])
        best = np.linalg.norm(foot - points[i], axis=1).min()
        assert abs(found.distance_mm[i] - best) < 1e-9
    blended = np.einsum("nk,nkc->nc", found.blend, vertices[faces[found.triangle]])
    np.testing.assert_allclose(np.linalg.norm(blended - points, axis=1), found.distance_mm, atol=1e-9)


def test_points_that_look_the_other_way_or_lie_too_far_have_no_place() -> None:
    vertices, faces, _ = subdivided_sphere()
    points = vertices[[0, 100, 200]] * [[1.02], [1.02], [1.5]]
    normals = points / np.linalg.norm(points, axis=1, keepdims=True) * [[1.0], [-1.0], [1.0]]
    target = Target.of(vertices, vertex_normals(vertices, faces), faces)
    found = target.closest(points, normals, reach_mm=5.0, least_agreement=0.5)
    assert found.row.tolist() == [0]
