"""What a reconstruction is: the value that ``reconstruct()`` fills and ``pipeline.results.write`` writes.

It holds everything that the result folder shows and nothing that depends on where or when it was made, apart from the
seconds that the stages took (those reach report.json only, never head.ply).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.dense.parts import PartMap
from pipeline.diagnostics import Detail, ReportWarning
from pipeline.evidence.camera_metrics import CameraFigures
from pipeline.evidence.expression import Found, Posable
from pipeline.evidence.measurements import Landmark, Measurement
from pipeline.fitting.fit import Fit
from pipeline.imaging.silhouette import Silhouette
from pipeline.results.bust import Bust
from pipeline.settings import Settings
from pipeline.texture.chart_colours import ChartColours
from pipeline.texture.delight import Albedo
from pipeline.texture.reduced_layout import ReducedLayout
from pipeline.texture.uv_unwrap import Atlas
from rig.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A textured head in the world frame with its evidence. Mappings by camera have every camera of the rig."""

    fit: Fit
    model_name: str
    model_sha256: str
    mesh_world: Mesh  # full level, mm
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"]  # sRGB
    views: UInt8[np.ndarray, " v"]  # images that coloured a vertex, 0 = filled from its neighbours
    quality_mm: Float[np.ndarray, " v"]  # posterior standard deviation
    silhouettes: Mapping[str, Silhouette]
    start_masks: Mapping[str, Bool[np.ndarray, "h w"]]  # the head that the fit started from, as each camera sees it
    fitted_masks: Mapping[str, Bool[np.ndarray, "h w"]]
    cameras: Mapping[str, CameraFigures]
    landmarks: Mapping[str, Landmark]  # world frame
    measurements: Mapping[str, Measurement]
    front: str
    settings: Settings
    digests: Mapping[str, str]  # sha256 of every input file
    seconds: Mapping[str, float]  # per stage, and "total"
    warnings: tuple[ReportWarning, ...] = ()
    detail: Detail = field(default_factory=lambda: Detail("span", "not stated"))
    gains: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)  # linear RGB, by camera
    chart: ChartColours | None = None  # where the settings ask for it and a plate shows one
    pictures: Mapping[str, str] = field(default_factory=dict)  # cameras that were given another's, and whose
    atlas: Atlas | None = None  # where a format has a texture and the model a layout
    reduced: ReducedLayout | None = None  # of the atlas, where the settings ask for a normal map
    expression: tuple[Found, ...] = ()  # the face that the head makes, the strongest part first
    posed: range = range(0)  # which of the fit's coefficients are weights of expressions
    posable: Posable | None = None  # where the settings ask for it
    albedo: Albedo | None = None  # where the settings ask for it and the light can be told
    bust: Bust | None = None  # where the settings ask for it and the photographs carry it
    parts: Mapping[str, PartMap] = field(default_factory=dict)  # skin, hair or clothes in a view's pixels, where told
