"""The layout against the theorem it rests on, and the image against a pattern that is a formula."""

import io
import json
import struct
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from pipeline.eigenheads.model import load_model
from pipeline.imaging.cpu_raster import depth_maps
from pipeline.settings import TextureSettings
from pipeline.texture.atlas import paint_atlas
from pipeline.texture.uv_unwrap import Layout, NoLayout, unwrap
from pipeline.texture.vertex_colours import texture
from rig.colour_space import srgb_from_linear
from rig.formats.glb import textured_glb_bytes
from rig.mesh import Mesh
from tests.support.photographs import Shot, shoot
from tests.support.scenes import ellipsoid, pattern


def without_neck(mesh: Mesh) -> Mesh:
    """The ellipsoid, open below."""
    kept = mesh.vertices[mesh.faces][:, :, 1].min(axis=1) > 0.8 * mesh.vertices[:, 1].min()
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32))


def areas(layout: Layout) -> np.ndarray:
    a, b, c = (layout.uv[layout.faces[:, k]] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@pytest.fixture(scope="module")
def head() -> tuple[Mesh, np.ndarray, Layout]:
    model = load_model()
    full = model.levels["full"]
    mesh = Mesh(model.vertices(np.zeros(0)), full.faces)
    return mesh, full.face_region, unwrap(mesh.vertices, mesh.faces)


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


@pytest.fixture(scope="module")
def shot() -> Shot:
    """Photographs of the open ellipsoid, whose triangles of 16 mm hide most of the pattern from vertex colours."""
    return replace(shoot(), mesh=without_neck(ellipsoid(4)))


def test_texels_show_what_the_photographs_show_between_the_vertices(shot: Shot) -> None:
    mesh, settings = shot.mesh, TextureSettings()
    layout = unwrap(mesh.vertices, mesh.faces)
    given = (shot.capture, shot.silhouettes, shot.rig, depth_maps(shot.rig, mesh), settings)
    coloured = texture(mesh, mesh.normals(), *given)
    image = paint_atlas(layout, mesh, mesh.normals(), coloured, *given).image
    seen = (coloured.views[mesh.faces] >= 2).all(axis=1)
    middle = (len(image) * layout.uv[layout.faces[seen]].mean(axis=1) - 0.5).astype(np.float32)
    ours = cv2.remap(image, middle[None, :, 0], middle[None, :, 1], cv2.INTER_LINEAR)[0].astype(float)
    places = mesh.vertices[mesh.faces[seen]].mean(axis=1)
    # The flat triangle lies up to 0.8 mm below the ellipsoid, which the pattern, made of waves of 20 mm, moves little.
    truth = 255 * srgb_from_linear(pattern(places))
    by_vertex = coloured.colours[mesh.faces[seen]].mean(axis=1)
    assert seen.sum() > 1000
    assert np.median(np.abs(ours - truth)) < 3
    assert ((ours - truth) ** 2).mean() < 0.5 * ((by_vertex - truth) ** 2).mean()


def test_what_no_camera_sees_takes_the_vertices_colours_and_nothing_is_left_black(shot: Shot) -> None:
    mesh, settings = shot.mesh, TextureSettings()
    layout = unwrap(mesh.vertices, mesh.faces)
    given = (shot.capture, shot.silhouettes, shot.rig, depth_maps(shot.rig, mesh), settings)
    coloured = texture(mesh, mesh.normals(), *given)
    image = paint_atlas(layout, mesh, mesh.normals(), coloured, *given).image
    hidden = np.flatnonzero((coloured.views[layout.source] == 0) & (np.arange(len(layout.source)) < len(mesh.vertices)))
    at = np.rint(len(image) * layout.uv[hidden] - 0.5).astype(int)
    deep = (coloured.views[mesh.faces] == 0).all(axis=1)
    inner = np.isin(hidden, mesh.faces[deep])
    difference = np.abs(image[at[:, 1], at[:, 0]].astype(int) - coloured.colours[hidden])[inner]
    assert inner.sum() > 100
    assert np.median(difference) <= 1
    assert image.reshape(-1, 3).max(axis=1).min() > 0


def test_the_textured_glb_is_read_by_another_program() -> None:
    mesh = without_neck(ellipsoid(3))
    layout = unwrap(mesh.vertices, mesh.faces)
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32] = (200, 40, 10)  # the upper half, v < 0.5
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "JPEG", quality=95)
    opened = Mesh(mesh.vertices[layout.source], layout.faces)
    found = textured_glb_bytes(opened, normals=mesh.normals()[layout.source], uv=layout.uv, jpeg=data.getvalue())
    loaded = trimesh.load(io.BytesIO(found), file_type="glb", force="mesh", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    visual: Any = loaded.visual
    np.testing.assert_allclose(loaded.vertices * 1000, opened.vertices, atol=1e-4)
    np.testing.assert_array_equal(loaded.faces, layout.faces)
    # trimesh turns v upwards, as OBJ has it.
    np.testing.assert_allclose(visual.uv, layout.uv * (1, -1) + (0, 1), atol=1e-6)
    assert visual.material.baseColorTexture.size == (64, 64)
    size = struct.unpack_from("<I", found, 12)[0]
    document = json.loads(found[20 : 20 + size])
    assert document["images"] == [{"bufferView": 4, "mimeType": "image/jpeg"}]
    assert "COLOR_0" not in document["meshes"][0]["primitives"][0]["attributes"]
