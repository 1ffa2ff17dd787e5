"""Errors of the captures with a truth beside them at every level of detail, as delivered (world frame, not realigned).

python -m tests.laboratory captures --json
python -m tests.laboratory captures --noise 6 --levels photo fine

With one thread of BLAS, as jobs run: rounding by two of them moves three frontal cameras from 0.53 to 0.48 mm.
Distances from the true face region to the head's surface, mm, weighted by area; default model, the project's own masks.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.render.renderer import Renderer
from tests.laboratory.experiments.paper.detail import read_known, surface_error
from tests.support.noisy_captures import noisier

Level = Literal["span", "kernel", "photo", "fine"]


def run(
    model: HeadModel,
    renderer: Renderer,
    *,
    captures: Path = Path("../shared/data/captures"),
    levels: Sequence[Level] = ("span", "kernel", "photo", "fine"),
    noise: Annotated[float, "levels of 255 that are added to pictures and plates"] = 0.0,
) -> dict[str, Any]:
    """Returns ``<capture>_<level>_<quantity>``."""
    found = {}
    for truth in sorted(captures.glob("*.truth")):
        known = read_known(truth.with_suffix(""))
        capture = noisier(known.capture, noise) if noise else known.capture
        for level in levels:
            settings = replace(Settings(), detail=level, outputs=OutputSettings(surface="head"))
            head = reconstruct(ReconstructionContext(capture, known.rig, model, settings, renderer))
            for name, value in surface_error(known, head.mesh_world).items():
                found[f"{known.name}_{level}_{name}"] = round(value, 4)
    return {"figures": found}
