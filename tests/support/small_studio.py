"""Small captures of the simulated studio: real heads where seconds count."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.head_model.model import load_model
from rig.formats.captures.capture_folder import write_capture
from rig.formats.pictures.work_size import work_rig
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.sensor.preset import Preset
from server.tasks.subjects import drawn_subject

CAMERAS = ("cam00", "cam03", "cam04", "cam07", "cam08", "cam01")
PIXELS = 320 * 240

CLEAN = Preset(
    noise=0.0,
    light_drift=0.0,
    defocus_px=0.0,
    hair=False,
    clothes=False,
    backdrop_unevenness=0.0,
    plates=1,
    exposure_spread=0.0,
    white_balance_spread=0.0,
    vignetting=0.0,
    pose_spread_deg=0.0,
    pose_spread_mm=0.0,
    feature_noise_px=0.0,
)
"""No imperfection at all: for telling what an imperfection costs."""


def small_studio_captures(folder: Path, count: int, renderer: Renderer, *, first: int = 0) -> Path:
    """Captures s0, s1 ... (from ``first`` on) of bald heads before an even backdrop; returns the folder."""
    model = load_model()
    rig = work_rig(default_layout().subset(list(CAMERAS)), PIXELS)
    preset = replace(CLEAN, noise=0.01, plates=2, texture=False)
    for seed in range(first, first + count):
        rng = np.random.default_rng(seed)
        taken = simulate(drawn_subject(model, rng), rig, preset, rng, renderer=renderer)
        write_capture(folder / f"s{seed}", replace(taken.capture, features={}), taken.rig)
    return folder
