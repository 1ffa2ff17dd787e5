"""Defines the value ``Reconstruction``: the products of all stages, which ``pipeline.results.write`` writes.

The value contains everything for the result folder. The value ``Reconstruction`` is reproducible, except for the
seconds of the stages, which only report.json contains.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.evidence.pose import PoseEvidence
from pipeline.faces.irises import Iris
from pipeline.settings import Settings, document_from_settings
from pipeline.stages.alignment import Alignment
from pipeline.stages.bust import Bust, HairyHead
from pipeline.stages.evidence import Evidence
from pipeline.stages.faces import Faces
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.texturing import Texturing
from pipeline.stages.views import Views
from pipeline.warnings import ReportWarning
from rig.files import document_sha256
from rig.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Reconstruction:
    """Holds everything that a reconstruction produced: the products of all stages, with the textured head in the world
    frame and its evidence."""

    model_name: str
    model_sha256: str
    settings: Settings
    device: str  # that compared the photographs
    digests: Mapping[str, str]  # sha256 of every input file
    views: Views
    faces: Faces
    alignment: Alignment
    labels: PartLabels
    head: HeadFit
    refined: RefinedHead
    texturing: Texturing
    bust: Bust | None
    hair: HairyHead | None
    pose: PoseEvidence
    evidence: Evidence
    warnings: tuple[ReportWarning, ...]
    seconds: Mapping[str, float]  # per stage, and "total"
    scale_sigma: float = 0.0  # as in ``Rig``; in every deviation

    @property
    def mesh_world(self) -> Mesh:
        """Returns the final head as a full-resolution mesh, world frame, mm."""
        return self.refined.mesh_world

    def widen_by_scale(self, sigma: float) -> "Reconstruction":
        """Enlarges the standard deviations for cameras whose common scale has the relative standard deviation
        ``sigma``. The scale acts about the head's origin."""
        centre = self.head.fit.world_from_head.translation

        def widen(mesh: Mesh, deviation_mm: Float[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
            return np.hypot(deviation_mm, sigma * ((mesh.vertices - centre) * mesh.normals()).sum(axis=1))

        refined = replace(self.refined, deviation_mm=widen(self.mesh_world, self.refined.deviation_mm))
        bust = self.bust
        if bust is not None:
            surface = replace(bust.surface, deviation_mm=widen(bust.mesh_world, bust.surface.deviation_mm))
            bust = replace(bust, shaped=replace(bust.shaped, surface=surface))
        evidence = replace(
            self.evidence,
            landmarks={name: mark.widen_by_scale(sigma, centre) for name, mark in self.evidence.landmarks.items()},
            measurements={name: length.widen_by_scale(sigma) for name, length in self.evidence.measurements.items()},
        )
        eyes = {
            side: eye.widen_by_scale(sigma, centre) if isinstance(eye, Iris) else eye
            for side, eye in self.faces.eyes.items()
        }
        faces = replace(self.faces, eyes=eyes)
        return replace(self, refined=refined, bust=bust, evidence=evidence, faces=faces, scale_sigma=sigma)


QUALITY = "quality is the posterior standard deviation in mm, views the number of images that coloured a vertex"


def ply_comments(result: Reconstruction) -> list[str]:
    """Returns the comment lines that the headers of a result's PLY and OBJ files share."""
    return [
        "unit mm",
        "frame world",
        f"model {_ascii(result.model_name)} sha256 {result.model_sha256}",
        f"job inputs sha256 {document_sha256(result.digests)}",
        f"job settings sha256 {document_sha256(document_from_settings(result.settings))}",
        f"version eigenhead {version('eigenhead')}",
    ]


def asset_extras(result: Reconstruction) -> dict[str, Any]:
    """Returns the object ``asset.extras`` of head.glb and bust.glb."""
    return {
        "unit": "m",
        "frame": "head",
        "model": {"name": result.model_name, "sha256": result.model_sha256},
        "inputs_sha256": document_sha256(result.digests),
        "settings_sha256": document_sha256(document_from_settings(result.settings)),
        "version": version("eigenhead"),
    }


def _ascii(text: str) -> str:
    """Replaces every character that a PLY header cannot contain by a question mark."""
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
