"""Colours a texture image as the paper does (section 4.5), for comparison with the default method."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32, UInt8

from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.imaging.silhouette import Silhouette
from pipeline.texturing.layout.uv_unwrap import Layout
from pipeline.texturing.vertex_colours import blend_as_paper
from rig.capture import Capture
from rig.mesh import Mesh
from rig.rig import Rig


def paper_texture(
    layout: Layout,
    mesh_world: Mesh,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    depths: Mapping[str, Float32[np.ndarray, "_ _"]],
    *,
    filled: UInt8[np.ndarray, "s s 3"],
) -> UInt8[np.ndarray, "s s 3"]:
    """Returns an image in which every texel is the weighted mean of all photographs that see it (the paper, section
    4.5). Texels that no photograph sees are taken from ``filled``, whose size the image has."""
    texels, ones = len(filled) * layout.uv - 0.5, np.ones(len(layout.uv))
    _, shown = rasterise(texels, ones, layout.faces, len(filled), len(filled))
    values = np.concatenate([mesh_world.vertices, mesh_world.normals()], axis=1)[layout.source].astype(np.float32)
    surface = interpolate(shown, texels, ones, layout.faces, values)[shown >= 0].astype(float)
    normals = surface[:, 3:] / np.linalg.norm(surface[:, 3:], axis=1, keepdims=True)
    points = Mesh(surface[:, :3], np.zeros((0, 3), np.int32))
    blend, out = blend_as_paper(points, normals, capture, silhouettes, rig, depths), np.array(filled)
    out[shown >= 0] = np.where(blend.views[:, None] > 0, blend.colours, out[shown >= 0])
    return out
