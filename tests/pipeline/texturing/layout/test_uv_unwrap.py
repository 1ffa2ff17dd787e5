"""The layout against the theorem that it rests on, and as every later process finds it."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.projection_kernels import rasterise
from pipeline.head_model.model import load_model
from pipeline.texturing.layout import uv_unwrap as kept
from pipeline.texturing.layout.uv_unwrap import Layout, NoLayout, lay_out_charts, model_layout, unwrap
from rig.mesh import Mesh, face_normals
from tests.support.scenes import ellipsoid


def areas(layout: Layout) -> np.ndarray:
    a, b, c = (layout.uv[layout.faces[:, k]] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@pytest.fixture(scope="module")
def head() -> tuple[Mesh, np.ndarray, Layout]:
    model = load_model()
    full = model.levels["full"]
    mesh = Mesh(model.vertices(np.zeros(0)), full.faces)
    return mesh, full.face_region, model_layout(model).layout


def test_no_two_triangles_of_the_layout_lie_over_each_other(head: tuple[Mesh, np.ndarray, Layout]) -> None:
    mesh, _, layout = head
    np.testing.assert_array_equal(layout.source[layout.faces], mesh.faces)
    found = areas(layout)
    assert (found < 0).all()  # v points downwards: the surface is seen from outside, and no triangle is flipped
    # Triangles of one orientation whose areas add up to that of their common outline cannot overlap.
    edges = np.concatenate([layout.faces[:, [0, 1]], layout.faces[:, [1, 2]], layout.faces[:, [2, 0]]])
    known = {(a, b) for a, b in edges.tolist()}
    border = np.array([(a, b) for a, b in known if (b, a) not in known])
    (x0, y0), (x1, y1) = layout.uv[border[:, 0]].T, layout.uv[border[:, 1]].T
    assert found.sum() == pytest.approx(0.5 * (x0 * y1 - x1 * y0).sum(), rel=1e-9)
    assert layout.uv.min() > 0
    assert layout.uv.max() < 1


def test_the_face_is_upright_in_the_middle_and_evenly_resolved(head: tuple[Mesh, np.ndarray, Layout]) -> None:
    mesh, face, layout = head
    landmarks = load_model().landmarks
    at = {name: layout.uv[row] for name, row in landmarks.items()}  # none of them is on the cut
    assert at["nasion"][1] < at["pronasale"][1] < at["gnathion"][1]
    assert at["exocanthion_right"][0] < at["pronasale"][0] < at["exocanthion_left"][0]
    assert abs(at["pronasale"][0] - 0.5) < 0.05
    corners = mesh.vertices[mesh.faces]
    surface = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    mm_per_texel = np.sqrt(surface / np.abs(areas(layout))) / 1024
    inside = face[mesh.faces].all(axis=1)
    assert mm_per_texel[inside].max() < 0.5  # a pixel of the default rig is 0.55 mm on the head
    assert np.ptp(np.quantile(mm_per_texel, (0.01, 0.99))) < 0.5 * np.median(mm_per_texel)


def test_a_surface_without_one_open_border_has_no_layout() -> None:
    closed = ellipsoid(3)
    with pytest.raises(NoLayout):
        unwrap(closed.vertices, closed.faces)


def test_the_layout_is_made_once_for_a_model(
    head: tuple[Mesh, np.ndarray, Layout], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = model_layout(load_model())

    def never(*_: object) -> Layout:
        raise AssertionError("it was made again")

    monkeypatch.setattr(kept, "unwrap", never)
    never.__module__ = unwrap.__module__  # the file's name says which module made it
    again = model_layout(load_model())
    np.testing.assert_array_equal(again.layout.uv, made.layout.uv)
    around = again.around
    np.testing.assert_array_equal(around.rows[around.opposite], around.indices)
    np.testing.assert_array_equal(around.indices[around.opposite], around.rows)
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path))
    with pytest.raises(AssertionError, match="made again"):
        model_layout(load_model())


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
