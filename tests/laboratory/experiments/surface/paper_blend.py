"""Colours a texture image as the paper does (section 4.5), for comparison with the default method."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32, UInt8

from pipeline.geometry.raster_kernels import interpolate, rasterise
from pipeline.imaging.silhouette import Silhouette
from pipeline.texturing.layout.uv_unwrap import Layout
from pipeline.texturing.vertex_colours import reference_colours
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
    colours, weights, _ = reference_colours(surface[:, :3], normals, capture, silhouettes, rig, depths)
    out = np.array(filled)
    out[shown >= 0] = np.where(weights[:, None] > 0, np.rint(colours), out[shown >= 0])
    return out
