"""Reconstructions of which every product is planted: what writers and reports are tested with."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, UInt8

from pipeline.contour_fit.fit import Fit
from pipeline.evidence.camera_metrics import CameraFigures
from pipeline.evidence.measurements import Landmark, Measurement
from pipeline.evidence.pose import PoseEvidence
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import Silhouette
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import Settings
from pipeline.stages.alignment import Alignment
from pipeline.stages.bust import Bust, HairyHead
from pipeline.stages.evidence import Evidence
from pipeline.stages.faces import Faces
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.texturing import Texturing
from pipeline.stages.views import Views
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.vertex_colours import Texture
from pipeline.warnings import Detail, ReportWarning
from rig.capture import Capture
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.messages.message import verbatim

PLACE = Similarity(1.0, rotation_from_vector(np.array([0.1, -0.3, 0.05])), np.array([12.0, -7.0, 30.0]))
Masks = Mapping[str, Bool[np.ndarray, "h w"]]


def made_up_result(
    mesh_world: Mesh,
    fit: Fit,
    *,
    colours: UInt8[np.ndarray, "v 3"] | None = None,
    views: UInt8[np.ndarray, " v"] | None = None,
    deviation_mm: np.ndarray | None = None,
    silhouettes: Mapping[str, Silhouette] | None = None,
    start_masks: Masks | None = None,
    fitted_masks: Masks | None = None,
    cameras: Mapping[str, CameraFigures] | None = None,
    landmarks: Mapping[str, Landmark] | None = None,
    measurements: Mapping[str, Measurement] | None = None,
    name: str = "mean",
    front: str = "cam00",
    settings: Settings | None = None,
    atlas: Atlas | None = None,
    bust: Bust | None = None,
    hair: HairyHead | None = None,
    warnings: tuple[ReportWarning, ...] = (),
    seconds: Mapping[str, float] | None = None,
) -> Reconstruction:
    """Returns a reconstruction that delivers ``mesh_world`` (mm); what is left out is grey, sure of 1 mm, or empty."""
    count, capture, detail = len(mesh_world.vertices), Capture({}), Detail("span", verbatim("it is made up"))
    colours = np.full((count, 3), 120, np.uint8) if colours is None else colours
    views = np.ones(count, np.uint8) if views is None else views
    deviation_mm = np.ones(count) if deviation_mm is None else deviation_mm
    evidence = Evidence(
        start_masks or {}, fitted_masks or {}, cameras or {}, landmarks or {}, measurements or {}, (), None
    )
    return Reconstruction(
        model_name=name,
        model_sha256="ab" * 32,
        settings=settings or Settings(),
        device="cpu",
        digests={"images/cam00.png": "cd" * 32},
        views=Views(capture, silhouettes or {}, {}),
        faces=Faces(None),
        alignment=Alignment(fit.world_from_head, front, "silhouettes"),
        labels=PartLabels({}),
        head=HeadFit(fit, load_model(), detail),
        refined=RefinedHead(mesh_world, deviation_mm, detail),
        texturing=Texturing(mesh_world.normals(), {}, capture, Texture(colours, views), atlas),
        bust=bust,
        hair=hair,
        pose=PoseEvidence("silhouettes", {}, None, False),
        evidence=evidence,
        warnings=warnings,
        seconds=seconds or {},
    )


def textured_result(head: Mesh, atlas: Atlas) -> Reconstruction:
    """Returns a reconstruction of ``head`` (head frame, mm) standing at ``PLACE``, with a texture."""
    world = Mesh(PLACE.apply(head.vertices), head.faces)
    return made_up_result(world, Fit("contour", np.zeros(2), PLACE, 1, "it was made up"), atlas=atlas)
