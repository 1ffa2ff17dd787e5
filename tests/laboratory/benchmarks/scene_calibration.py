"""Calibration from photographs alone, judged by published poses or by the simulated studio's truth. From the root:

python -m tests.laboratory.benchmarks.scene_calibration buddha [--every 2] [--size 0.5]
python -m tests.laboratory.benchmarks.scene_calibration studio [--captures 10] [--views 30] [--masks]
"""

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calibration.adjustment.gauge import image_distance
from calibration.result import CalibrationRefused
from calibration.scene.result import SceneCalibration
from calibration.scene.scene import calibrate_scene
from pipeline.head_model.model import load_model
from pipeline.segmentation.segment import segment
from pipeline.settings import SegmentationSettings
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
            found = segment(taken.capture, taken.rig, SegmentationSettings(), report=lambda stage, share: None)
            photographs = replace(photographs, masks={name: one.mask for name, one in found.items()})
        write_capture(Path(folder), photographs, taken.rig)
        return calibrate_scene(Path(folder)), taken.scene.true_rig


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _print_buddha(every: int, size: float) -> None:
    start = time.process_time()
    found, agrees = buddha(every, size)
    figures = found.figures()
    _say(f"{len(found.rig)} joined, {len(found.left_out)} left out; CPU {time.process_time() - start:.0f} s")
    _say(f"{figures['points']} points, RMS {figures['rms_px']:.3f} px, noise {figures['noise_px']:.3f} px an axis")
    _say(f"claimed {np.median(found.uncertainty.pose_sigma_px):.3f} px (median), {found.rig.cameras[0].intrinsics}")
    _say(f"against the published poses: {agrees}")


def _print_studio(captures: int, views: int, *, masks: bool) -> None:
    for seed in range(1, captures + 1):
        start = time.process_time()
        try:
            found, truth = studio(seed, views, masks=masks)
        except CalibrationRefused as refusal:
            _say(f"seed {seed}: refused: {'; '.join(map(str, refusal.reasons))}")
            continue
        true = truth.subset(found.rig.names)
        away = image_distance(found.rig, true, scale=True)
        sizes = [np.ptp([camera.centre_world for camera in rig], axis=0).max() for rig in (found.rig, true)]
        _say(
            f"seed {seed}: {len(found.rig)} of {views} joined; poses {np.median(away):.2f} px median, "
            f"{away.max():.2f} worst, claimed {np.median(found.uncertainty.pose_sigma_px):.2f}; "
            f"assumed scale {sizes[0] / sizes[1]:.3f} of the true one; CPU {time.process_time() - start:.0f} s"
        )
        if found.refinement is not None:
            _say(f"    {found.refinement}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("buddha", "studio"))
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--captures", type=int, default=10)
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--masks", action="store_true")
    options = parser.parse_args()
    if options.what == "buddha":
        _print_buddha(options.every, options.size)
    else:
        _print_studio(options.captures, options.views, masks=options.masks)
