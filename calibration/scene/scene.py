"""Calibrates a rig from photographs of a scene by structure from motion, and finds its scale and world frame.

The input of a calibration is one photograph, or a folder of shots, for each camera. The photographed scene must have
enough detail for matching, such as a room, a table with objects, or a head seen by cameras 10 to 25 degrees apart.

If a single shot has masks, its silhouettes refine the camera poses. A check on held-out pairs of cameras decides
whether refined camera poses are kept. Each view also takes part in pairs that are not held out, so this check does not
reveal a faulty mask.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from calibration.adjustment.gauge import in_world_frame
from calibration.result import CalibrationRefused
from calibration.scene.covariance import uncertainty
from calibration.scene.matching import Matches, match_photographs
from calibration.scene.photographs import find_masks, find_photographs
from calibration.scene.result import SceneCalibration
from calibration.scene.scale import Scale, find_scale
from calibration.scene.structure import Structure, explain_missing_view, solve_structure
from calibration.silhouette_refinement.refine import (
    FOLDS,
    GAIN_SIGMAS,
    Pairs,
    gain_of,
    minimise_tangencies,
    noise_of,
    residuals,
    robust_rms,
)
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.upright import quarter_turns
from pipeline.segmentation.segment import segment
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.cameras_json import CAMERAS_LEAST, CAMERAS_MOST
from rig.formats.cameras.scale_json import read_scale
from rig.formats.captures.shot_files import with_serials
from rig.geometry import RigidTransform
from rig.messages.message import Message, compose
from rig.progress import Progress, discard_progress
from rig.rig import Rig

VIEWS_LEAST = 8  # 28 pairs; with fewer some camera would have no pairs left once a fifth is held out
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about the optical axis


def in_guessed_frame(rig: Rig, front: str | None) -> Rig:
    """Returns the rig in the world frame that ``in_world_frame`` chooses if all cameras are upright. Cameras on their
    side or upside down are turned upright only for this choice."""
    turns = [np.linalg.matrix_power(QUARTER, int(count)) for count in quarter_turns(rig)]
    upright = Rig(
        tuple(
            replace(camera, camera_from_world=RigidTransform(turn, np.zeros(3)) @ camera.camera_from_world)
            for camera, turn in zip(rig, turns, strict=True)
        )
    )
    return Rig(
        tuple(
            replace(camera, camera_from_world=RigidTransform(turn.T, np.zeros(3)) @ camera.camera_from_world)
            for camera, turn in zip(in_world_frame(upright, front), turns, strict=True)
        )
    )


JOINED_LEAST = 0.5  # share of the views; where fewer join, there are two scenes or none
MISFIT_MOST = 3.0  # of one lens for all; 1 where there is one, and to 2 where keypoints have more outliers than a
# Gaussian
LOOSE_PX = 1.0  # at the subject; a camera that is known no better than this is said so


def calibrate_scene(
    folder: Path,
    *,
    scale: Path | None = None,
    front: str | None = None,
    one_lens: bool | None = None,
    report: Progress = discard_progress,
) -> SceneCalibration:
    """Calibrates the cameras that took the photographs ``PHOTOS/<camera>.<ext>`` or ``PHOTOS/<camera>/<shot>.<ext>``.
    On one machine, the same photographs always give the same rig.

    Args:
        folder: the folder PHOTOS.
        scale: path of a ``scale.json``; None assumes the scale from the size of a head.
        front: the camera that the subject faces; None guesses it.
        one_lens: whether all photographs were taken with one camera at one setting; None assumes so if each camera has
            one picture and all have one size.
        report: progress.

    Raises an InputError that names every fault of the photographs and of ``scale.json``. Raises CalibrationRefused if
    too few views could be joined, with reasons and remedies.
    """
    photographs = find_photographs(folder)
    names = photographs.names
    if front is not None and front not in names:
        raise InputError("front camera", [compose("front-of-no-photograph", front=f"{front!r}", cameras=names)])
    known = None if scale is None else read_scale(scale, names)
    with tempfile.TemporaryDirectory() as scratch:
        matches = match_photographs(photographs, Path(scratch), one_lens=one_lens, report=report)
        structure = solve_structure(matches, Path(scratch), report=report)
    structure, left_out = judged(structure, matches)
    report("scale", 0.0)
    head = np.zeros((0, 3)) if known is not None else load_model().cage(np.zeros(0))
    scale_result = find_scale(structure, known, photographs, head)
    calibration = placed(structure, scale_result, matches, left_out, front)
    report("silhouettes", 0.0)
    calibration = refine_by_masks(calibration, find_masks(folder, photographs, calibration.rig))
    first = {name: next(iter(photographs.files[name].values())) for name in calibration.rig.names}
    return replace(calibration, rig=with_serials(calibration.rig, first))


def judged(structure: Structure | None, matches: Matches) -> tuple[Structure, dict[str, Message]]:
    """Returns the structure, and the reason for each camera that it lacks. Raises CalibrationRefused if the structure
    has too few cameras."""
    names = list(matches.sizes)
    joined = structure.rig.names if structure is not None else ()
    left_out = {name: explain_missing_view(name, matches, joined) for name in names if name not in joined}
    if structure is None or len(joined) < max(CAMERAS_LEAST, JOINED_LEAST * len(names)):
        few = compose("scene-views-join", joined=len(joined), all=len(names))
        reason = few if joined else compose("scene-no-view-joins", all=len(names))
        raise CalibrationRefused([reason, *(compose("located", where=n, fault=why) for n, why in left_out.items())])
    return structure, left_out


def placed(
    structure: Structure, scale: Scale, matches: Matches, left_out: dict[str, Message], front: str | None
) -> SceneCalibration:
    """Converts a structure to millimetres and the world frame. Returns the scene's calibration with covariances. Raises
    CalibrationRefused if the structure lacks the camera ``front``."""
    if front in left_out:
        raise CalibrationRefused([compose("front-left-out", camera=str(front), why=left_out[str(front)])])
    here = transform_structure(structure, structure.rig, scale.factor)
    here = transform_structure(here, in_guessed_frame(here.rig, front), 1.0)
    spread = uncertainty(here)
    cameras = (replace(camera, covariance=block) for camera, block in zip(here.rig, spread.blocks, strict=True))
    reasons = (compose("located", where=name, fault=why) for name, why in left_out.items())
    warnings = [compose("left-out", what=reason) for reason in reasons]
    if scale.assumed:
        warnings.append(compose("scale-good-to", scale=scale.provenance, share=scale.share))
    warnings += [
        compose("pose-known-to", camera=name, px=px)
        for name, px in zip(here.rig.names, spread.pose_sigma_px, strict=True)
        if px > LOOSE_PX
    ]
    if spread.misfit > MISFIT_MOST:
        warnings.append(compose("lenses-differ", times=spread.misfit))
    if len(here.rig) > CAMERAS_MOST:
        warnings.append(compose("joined-too-many", cameras=len(here.rig), most=CAMERAS_MOST))
    return SceneCalibration(
        Rig(tuple(cameras), scale.share),
        here,
        spread,
        scale,
        front or here.rig.front_camera(),
        left_out,
        matches.features,
        matches.matched_keypoints,
        tuple(warnings),
    )


def refine_by_masks(calibration: SceneCalibration, masks: Mapping[str, Bool[np.ndarray, "_ _"]]) -> SceneCalibration:
    """Refines the camera poses by the subject's silhouettes. The refined poses are accepted if held-out pairs of views
    agree better. Returns the unchanged calibration if there are too few masks."""
    rig = calibration.rig
    known = [name for name in rig.names if name in masks]
    if len(known) < VIEWS_LEAST:
        return calibration
    masked = Capture({}, masks={name: masks[name] for name in known})
    silhouettes = segment(masked, rig.subset(known), report=discard_progress)
    done = refine_one(silhouettes, rig)
    return calibration if done is None else replace(calibration, rig=done[0], refinement=done[1])


def transform_structure(structure: Structure, moved: Rig, factor: float) -> Structure:
    """Multiplies the structure's lengths by ``factor`` and transforms it to the frame in which its cameras have the
    poses of ``moved``."""
    before, after = structure.rig.cameras[0].camera_from_world, moved.cameras[0].camera_from_world
    new_from_old = after.inverse() @ before
    cameras = tuple(
        replace(c, camera_from_world=replace(c.camera_from_world, translation=c.camera_from_world.translation * factor))
        for c in moved
    )
    return replace(structure, rig=Rig(cameras), points=new_from_old.apply(structure.points) * factor)


def refine_one(capture: Mapping[str, Silhouette], rig: Rig) -> tuple[Rig, Message] | None:
    """Refines camera poses with the silhouettes of one capture. Returns the refined rig if held-out pairs of cameras
    agree better (five-fold cross-validation), otherwise ``rig``, with the reason. Returns None if fewer than
    ``VIEWS_LEAST`` views have a usable silhouette."""
    usable = [name for name in rig.names if name in capture and capture[name].quality.usable]
    if len(usable) < VIEWS_LEAST:
        return None
    proposed = minimise_tangencies([capture], rig, focal=False, heads=None)
    parts = []
    for fold in range(FOLDS):
        held, others = _pairs(usable, fold, inside=True), _pairs(usable, fold, inside=False)
        without = minimise_tangencies([capture], rig, focal=False, heads=None, pairs=others)
        parts.append([residuals([capture], candidate, held).px for candidate in (rig, without)])
    before, after = (np.concatenate(side) for side in zip(*parts, strict=True))
    noise = noise_of(after)
    gain, deviation = gain_of(before, after, noise)
    accepted = gain > GAIN_SIGMAS * deviation
    reason = compose(
        "refinement-pairs-shrink" if accepted else "refinement-pairs-stay",
        before_px=robust_rms(before, noise),
        after_px=robust_rms(after, noise),
        equations=len(after),
        sigmas=gain / max(deviation, 1e-9),
    )
    return proposed if accepted else rig, reason


def _pairs(names: list[str], fold: int, *, inside: bool) -> Pairs:
    """Returns a function that tests whether a pair of cameras is in a fold (``inside``) or outside it. Every camera has
    pairs in the fold and outside it."""
    index_of = {name: index for index, name in enumerate(names)}
    return lambda pair: (sum(index_of[name] for name in pair) % FOLDS == fold) == inside
