"""Draws the pictures of a certificate: the reference and the result in clay, and the error on the result in colours."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.applications.verification.judgement import Judgement
from pipeline.applications.verification.measured import Measured
from pipeline.applications.verification.reference import Reference
from pipeline.results.clay import clay
from pipeline.results.overlays import Resized
from rig.mesh import Mesh

AZIMUTHS_DEG = (-50.0, 0.0, 50.0)
PANEL = (420, 460)
HEAT_DARKEST = 0.7  # of a colour, so that shading leaves the scale readable
PAPER = (255, 255, 255)
UNTOLD = (190, 190, 190)  # grey: nothing is said there
# Blue, white, red: ColorBrewer's RdBu (https://colorbrewer2.org), which the colour-blind can read.
RAMP = np.array([[33, 102, 172], [103, 169, 207], [247, 247, 247], [239, 138, 98], [178, 24, 43]], float)
STEPS_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # the ends that a scale may have
SHOWN = 0.95  # share of the face that lies within the ends of the scale


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """Holds three rows of pictures, seen from ``AZIMUTHS_DEG``. ``end_mm`` is the error (mm) at the ends of the colour
    scale."""

    reference: tuple[Resized, ...]
    result: tuple[Resized, ...]
    error: tuple[Resized, ...]
    end_mm: float


def draw(first: Measured, reference: Reference, judgement: Judgement) -> Pictures:
    """Draws all pictures. ``first`` is the head of the first capture in ``judgement``. The error drawn on it is the
    mean error over all captures."""
    head = first.head_from_world.apply(first.mesh_world.vertices)
    fitted = Mesh(head, first.mesh_world.faces)
    head_from_reference = first.head_from_world @ judgement.captures[0].fit.reference_from_world.inverse()
    scan = Mesh(head_from_reference.apply(reference.mesh.vertices), reference.mesh.faces)
    box = (head.min(axis=0), head.max(axis=0))
    end_mm = scale_end(judgement.repeated_mm[first.regions["face"]])
    heat = heat_colours(judgement.repeated_mm, end_mm)

    def views(mesh: Mesh, **colour: Any) -> tuple[Resized, ...]:
        return tuple(clay(mesh, azimuth_deg=of, panel=PANEL, box=box, paper=PAPER, **colour) for of in AZIMUTHS_DEG)

    return Pictures(views(scan), views(fitted), views(fitted, colours=heat, darkest=HEAT_DARKEST), end_mm)


def scale_end(deviation_mm: Float[np.ndarray, " n"]) -> float:
    """Returns the end of a colour scale (mm): the smallest of ``STEPS_MM`` that is larger than most of the
    deviations."""
    known = np.abs(deviation_mm[np.isfinite(deviation_mm)])
    wanted = float(np.quantile(known, SHOWN)) if len(known) else 0.0
    return next((step for step in STEPS_MM if step >= wanted), STEPS_MM[-1])


def heat_colours(deviation_mm: Float[np.ndarray, " v"], end_mm: float) -> UInt8[np.ndarray, "v 3"]:
    """Returns a colour for each deviation: blue where the result lies inside the reference, red where it lies outside,
    white where they agree, grey where unknown. The colours saturate at ``end_mm``."""
    place = np.clip(np.nan_to_num(deviation_mm) / end_mm, -1.0, 1.0)
    stops = np.linspace(-1.0, 1.0, len(RAMP))
    colours = np.stack([np.interp(place, stops, RAMP[:, channel]) for channel in range(3)], axis=1)
    colours[~np.isfinite(deviation_mm)] = UNTOLD
    return np.round(colours).astype(np.uint8)


def legend(width: int = 600, height: int = 24) -> Resized:
    """Draws the colour scale from ``-end_mm`` to ``end_mm``, left to right."""
    bar = heat_colours(np.linspace(-1.0, 1.0, width), 1.0)[None]
    return np.asarray(cv2.resize(bar, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)
