"""Corrects the colours of photographs by means of a colour chart that is visible in the clean plates.

The module takes the clean plates and the photographs. The module returns photographs with true colours (linear sRGB,
D65, white where the chart is white), which only the texture uses. The module also returns the direction that the chart
faced, from which the brightness of the studio's light follows. A camera that saw no chart gets the mean correction of
the other cameras.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.imaging.colour_chart import Chart, ChartCorrection, chart_correction, chart_normal, find_charts
from pipeline.texturing.light import BAND_FACTORS, Light, harmonics
from pipeline.texturing.visibility import LINEAR
from pipeline.warnings import ReportWarning
from rig.capture import Capture
from rig.colour_space import srgb_from_linear
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig

CODES = 4095
ENCODED = np.rint(255 * srgb_from_linear(np.arange(CODES + 1) / CODES)).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class ChartColours:
    """Holds the colour correction of each camera that saw a chart, and the mean direction that the charts face (unit
    vector, world frame)."""

    cameras: Mapping[str, ChartCorrection]
    normal_world: Float[np.ndarray, " 3"]

    def matrix_of(self, name: str) -> Float[np.ndarray, "3 3"]:
        """Returns the correction of a camera; a camera that saw no chart gets the mean of all."""
        correction = self.cameras.get(name)
        if correction is not None:
            return correction.matrix
        return np.mean([each.matrix for each in self.cameras.values()], axis=0)


def measure_charts(capture: Capture, rig: Rig) -> tuple[ChartColours | None, list[ReportWarning]]:
    """Finds the charts in all clean plates, and computes the colour correction of each camera. Returns None and a
    warning if no plate shows a chart."""
    charts = map_in_threads(lambda k: find_charts(capture.backgrounds.get(rig.names[k], ())), len(rig))
    return combine_charts(dict(zip(rig.names, charts, strict=True)), rig)


def combine_charts(charts: Mapping[str, list[Chart]], rig: Rig) -> tuple[ChartColours | None, list[ReportWarning]]:
    """Computes the colour correction of each camera from its charts. Returns None and a warning without a chart."""
    found = {name: chart_correction(visible) for name, visible in charts.items() if visible}
    cameras = {name: correction for name, correction in found.items() if correction is not None}
    if not cameras:
        return None, [compose("no-chart")]
    normals = [chart_normal(chart, rig[name]) for name in cameras for chart in charts[name]]
    mean = np.mean(normals, axis=0)
    return ChartColours(cameras, mean / np.linalg.norm(mean)), []


def correct_capture(capture: Capture, colours: ChartColours) -> Capture:
    """Returns the capture with the colours of its photographs and texture sets corrected; its clean plates are
    unchanged. A camera that saw no chart gets the mean correction."""

    def corrected(images: Mapping[str, ImageRgb]) -> dict[str, ImageRgb]:
        names = list(images)
        pictures = map_in_threads(lambda k: correct_picture(images[names[k]], colours.matrix_of(names[k])), len(names))
        return dict(zip(names, pictures, strict=True))

    sets = {name: corrected(images) for name, images in capture.texture_sets.items()}
    return replace(capture, images=corrected(capture.images), texture_sets=sets)


def correct_picture(
    picture: UInt8[np.ndarray, "h w 3"], matrix: Float[np.ndarray, "3 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a picture (sRGB) whose linear colours are multiplied by a camera's correction matrix and clipped to 0 to
    1."""
    linear = cv2.transform(LINEAR[picture], matrix.astype(np.float32))
    return ENCODED[(CODES * np.clip(linear, 0.0, 1.0) + 0.5).astype(np.int32)]


def levelled_by_chart(light: Light, normal_world: Float[np.ndarray, " 3"]) -> Light:
    """Returns the light scaled in each channel so that a white surface oriented like the chart is exactly white."""
    on_chart = (harmonics(normal_world[None]) * BAND_FACTORS) @ light.coefficients
    return replace(light, coefficients=light.coefficients / on_chart[0], on_chart=True)
