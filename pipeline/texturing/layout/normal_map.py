"""Computes the normal map of a mesh with fewer triangles: an image that stores the normals of the full mesh.

The normal map follows glTF: x along the tangent, +Y up in the image, z along the normal. Tangents follow MikkTSpace
(Mikkelsen, *Simulation of Wrinkled Surfaces Revisited*, 2008), as glTF prescribes. The tangent of a vertex is the
direction in its tangent plane in which u grows, averaged over the triangles at the vertex with their angles as weights.
https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#meshes-overview

The normal map and the texture have the same UV layout, so shape and colour agree at every texel.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from pipeline.compute.array_cache import cached_arrays
from pipeline.compute.threads import map_strips
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.head_model.decimation import decimate
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import boundary_vertices
from pipeline.texturing.layout.uv_unwrap import Layout, spread_texels, unwrap
from rig.mesh import Mesh

Faces = Int[np.ndarray, "f 3"]
Vertices = Float[np.ndarray, "v 3"]
Pixels = Float[np.ndarray, "n 2"]

Points = Float[np.ndarray, "n 3"]
Picture = Float32[np.ndarray, "h w 3"]

FACES = 10_000  # what games give a head; 1,100 of a model of 22,000 left lids too few
FACE_WEIGHT = 8.0  # of an error in the face region


@dataclass(frozen=True, slots=True, eq=False)
class ReducedLayout:
    """Holds a UV layout reduced to fewer triangles. ``rows`` are the kept vertices as indices in the full layout,
    ``faces`` the triangles as indices into ``rows``."""

    rows: Int[np.ndarray, " n"]
    faces: Faces


def reduce_layout(model: HeadModel, layout: Layout) -> ReducedLayout:
    """Computes the reduced UV layout of a head model's full mesh from its mean head, and caches the result."""
    mean, region = model.vertices(np.zeros(0)), model.levels["full"].face_region

    def make() -> dict[str, np.ndarray]:
        found = reduce(layout, mean, np.where(region, FACE_WEIGHT, 1.0))
        return {"rows": found.rows.astype(np.int32), "faces": found.faces.astype(np.int32)}

    inputs = (model.mean, layout.faces, region, FACES)
    kept = cached_arrays("reduced-layout", inputs, make, made_by=(reduce, decimate, boundary_vertices, unwrap))
    return ReducedLayout(kept["rows"], kept["faces"])


def reduce(
    layout: Layout, vertices: Vertices, importance: Float[np.ndarray, " v"], count: int = FACES
) -> ReducedLayout:
    """Reduces the UV layout of a mesh to ``count`` triangles or a few more, and keeps its border unchanged.
    ``importance`` is a weight for each vertex; the mesh stays denser where the weight is high."""
    source = layout.source
    ((rows, faces),) = decimate(
        vertices[source],
        layout.faces,
        (min(count, len(layout.faces)),),
        importance=importance[source],
        fixed=boundary_vertices(layout.faces, len(source)),
        chart=layout.uv,
    )
    return ReducedLayout(rows, faces)


BAND_ROWS = 64
SIZE_PX = 1024  # 4.5 texels from a vertex of the full level to the next; the bumpy ball of the tests needs no more


@dataclass(frozen=True, slots=True, eq=False)
class NormalMapped:
    """Holds a reduced mesh (mm) with texture coordinates, normals, tangents and its normal map. ``rows`` are the
    indices of the kept vertices in the full mesh."""

    mesh: Mesh
    rows: Int[np.ndarray, " n"]
    uv: Pixels
    normals: Points
    tangents: Float[np.ndarray, "n 4"]  # the last is the bitangent's sign, as in glTF
    image: UInt8[np.ndarray, "s s 3"]


def map_normals(
    vertices: Vertices, normals: Vertices, layout: Layout, reduced: ReducedLayout, size: int = SIZE_PX
) -> NormalMapped:
    """Reduces a head's mesh (mm, unit normals) to fewer triangles; computes a normal map of the lost detail."""
    rows = layout.source[reduced.rows]
    places, reduced_normals, uv = vertices[rows], normals[rows], layout.uv[reduced.rows]
    tangents = vertex_tangents(places, reduced_normals, uv, reduced.faces)
    sign = np.float32(tangents[0, 3])
    fine = _image(layout.uv, layout.faces, normals[layout.source], size)
    coarse = _image(uv, reduced.faces, np.concatenate([reduced_normals, tangents[:, :3]], axis=1), size)
    turned = np.empty_like(fine)

    def work(band: slice) -> None:
        turned[band] = _in_frame(_unit(fine[band]), _unit(coarse[band, :, 3:]), _unit(coarse[band, :, :3]), sign)

    map_strips(work, size, BAND_ROWS)
    inside = np.asarray(np.isfinite(turned[:, :, 0]))
    codes = np.where(inside[:, :, None], np.rint(127.5 + 127.5 * turned), 0.0).astype(np.float32)
    image = np.clip(spread_texels(codes, inside), 0, 255).astype(np.uint8)
    return NormalMapped(Mesh(places, reduced.faces), rows, uv, reduced_normals, tangents, image)


def vertex_tangents(vertices: Points, normals: Points, uv: Pixels, faces: Faces) -> Float[np.ndarray, "n 4"]:
    """Computes MikkTSpace tangents (v, 4) at the vertices; the fourth number is the sign of the bitangent. All
    triangles must have the same orientation in UV space, where v points downwards."""
    corners, flat = vertices[faces], uv[faces]
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (s, t), (p, q) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    area = s * q - t * p
    along = (edge * q[:, None] - other * t[:, None]) * np.sign(area)[:, None]
    total = np.zeros_like(vertices)
    for k in range(3):
        at, normal = corners[:, k], normals[faces[:, k]]
        first, second = (_laid(corners[:, (k + i) % 3] - at, normal) for i in (1, 2))
        angle = np.arccos(np.clip(np.einsum("fx,fx->f", first, second), -1.0, 1.0))
        np.add.at(total, faces[:, k], angle[:, None] * _laid(along, normal))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.where(length > 1e-9, total, np.cross(normals, (0.0, 1.0, 0.0)))  # no face has an area there
    # Bitangents point up in the image, against v: cross(n, t) does where the layout shows the surface from outside.
    sign = -1.0 if np.median(area) > 0 else 1.0
    return np.concatenate([_laid(total, normals), np.full((len(vertices), 1), sign)], axis=1)


def _laid(directions: Points, normals: Points) -> Points:
    """Projects directions into the tangent planes of the normals and scales them to unit length."""
    return _unit(directions - np.einsum("nx,nx->n", directions, normals)[:, None] * normals)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _image(uv: Pixels, faces: Faces, values: Float[np.ndarray, "n k"], size: int) -> Float32[np.ndarray, "s s k"]:
    """Returns an image with the vertices' values interpolated over the triangles' UV coordinates, and NaN elsewhere."""
    texels, ones = size * uv - 0.5, np.ones(len(uv))
    _, shown = rasterise(texels, ones, faces, size, size)
    return interpolate(shown, texels, ones, faces, values.astype(np.float32))


def _in_frame(wanted: Picture, tangent: Picture, normal: Picture, sign: np.float32) -> Picture:
    """Returns unit vectors in the basis of tangent, bitangent and normal, which interpolation has made slightly
    oblique."""
    lean = np.einsum("yxc,yxc->yx", tangent, normal)
    bitangent = _unit(sign * np.cross(normal, tangent))
    x, z = (np.einsum("yxc,yxc->yx", wanted, axis) for axis in (tangent, normal))
    y = np.einsum("yxc,yxc->yx", wanted, bitangent)
    return _unit(np.stack([(x - lean * z) / (1 - lean**2), y, (z - lean * x) / (1 - lean**2)], axis=2))
