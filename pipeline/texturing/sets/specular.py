"""Separates specular from diffuse reflection by means of two sets of photographs in polarised light.

The lamps send polarised light. Specular reflection stays polarised; light scattered inside the skin does not. A lens
filter crossed with the lamps' filter passes only half of the diffuse light. A parallel lens filter passes the specular
light and half of the diffuse light (Ma et al., *Rapid Acquisition of Specular and Diffuse Normal Maps*, EGSR 2007).
Therefore, in linear light, ``cross`` is the diffuse part and ``parallel / exposure - cross`` the specular part.

The exposures of the two pictures may differ, so their ratio is measured for each camera. Specular light is nearly grey
in a picture with white balance, so differences between colour channels come from diffuse light. The ratio of these
differences in the two pictures is the ratio of the exposures. The median over the head removes outliers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, UInt8

from pipeline.compute.threads import map_in_threads, map_strips
from pipeline.compute.trace import traced
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.imaging.masks import box_around
from pipeline.imaging.silhouette import Silhouette
from pipeline.texturing.layout.uv_unwrap import Layout, spread_texels
from pipeline.texturing.paint_kernels import TAPS
from pipeline.texturing.visibility import LINEAR, Decision
from rig.image import ImageRgb

NORMAL_SHARE = 0.04  # of light at right angles that glTF's material mirrors (index of refraction 1.5)
REDUCED = 4  # pixels that become one, to calm the noise before colours are compared
CLIPPED = 0.95  # linear: brighter pixels do not tell how bright
MIN_COLOUR = 0.01  # linear, mean difference between channels, below which a picture tells no exposure
EXCHANGED, MIN_EXCHANGED = 2.0, 0.002  # negative by positive light, and the former's mean (linear): noise has 1 and
# less
COLOUR_SIDE = 128  # texels of the image of the lamps' colours: 4 mm on a head
MIN_MIRRORED = 0.004  # linear; less light is taken for grey
MAX_TINT = 2.0  # of a channel by the mean
STRIP_ROWS = 256


@dataclass(frozen=True, slots=True, eq=False)
class Specular:
    """Holds the specular reflection of a head.

    Attributes:
        light: linear, in the textures' units: the mean over the views that see a texel, 0 where none does.
        exposure: of the parallel picture, divided by that of the crossed picture, by camera.
        negative: light below zero, which noise and motion cause, divided by the light above zero.
        exchanged: whether the crossed pictures show the mirrored light.
    """

    light: Float16[np.ndarray, "s s 3"]
    exposure: Mapping[str, float]
    negative: float
    exchanged: bool

    def strength(self) -> UInt8[np.ndarray, "s s"]:
        """Returns the codes of glTF's specular strength; 255 is a reflection of ``NORMAL_SHARE`` of white light."""
        share = self.light.astype(np.float32).mean(axis=2) / NORMAL_SHARE
        return np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)


def measure_exposures(
    cross: Mapping[str, ImageRgb],
    parallel: Mapping[str, ImageRgb],
    silhouettes: Mapping[str, Silhouette],
    names: Sequence[str],
) -> dict[str, float]:
    """Measures the ratio of the exposures of each camera's parallel and crossed pictures. A camera that sees no colour
    gets the median of the others, or 1 if no camera sees any."""
    found = map_in_threads(
        lambda k: _exposure(cross[names[k]], parallel[names[k]], silhouettes[names[k]].mask), len(names)
    )
    known = [ratio for ratio in found if ratio is not None]
    common = float(np.median(known)) if known else 1.0
    return {name: common if ratio is None else ratio for name, ratio in zip(names, found, strict=True)}


def _exposure(cross: ImageRgb, parallel: ImageRgb, inside: Bool[np.ndarray, "h w"]) -> float | None:
    size = (max(cross.shape[1] // REDUCED, 1), max(cross.shape[0] // REDUCED, 1))
    scattered, both, share = (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        for image in (LINEAR[cross], LINEAR[parallel], inside.astype(np.float32))
    )
    kept = (share >= 1.0) & (np.maximum(scattered.max(axis=2), both.max(axis=2)) < CLIPPED)
    x, y = (np.diff(image[kept], axis=1).ravel() for image in (scattered, both))
    if not len(x) or np.abs(x).mean() < MIN_COLOUR:
        return None
    return _weighted_median(y / np.where(x == 0, 1e-9, x), np.abs(x))


def _weighted_median(values: Float32[np.ndarray, " n"], weights: Float32[np.ndarray, " n"]) -> float:
    order = np.argsort(values)
    passed = np.cumsum(weights[order], dtype=float)
    return float(values[order[np.searchsorted(passed, 0.5 * passed[-1])]])


@traced
def specular_light(
    cross: Mapping[str, ImageRgb],
    parallel: Mapping[str, ImageRgb],
    gains: Float[np.ndarray, "k 3"],
    decision: Decision,
    silhouettes: Mapping[str, Silhouette],
    layout: Layout,
    *,
    size: int,
) -> Specular:
    """Computes the specular reflection at every texel.

    ``cross``: pictures without specular light, by camera. ``parallel``: pictures with specular light, by camera.
    ``gains``: of each camera and channel in the crossed pictures. ``decision``: weights with which cameras see
    vertices. ``silhouettes``: by camera. ``layout``: UV layout of the head. ``size``: width of the map in texels.
    """
    views = decision.views
    exposure = measure_exposures(cross, parallel, silhouettes, views.names)

    def mirrored(k: int) -> Float32[np.ndarray, "_ _ 3"]:
        name = views.names[k]
        box = box_around(silhouettes[name].mask, TAPS)  # as ``pack_pictures`` cuts it: places begin at its corner
        light = LINEAR[parallel[name][box]] / np.float32(exposure[name]) - LINEAR[cross[name][box]]
        return light * gains[k].astype(np.float32)

    pictures = map_in_threads(mirrored, len(views))
    texels, ones = size * layout.uv - 0.5, np.ones(len(layout.uv))
    _, shown = rasterise(texels, ones, layout.faces, size, size)
    weights = decision.weights[:, layout.source]
    seen = np.asarray(np.all(weights[:, layout.faces] > 0, axis=2))
    light = np.zeros((size, size, 3), np.float32)

    def work(rows: slice) -> None:
        strip = shown[rows]
        total = np.full(strip.shape, 1e-12, np.float32)
        for k, picture in enumerate(pictures):
            values = np.concatenate([decision.pictures.places[k][layout.source], weights[k][:, None]], axis=1)
            at = interpolate(strip, texels - (0.0, rows.start), ones, layout.faces, values.astype(np.float32))
            weight = np.where((strip >= 0) & seen[k][np.maximum(strip, 0)], at[:, :, 2], np.float32(0.0))
            if not weight.any():
                continue
            x, y = np.nan_to_num(at[:, :, 0]), np.nan_to_num(at[:, :, 1])
            found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            light[rows] += weight[:, :, None] * found
            total += weight
        light[rows] /= total[:, :, None]

    map_strips(work, size, STRIP_ROWS)
    strength = light.mean(axis=2)
    above, below = (float(np.maximum(sign * strength, 0.0).mean()) for sign in (1.0, -1.0))
    exchanged = below > EXCHANGED * above and below > MIN_EXCHANGED * float((shown >= 0).mean())
    coloured = np.maximum(strength, 0.0)[:, :, None] * _lamp_colour(light)
    stored = spread_texels(coloured, shown >= 0).astype(np.float16)
    return Specular(stored, exposure, below / max(above, 1e-12), exchanged)


def _lamp_colour(light: Float32[np.ndarray, "s s 3"]) -> Float32[np.ndarray, "s s 3"]:
    """Returns the colour of specular light around each texel, scaled to mean 1. The colour is smoothed, since all lamps
    have the same colour and differences between texels are noise."""
    size = len(light)
    coarse = cv2.resize(light, (COLOUR_SIDE, COLOUR_SIDE), interpolation=cv2.INTER_AREA)
    coarse = cv2.GaussianBlur(coarse, (0, 0), 1.0)
    mean = coarse.mean(axis=2, keepdims=True)
    colour = np.where(mean > MIN_MIRRORED, coarse / np.maximum(mean, MIN_MIRRORED), np.float32(1.0))
    colour = np.clip(colour, 1 / MAX_TINT, MAX_TINT)
    colour /= colour.mean(axis=2, keepdims=True)
    return cv2.resize(colour, (size, size), interpolation=cv2.INTER_LINEAR)
