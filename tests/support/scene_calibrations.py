"""Calibrates the Buddha's photographs, and the simulated studio's, from photographs alone."""

import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calibration.scene.result import SceneCalibration
from calibration.scene.scene import calibrate_scene
from pipeline.head_model.model import load_model
from pipeline.segmentation.segment import segment
from rig.capture import Capture
from rig.formats.captures.capture_folder import write_capture
from rig.formats.pictures.images import read_image, write_image
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import rig_from_directions
from rig.studio.scene.simulate import simulate
from rig.studio.sensor.preset import PRESET
from server.tasks.subjects import drawn_subject
from tests.support.published_poses import Agreement, agreement, read_projections
from tests.support.shared_data import shared

RINGS = ((-25.0, 0.23), (0.0, 0.3), (20.0, 0.27), (40.0, 0.2))
"""Elevation, and the share of the views that stand there, from one ear to the other."""


def directions_deg(views: int) -> list[tuple[float, float]]:
    """Azimuths and elevations of a rig that spreads its cameras over the front hemisphere."""
    counts = [round(share * views) for _, share in RINGS]
    counts[1] += views - sum(counts)
    rings = zip(RINGS, counts, strict=True)
    spread = [(float(a), elevation) for (elevation, _), n in rings for a in np.linspace(-95.0, 95.0, n)]
    return sorted(spread, key=lambda place: abs(place[0]) + abs(place[1]))


def buddha(every: int, size: float) -> tuple[SceneCalibration, Agreement]:
    """The Buddha's photographs, one of ``every``, scaled by ``size``."""
    files = sorted((shared("data/buddha") / "images").iterdir())[::every]
    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            picture = cv2.resize(read_image(file), None, fx=size, fy=size, interpolation=cv2.INTER_AREA)
            write_image(Path(folder) / f"{file.stem}.png", picture)
        found = calibrate_scene(Path(folder), one_lens=True)
    return found, agreement(found.structure, read_projections(shared("data/buddha") / "projections.json", size))


def studio(seed: int, views: int, *, masks: bool = False) -> tuple[SceneCalibration, Rig]:
    """A capture of the studio, stripped of everything but its photographs (and ``masks`` from its plates), and where
    its cameras are."""
    rng = np.random.default_rng(seed)
    with Renderer.create() as renderer, tempfile.TemporaryDirectory() as folder:
        subject = drawn_subject(load_model(), rng)
        taken = simulate(subject, rig_from_directions(directions_deg(views)), PRESET, rng, renderer=renderer)
        photographs = Capture(taken.capture.images)
        if masks:
            found = segment(taken.capture, taken.rig, report=lambda stage, share: None)
            photographs = replace(photographs, masks={name: one.mask for name, one in found.items()})
        write_capture(Path(folder), photographs, taken.rig)
        return calibrate_scene(Path(folder)), taken.scene.true_rig
