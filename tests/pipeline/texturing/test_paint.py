"""The texture against a pattern that is a formula."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.geometry.projection import depth_maps
from pipeline.settings import TextureSettings
from pipeline.texturing.layout.uv_unwrap import Layout, unwrap
from pipeline.texturing.neighbourhood import Neighbourhood, neighbours
from pipeline.texturing.paint import paint_texture, texture_size
from pipeline.texturing.vertex_colours import Texture, colour_vertices
from rig.colour_space import srgb_from_linear
from rig.mesh import Mesh
from tests.support.changed_rigs import relensed
from tests.support.photographs import Shot, shoot
from tests.support.scenes import ellipsoid, pattern


def without_neck(mesh: Mesh) -> Mesh:
    kept = mesh.vertices[mesh.faces][:, :, 1].min(axis=1) > 0.8 * mesh.vertices[:, 1].min()
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32))


@pytest.fixture(scope="module")
def shot() -> Shot:
    """Photographs of the open ellipsoid, whose triangles of 16 mm hide most of the pattern from vertex colours."""
    return replace(shoot(), mesh=without_neck(ellipsoid(4)))


@pytest.fixture(scope="module")
def layout(shot: Shot) -> Layout:
    return unwrap(shot.mesh.vertices, shot.mesh.faces)


def coloured(shot: Shot) -> Texture:
    mesh = shot.mesh
    around = Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    depths, settings = depth_maps(shot.rig, mesh), TextureSettings()
    return colour_vertices(mesh, shot.capture, shot.silhouettes, shot.rig, depths, settings=settings, around=around)


@pytest.fixture(scope="module")
def found(shot: Shot) -> Texture:
    return coloured(shot)


@pytest.fixture(scope="module")
def image(shot: Shot, layout: Layout, found: Texture) -> np.ndarray:
    assert found.decision is not None
    return paint_texture(layout, shot.mesh, found.colours, found.decision, 1024).image


def test_texels_show_what_photographs_show(shot: Shot, layout: Layout, found: Texture, image: np.ndarray) -> None:
    mesh = shot.mesh
    seen = (found.views[mesh.faces] >= 2).all(axis=1)
    middle = (len(image) * layout.uv[layout.faces[seen]].mean(axis=1) - 0.5).astype(np.float32)
    ours = cv2.remap(np.ascontiguousarray(image), middle[None, :, 0], middle[None, :, 1], cv2.INTER_LINEAR)[0]
    places = mesh.vertices[mesh.faces[seen]].mean(axis=1)
    # The flat triangle lies up to 0.8 mm below the ellipsoid, which the pattern, made of waves of 20 mm, moves little.
    truth = 255 * srgb_from_linear(pattern(places))
    by_vertex = found.colours[mesh.faces[seen]].mean(axis=1)
    assert seen.sum() > 1000
    assert np.median(np.abs(ours - truth)) < 3
    assert ((ours - truth) ** 2).mean() < 0.5 * ((by_vertex - truth) ** 2).mean()


def test_what_no_camera_sees_is_not_black(shot: Shot, layout: Layout, found: Texture, image: np.ndarray) -> None:
    mesh = shot.mesh
    deep = np.flatnonzero((found.views[mesh.faces] == 0).all(axis=1))
    inner = layout.uv[layout.faces[deep]].mean(axis=1)
    at = np.rint(len(image) * inner - 0.5).astype(int)
    wanted = found.colours[mesh.faces[deep]].mean(axis=1)
    assert len(deep) > 100
    assert np.median(np.abs(image[at[:, 1], at[:, 0]] - wanted)) <= 1
    assert image.reshape(-1, 3).max(axis=1).min() > 0


def test_the_size_follows_the_photographs(shot: Shot, layout: Layout) -> None:
    every = np.arange(len(shot.mesh.vertices))
    small = texture_size(layout, shot.mesh, shot.rig, every)
    finer = relensed(shot.rig, lambda k: replace(k, fx=6 * k.fx))
    assert small == 1024
    assert texture_size(layout, shot.mesh, finer, every) == 4096
    assert texture_size(layout, shot.mesh, finer, every, wanted=2048) == 2048


def test_one_dim_view_of_a_part_tints_nothing(shot: Shot, layout: Layout, image: np.ndarray) -> None:
    # A grey-blue shadow over half of what one camera sees, as an arm throws it: no gain can mend that.
    name = "cam03"
    dark = shot.capture.images[name].astype(float)
    dark[:, : dark.shape[1] // 2] *= (0.55, 0.6, 0.75)
    images = {**shot.capture.images, name: np.rint(dark).astype(np.uint8)}
    shadowed = coloured(replace(shot, capture=replace(shot.capture, images=images)))
    assert shadowed.decision is not None
    tinted = paint_texture(layout, shot.mesh, shadowed.colours, shadowed.decision, 1024).image
    # Over 20 texels nothing is left of noise: the shadow itself took a third of every code.
    even = [cv2.GaussianBlur(np.ascontiguousarray(each).astype(np.float32), (0, 0), 20) for each in (image, tinted)]
    off = np.abs(even[0] - even[1]).max(axis=2)
    assert np.percentile(off, 99) < 6
    assert np.percentile(np.abs(shadowed.colours.astype(int) - coloured(shot).colours), 99) < 8
