"""Runs the paper's fit (sections 4.4 and 5.1): the downhill simplex, first on a coarse mesh, then on a finer one.

The input is the aligned model and the silhouettes. The output is shape coefficients, which are valid for the finest
mesh. The pose stays that of the alignment, as in the paper. The result on the coarse mesh is the start p_0 on the finer
mesh, and both searches begin with p_i = p_0 + mu_i e_i, where mu_i = 3 sigma_i (three standard deviations, the unit of
this project's coefficients)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.contour_fit.fit import Fit
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from pipeline.simplex.nelder_mead import minimise
from pipeline.simplex.xor_objective import SilhouetteObjective
from rig.geometry import Similarity
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.rig import Rig

MU = 3.0  # section 4.4, in standard deviations
TOLERANCE = 1e-4  # relative spread of the costs; the paper names none
LIMIT = 3500  # evaluations a level: 60 modes have converged or will not


@dataclass(frozen=True, slots=True)
class HierarchyLevel:
    """Holds one step of the hierarchy: the name of its decimated mesh, and the scale of its images."""

    mesh: str
    image_scale: float


HIERARCHY = (HierarchyLevel("p99", 0.25), HierarchyLevel("p95", 0.5))  # section 5.1


def fit_simplex(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    *,
    renderer: Renderer,
    report: Progress,
    hierarchy: tuple[HierarchyLevel, ...] = HIERARCHY,
    speaking: Literal["face", "all"] = "face",
    weighted: bool = True,
) -> Fit:
    """Finds the shape coefficients that minimise the paper's eq. (2), starting from the mean head.

    Cameras without a silhouette are left out. ``report("fit", fraction)`` may raise Cancelled. ``speaking`` selects the
    pixels that count ("all", or "face" for pixels near the face); ``weighted`` selects the paper's eq. (5) instead of
    eq. (4)."""
    rig = rig.subset(name for name in silhouettes if silhouettes[name].quality.usable)
    coefficients = np.zeros(min(settings.modes, len(model.modes)))
    evaluations, reasons = 0, []
    for number, level in enumerate(hierarchy):

        def watch(count: int, cost: float, number: int = number) -> None:
            report("fit", (number + min(count / LIMIT, 1.0)) / len(hierarchy))

        with SilhouetteObjective(
            model,
            world_from_head,
            silhouettes,
            rig,
            renderer=renderer,
            level=level.mesh,
            scale=level.image_scale,
            start=coefficients,
            speaking=speaking,
            weighted=weighted,
        ) as objective:
            solution = minimise(
                objective, coefficients, np.full(len(coefficients), MU), tolerance=TOLERANCE, limit=LIMIT, watch=watch
            )
        coefficients = solution.value
        evaluations += solution.evaluations
        reasons.append(f"{level.mesh}: {solution.result}")
    return Fit(
        method="simplex",
        coefficients=coefficients,
        world_from_head=world_from_head,
        evaluations=evaluations,
        termination_reason="; ".join(reasons),
        used={name: name in rig for name in silhouettes},
    )
