"""Estimates the albedo of a head: its texture without the shading and highlights of the photographs.

The module takes the head, its texture and the linear colours of all views. The module returns the light
(``pipeline.texturing.light``) and an image of the skin's reflectance with the texture's UV layout. Highlights move with
the camera, so the darker views of a vertex show its matt colour. The albedo is the texture, in linear light, multiplied
by a smooth factor: matt colour over photographed colour, divided by the shading.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.compute.threads import map_strips
from pipeline.texturing.chart_colours import ChartColours, levelled_by_chart
from pipeline.texturing.layout.uv_unwrap import Atlas, draw_over_layout
from pipeline.texturing.light import Light, fit_light, transfer
from pipeline.texturing.neighbourhood import Neighbourhood, fill_unknown
from pipeline.texturing.vertex_colours import Texture
from pipeline.texturing.visibility import LINEAR
from pipeline.warnings import ReportWarning
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.mesh import Mesh
from rig.messages.message import compose

DIM_SHARE = 0.3  # of a vertex' weight in dimmer views: of four views the second dimmest, which noise hardly makes
MAX_SHINE = 0.5  # of a texture's light that may be taken for a highlight
CALM = 6  # rounds of means with the neighbours: a highlight is wide, a dim view's noise is not
MIN_SHADING = 0.35  # by the face's: what is darker (nostrils, below the jaw) would be noise, and errors, made bright
FACTORS_PX = 1024  # side of the image of factors, smooth as the normals are
BAND_ROWS = 64
CODES = 65535


@dataclass(frozen=True, slots=True, eq=False)
class Albedo:
    """Holds the albedo image (sRGB, with the texture's UV layout) and the light that was removed from the texture."""

    atlas: Atlas
    light: Light


def estimate_albedo(
    mesh_world: Mesh,
    normals: Float[np.ndarray, "v 3"],
    coloured: Texture,
    atlas: Atlas | None,
    face_region: Bool[np.ndarray, " v"],
    around: Neighbourhood | None,
    *,
    chart: ChartColours | None = None,
) -> tuple[Albedo | None, list[ReportWarning]]:
    """Estimates the albedo of a textured head. Returns None and a warning if light and skin cannot be separated.

    With a colour chart the albedo has the skin's true brightness and colour. Without a chart the mean light is assumed
    to be 1 in each channel.
    """
    if atlas is None or around is None or coloured.dim is None:
        return None, [compose("no-albedo", reason=compose("albedo-without-texture"))]
    seen = coloured.views > 0
    shown = linear_from_srgb(coloured.colours / 255.0)
    matt = shown * shine_left(shown, coloured.dim, seen, around)[:, None]
    white = transfer(mesh_world, normals, around)
    light = fit_light(white, matt, seen & face_region)
    if light is None:
        return None, [compose("no-albedo", reason=compose("albedo-without-face"))]
    if chart is not None:
        light = levelled_by_chart(light, chart.normal_world)
    shading = white @ light.coefficients
    least = MIN_SHADING * np.median(shading[seen & face_region], axis=0)
    shading = 0.5 * (shading + least + np.hypot(shading - least, 0.5 * least))  # a maximum without a crease
    albedo = fill_unknown(matt / shading, seen, mesh_world.faces)
    factors = albedo / np.maximum(shown, 1e-4)
    return Albedo(Atlas(atlas.layout, multiply_texels(atlas, factors)), light), []


def shine_left(
    shown: Float[np.ndarray, "v 3"], dim: Float[np.ndarray, "v 3"], seen: Bool[np.ndarray, " v"], around: Neighbourhood
) -> Float[np.ndarray, " v"]:
    """Returns the fraction of each vertex's light that is not a highlight, from ``1 - MAX_SHINE`` to 1. The fraction is
    the brightness of ``dim``, the colours in the darker views, divided by the brightness of ``shown``. Hue is not used:
    a highlight has the hue of its lamp, and the hue in a dark view is mostly noise."""
    ratio = dim.sum(axis=1) / np.maximum(shown.sum(axis=1), 1e-4)
    ratio = np.where(seen, ratio, 1.0)
    ratio = around.smooth(ratio[:, None], CALM)[:, 0]
    # Between its views every vertex differs by noise: what most of the head has is no highlight.
    ordinary = float(np.median(ratio[seen])) if seen.any() else 1.0
    return np.clip(ratio / max(ordinary, 1e-4), 1.0 - MAX_SHINE, 1.0)


def multiply_texels(atlas: Atlas, factors: Float[np.ndarray, "v 3"]) -> UInt8[np.ndarray, "s s 3"]:
    """Returns the texture's image with each texel multiplied, in linear light, by the factors interpolated from the
    corners of the texel's triangle."""
    image, size = atlas.image, len(atlas.image)
    coarse = draw_over_layout(atlas.layout, factors[atlas.layout.source], FACTORS_PX)
    encoded = np.rint(255 * srgb_from_linear(np.arange(CODES + 1) / CODES)).astype(np.uint8)
    stored = np.empty((size, size, 3), np.uint8)  # blue first, as the texture's own
    at = ((np.arange(size) + 0.5) * len(coarse) / size - 0.5).astype(np.float32)

    def work(rows: slice) -> None:
        x, y = np.meshgrid(at, at[rows])
        by = cv2.remap(coarse, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        light = np.clip(LINEAR[image[rows]] * by, 0.0, 1.0)
        stored[rows] = encoded[(CODES * light + 0.5).astype(np.int32)][:, :, ::-1]

    map_strips(work, size, BAND_ROWS)
    return stored[:, :, ::-1]
