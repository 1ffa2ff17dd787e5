import numpy as np
import pytest

from pipeline.geometry.projection_kernels import rasterise
from pipeline.texturing.layout.uv_unwrap import Layout, lay_out_charts
from rig.mesh import Mesh, face_normals
from tests.support.scenes import ellipsoid

SIZE = 1024


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    head = ellipsoid(5)
    x, y, z = head.vertices.T  # a leaf stands off its side
    out = np.exp(-((y / 20.0) ** 2) - ((z / 12.0) ** 2)) * (x > 0)
    return Mesh(head.vertices + np.stack([30.0 * out, np.zeros(len(x)), -25.0 * out], axis=1), head.faces)


@pytest.fixture(scope="module")
def layout(mesh: Mesh) -> Layout:
    return lay_out_charts(mesh, mesh.normals())


def test_no_texel_belongs_to_two_triangles(layout: Layout) -> None:
    corners = SIZE * layout.uv[layout.faces]
    inner = (0.99 * corners + 0.01 * corners.mean(axis=1, keepdims=True)).reshape(-1, 2)
    rank, faces = np.arange(len(inner)), np.arange(len(inner)).reshape(-1, 3)
    first, last = (rasterise(inner, 1000.0 + d, faces, SIZE, SIZE)[1] for d in (1.0 * rank, 1.0 * rank[::-1]))
    assert np.count_nonzero(first != last) < 1e-4 * np.count_nonzero(first >= 0)  # narrower than ``PIXEL_MM``
    assert ((layout.uv > 0.0) & (layout.uv < 1.0)).all()


def test_triangles_are_drawn_unmirrored_and_hardly_stretched(mesh: Mesh, layout: Layout) -> None:
    np.testing.assert_array_equal(layout.source[layout.faces], mesh.faces)
    a, b, c = (layout.uv[layout.faces[:, k]] for k in range(3))
    drawn = -np.linalg.det(np.stack([b - a, c - a], axis=1))  # v downwards
    true = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    assert (drawn > 0.0).all()
    assert np.quantile(true / drawn, 0.98) < 1.8**2 * (true / drawn).min()
