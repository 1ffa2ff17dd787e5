"""Makes the maps of a head's skin: displacement and normals in the texture's layout.

Displacement is along the normals of head.ply, interpolated; a code is ``MM_PER_CODE``, and ``MID_CODE`` is no
displacement. Normals are in the frame of glTF: x along the tangent (where u grows), y up in the image, z along the
normal.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, UInt8, UInt16

from pipeline.compute.threads import in_threads
from pipeline.compute.trace import traced
from pipeline.geometry.projection import project_points
from pipeline.texturing.chart_colours import CODES, ENCODED, LINEAR
from pipeline.texturing.decision import Decision
from pipeline.texturing.layout.uv_unwrap import Atlas, ModelLayout
from pipeline.texturing.light import fit_light, transfer
from pipeline.texturing.pores.close_views import CloseViews, halves_of
from pipeline.texturing.pores.relief import MIN_SKIN, Strips, estimate_detail
from pipeline.texturing.pores.texel_frames import TexelFrames, texel_frames
from pipeline.texturing.vertex_colours import Texture
from rig.colour_space import linear_from_srgb
from rig.geometry import Similarity
from rig.mesh import Mesh

MM_PER_CODE = 1.0 / 65536  # from -0.5 to 0.5 mm: deeper than any pore
MID_CODE = 32768
STRIP_ROWS = 128


@dataclass(frozen=True, slots=True, eq=False)
class SkinMaps:
    """Holds the maps of a head's skin.

    Attributes:
        displacement: codes (``MM_PER_CODE``, ``MID_CODE``), along the normals.
        normals: codes of the unit normals in the tangent frame.
        repeated: share of the shading's power that two disjoint sets of views both show, by octave of wavelength from
            the longest.
        views: cameras whose full-size pictures were read.
    """

    displacement: UInt16[np.ndarray, "s s"]
    normals: UInt8[np.ndarray, "s s 3"]
    repeated: tuple[float, ...]
    views: tuple[str, ...]


@traced
def skin_maps(
    layout: ModelLayout,
    atlas: Atlas,
    mesh_world: Mesh,
    normals: Float[np.ndarray, "v 3"],
    coloured: Texture,
    close: CloseViews,
    *,
    face: Bool[np.ndarray, " v"],
    skin: Float[np.ndarray, " v"],
    world_from_head: Similarity,
) -> tuple[SkinMaps, Atlas]:
    """Estimates the skin's relief from the full-size pictures. Returns the maps, and the texture with their detail.

    ``layout``: of the head. ``atlas``: its texture, which sets the size of the maps. ``mesh_world``: the head, mm.
    ``normals``: unit, of its vertices. ``coloured``: its colours. ``close``: the full-size pictures. ``face``: vertices
    from whose shading the light is estimated. ``skin``: probability that a vertex shows skin. ``world_from_head``:
    pose, which says how the views stand around the head.
    """
    white = transfer(mesh_world, normals, layout.around)
    light = fit_light(white, linear_from_srgb(coloured.colours / 255.0), (coloured.views > 0) & face)
    grey = np.zeros(9) if light is None else light.coefficients.mean(axis=1)
    frames = texel_frames(layout.layout, mesh_world, normals, grey, white @ grey, skin)
    size = len(atlas.image)
    found = estimate_detail(Strips.of(layout.layout, size, skin >= MIN_SKIN), halves_of(close, world_from_head), frames)
    displacement: UInt16[np.ndarray, "s s"] = np.empty((size, size), np.uint16)
    drawn: UInt8[np.ndarray, "s s 3"] = np.empty((size, size, 3), np.uint8)

    def work(first: int, last: int) -> None:
        for strip in range(first, last):
            row = strip * STRIP_ROWS
            rows = slice(row, min(row + STRIP_ROWS, size))
            displacement[rows] = codes_of(found.heights_mm[rows])
            drawn[rows] = normal_codes(found.heights_mm, rows, frames)

    in_threads(-(-size // STRIP_ROWS), work)
    maps = SkinMaps(displacement, drawn, found.repeated, close.views.names)
    return maps, sharpened_atlas(atlas, found.brightness)


def codes_of(heights_mm: Float32[np.ndarray, "r s"]) -> UInt16[np.ndarray, "r s"]:
    """Returns heights as codes of the displacement map."""
    return np.clip(np.rint(heights_mm / np.float32(MM_PER_CODE)) + MID_CODE, 0, 65535).astype(np.uint16)


def normal_codes(
    heights_mm: Float32[np.ndarray, "s s"], rows: slice, frames: TexelFrames
) -> UInt8[np.ndarray, "r s 3"]:
    """Returns some rows of the normal map of a relief."""
    size = heights_mm.shape[1]
    low, high = max(rows.start - 1, 0), min(rows.stop + 1, size)
    by_row = np.gradient(heights_mm[low:high], axis=0) if high - low > 1 else np.zeros_like(heights_mm[low:high])
    down = by_row[rows.start - low : rows.stop - low] * size
    across = np.gradient(heights_mm[rows], axis=1) * size
    x, y = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(rows.start, rows.stop) + 0.5) / size)
    metric = frames.at(frames.metric, x, y)
    along = np.sqrt(np.maximum(metric[:, :, 0], 1e-9))  # mm for u from 0 to 1
    lean = metric[:, :, 1] / along
    beside = np.sqrt(np.maximum(metric[:, :, 2] - lean**2, 1e-9))
    tangent = across / along
    bitangent = (lean * tangent - down) / beside  # up in the image: against v
    normal = np.stack([-tangent, -bitangent, np.ones_like(tangent)], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    return np.rint(127.5 + 127.5 * normal).astype(np.uint8)


def skin_share(
    decision: Decision, mesh_world: Mesh, probability: Mapping[str, Float32[np.ndarray, "_ _"]]
) -> Float[np.ndarray, " v"]:
    """Returns the probability that each vertex shows skin: the mean over the views that see it."""
    total, weights = np.zeros(len(mesh_world.vertices)), np.zeros(len(mesh_world.vertices))
    for camera, weight in zip(decision.views, decision.weights, strict=True):
        if camera.name not in probability:
            continue
        skin, seen = probability[camera.name], np.flatnonzero(weight > 0)
        height, width = skin.shape
        pixels = project_points(camera, mesh_world.vertices[seen])
        column, row = np.clip(np.rint(pixels), 0, (width - 1, height - 1)).astype(int).T
        total[seen] += weight[seen] * skin[row, column]
        weights[seen] += weight[seen]
    return total / np.maximum(weights, 1e-12)


def sharpened_atlas(atlas: Atlas, brightness: Float16[np.ndarray, "s s"]) -> Atlas:
    """Returns a texture with its light multiplied by the exponential of ``brightness``."""
    size = len(atlas.image)
    stored: UInt8[np.ndarray, "s s 3"] = np.empty((size, size, 3), np.uint8)  # blue first, as the painter's

    def work(first: int, last: int) -> None:
        for strip in range(first, last):
            rows = slice(strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, size))
            light = LINEAR[atlas.image[rows, :, ::-1]] * np.exp(brightness[rows].astype(np.float32))[:, :, None]
            stored[rows] = ENCODED[(CODES * np.minimum(light, 1.0) + 0.5).astype(np.int32)]

    in_threads(-(-size // STRIP_ROWS), work)
    return Atlas(atlas.layout, stored[:, :, ::-1])
