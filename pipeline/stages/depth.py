"""Computes a depth map for every view from the photographs, and finds which depth pixels lie on the fitted head."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from pipeline.detail.dense_points import SurfacePoints, dense_points, skin_under_cap
from pipeline.detail.depth_bias import OnFace, measure_bias, points_on_face
from pipeline.imaging.highlights import darken_highlights
from pipeline.part_labels.votes import PartVotes, vote_parts
from pipeline.settings import FINE_LEVELS, Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.recorder import Staged
from pipeline.stages.views import Views
from pipeline.stereo.depth_map import DepthMap, WindowBias
from pipeline.stereo.estimate import estimate_depth


@dataclass(frozen=True, slots=True, eq=False)
class Depth:
    """Holds the depth maps and values derived from them: part labels (skin, hair, clothes), surface points with
    normals, points on the face, and the depth bias measured on the fitted face."""

    maps: tuple[DepthMap, ...]  # none where no stage needs them
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]]  # as they were matched, without highlights
    votes: PartVotes | None
    points: SurfacePoints  # world frame, mm
    on_face: OnFace
    window_bias: WindowBias


def is_refined(head: HeadFit, settings: Settings) -> bool:
    """Returns True if a later stage deforms the head to the measured surface. The deformation requires a fit that used
    the photographs, and the detail ``fine`` in the settings."""
    return head.detail.level == "photo" and settings.detail in FINE_LEVELS


def measure_depth(context: ReconstructionContext, views: Views, head: HeadFit, labels: PartLabels) -> Staged[Depth]:
    """Computes depth maps if a later stage needs them. The fitted head limits the range of depths."""
    settings, mesh = context.settings, head.mesh_world
    maps: tuple[DepthMap, ...] = ()
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]] = views.capture.images
    if is_refined(head, settings) or settings.outputs.surface != "head":
        images = darken_highlights(images, views.silhouettes, context.rig, mesh)
        maps = estimate_depth(
            images, views.silhouettes, context.rig, mesh, report=context.progress, device=context.device
        )
    votes = vote_parts(maps, labels.maps, context.rig)
    points = dense_points(maps, votes, mesh)
    if labels.cap is not None:
        points = skin_under_cap(points, maps, labels.cap, context.rig)
    on_face = points_on_face(points, mesh, head.model.levels["full"].face_region)
    return Staged(Depth(maps, images, votes, points, on_face, measure_bias(on_face)))
