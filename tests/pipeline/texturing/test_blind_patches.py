"""An eye that is a strip from lid to lid: no vertex of it is seen, and it shows what the photographs show."""

from dataclasses import replace

import cv2
import numpy as np

from pipeline.geometry.raster import depth_maps
from pipeline.head_model.subdivision import boundary_loops, close_loop
from pipeline.settings import TextureSettings
from pipeline.texturing.layout.uv_unwrap import unwrap
from pipeline.texturing.neighbourhood import Neighbourhood, neighbours
from pipeline.texturing.paint import paint_texture
from pipeline.texturing.vertex_colours import fill_unobserved_patches, texture
from rig.colour_space import srgb_from_linear
from rig.mesh import Mesh
from tests.support.photographs import shoot
from tests.support.scenes import ellipsoid, pattern

OPENING_MM = 12.0


def with_strip(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """The ellipsoid, open below, with a flat strip across an opening in its front; and which faces are the strip's."""
    tip = mesh.vertices[mesh.vertices[:, 2].argmax()]
    off = np.linalg.norm(mesh.vertices - tip, axis=1)
    above = mesh.vertices[mesh.faces][:, :, 1].min(axis=1) > 0.8 * mesh.vertices[:, 1].min()
    kept = above & (off[mesh.faces] > OPENING_MM).any(axis=1)
    used, joined = np.unique(mesh.faces[kept], return_inverse=True)
    vertices, faces = mesh.vertices[used], joined.reshape(-1, 3).astype(np.int32)
    (loop,) = (loop for loop in boundary_loops(faces) if vertices[loop, 2].min() > 0.5 * tip[2])
    strip = close_loop(vertices, loop)
    whole = np.concatenate([faces, strip]).astype(np.int32)
    return Mesh(vertices, whole), np.arange(len(faces), len(whole))


def test_a_strip_across_an_opening_takes_one_photograph() -> None:
    shot = shoot()
    mesh, strip = with_strip(ellipsoid(5))
    settings, depths = TextureSettings(), depth_maps(shot.rig, mesh)
    around = Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))
    found = texture(
        mesh, mesh.normals(), shot.capture, shot.silhouettes, shot.rig, depths, settings=settings, around=around
    )
    assert found.decision is not None
    rim = np.unique(mesh.faces[strip])  # hidden by lids, as it were
    weights, slots, shares = (
        array.copy() for array in (found.decision.weights, found.decision.slots, found.decision.shares)
    )
    weights[:, rim], slots[rim], shares[rim] = 0.0, -1, 0.0
    hidden = replace(found.decision, weights=weights, slots=slots, shares=shares)
    skin = found.colours.copy()
    skin[rim] = (150, 110, 90)
    layout = unwrap(mesh.vertices, mesh.faces)
    seen = fill_unobserved_patches(hidden, mesh, shot.silhouettes, depths)
    assert len(np.unique(seen.slots[rim, 0])) == 1  # no seams in it
    others = np.setdiff1d(np.arange(len(mesh.vertices)), rim)
    np.testing.assert_array_equal(seen.slots[others], hidden.slots[others])
    truth = 255 * srgb_from_linear(pattern(mesh.vertices[mesh.faces[strip]].mean(axis=1)))
    off = []
    for decision in (hidden, seen):
        image = np.ascontiguousarray(paint_texture(layout, mesh, skin, decision, 1024).image)
        middle = (1024 * layout.uv[layout.faces[strip]].mean(axis=1) - 0.5).astype(np.float32)
        shown = cv2.remap(image, middle[None, :, 0], middle[None, :, 1], cv2.INTER_LINEAR)[0]
        off.append(np.median(np.abs(shown - truth)))
    assert off[0] > 15
    assert off[1] < 5


def test_what_views_see_by_its_vertices_stays() -> None:
    shot = shoot()
    settings, depths = TextureSettings(), depth_maps(shot.rig, shot.mesh)
    around = Neighbourhood.of(*neighbours(shot.mesh.faces, len(shot.mesh.vertices)))
    coloured = texture(
        shot.mesh,
        shot.mesh.normals(),
        shot.capture,
        shot.silhouettes,
        shot.rig,
        depths,
        settings=settings,
        around=around,
    )
    decision = coloured.decision
    assert decision is not None
    again = fill_unobserved_patches(decision, shot.mesh, shot.silhouettes, depths)
    np.testing.assert_array_equal(again.slots, decision.slots)
