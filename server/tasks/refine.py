"""Implements ``eigenhead refine``: refines a calibration by the silhouettes of captures on disk."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calibration.silhouette_refinement.refine import Heads, TooFewCaptures, refine
from calibration.silhouette_refinement.report import RefinementRun
from pipeline.head_model.model import load_model, with_modes
from pipeline.imaging.silhouette import Silhouette
from pipeline.segmentation.segment import segment
from pipeline.settings import Settings
from pipeline.stages.alignment import align_to_views
from pipeline.stages.views import Views
from pipeline.view_checks.usable_views import exclude_moved_cameras
from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig
from rig.geometry import Similarity
from rig.messages.message import compose
from rig.progress import Progress, discard_progress
from rig.rig import Rig
from server.tasks.photographs import read_scaled_capture
from server.tasks.reconstruct import folder_of


def refine_locally(
    captures: Sequence[Path], *, calibration: Path | None, focal: bool, model: str | None, report: Progress
) -> RefinementRun:
    """Refines the common calibration of the captures, or the file ``calibration``, by the captures' silhouettes; with a
    head ``model`` also by the rims of fitted heads. ``focal``: whether to refine focal lengths too.

    A camera that moved according to the drift watch is left out of that capture: it must be calibrated again with the
    board. Raises InputError for captures that cannot be read or are not of one rig, TooFewCaptures for fewer than two
    and, with a model, TooFewFeatures, WrongFeatures and NoSubject.
    """
    if len(captures) < 2:
        raise TooFewCaptures(len(captures))
    rig = None if calibration is None else read_rig(calibration)
    settings = Settings()
    head = None if model is None else load_model(model)
    head = head and with_modes(head, min(settings.fitting.modes, len(head.modes)))
    silhouettes: list[Mapping[str, Silhouette]] = []
    starts: list[Similarity] = []
    moved: dict[str, list[str]] = {}
    for number, path in enumerate(captures):
        report("silhouettes", 0.5 * number / len(captures))
        with folder_of(path) as folder:
            capture, recorded = read_scaled_capture(folder, pixels_most=None)
        rig = rig or recorded
        faults = _differences(recorded, rig, same_poses=calibration is None)
        if faults:
            raise InputError(path.name, [*faults, compose("captures-of-one-rig")])
        segmented = segment(capture, rig, report=discard_progress)
        retained, warnings = exclude_moved_cameras(segmented, rig)
        silhouettes.append(retained)
        if head is not None:
            views = Views(capture, retained, {})
            alignment = align_to_views(head, views, rig, settings, progress=discard_progress).product
            starts.append(alignment.world_from_head)
        for name in (name for name in retained if warnings and retained[name] is not segmented[name]):
            moved.setdefault(name, []).append(path.name)
    assert rig is not None
    refined = refine(
        silhouettes,
        rig,
        focal=focal,
        heads=None if head is None else Heads(head, starts, settings.fitting),
        report=lambda stage, fraction: report(stage, 0.5 + 0.5 * fraction),
    )
    moved_warnings = [
        compose("refinement-camera-moved", camera=name, captures=where) for name, where in sorted(moved.items())
    ]
    return RefinementRun(refined, rig, tuple(path.name for path in captures), tuple(moved_warnings))


def _differences(recorded: Rig, rig: Rig, *, same_poses: bool) -> list[str]:
    if set(recorded.names) != set(rig.names):
        return [f"{name}: only in one of the two calibrations" for name in sorted(set(recorded.names) ^ set(rig.names))]
    faults = []
    for camera in recorded:
        there = rig[camera.name]
        size, wanted = ((c.intrinsics.width, c.intrinsics.height) for c in (camera, there))
        pose, first = camera.camera_from_world, there.camera_from_world
        turned = not np.allclose(pose.rotation, first.rotation, rtol=0, atol=1e-9)
        shifted = not np.allclose(pose.translation, first.translation, rtol=0, atol=1e-6)
        if size != wanted:
            faults.append(f"{camera.name}: pictures of {size[0]} x {size[1]}, calibrated for {wanted[0]} x {wanted[1]}")
        elif same_poses and (turned or shifted):
            faults.append(f"{camera.name}: stands elsewhere in its cameras.json than in the first capture's")
    return faults
