"""Judges a head model by its own draws, in place of real subjects."""

import numpy as np

from pipeline.applications.model_building.training.training import generalisation, principal_components, specificity
from pipeline.head_model.model import HeadModel


def of_draws(
    model: HeadModel, *, heads: int = 138, used: int = 60, draws: int = 200, seed: int = 0
) -> dict[str, float]:
    """Computes generalisation and specificity (mm) with ``heads`` random heads of a model in place of real subjects.

    It serves models whose subjects are not published. A Gaussian has no outliers and uses all its modes, so that the
    figures differ from those of real subjects.
    """
    rng = np.random.default_rng(seed)
    flat = model.modes.reshape(len(model.modes), -1)
    drawn = model.mean + (rng.standard_normal((heads, len(flat))) @ flat).reshape(heads, *model.mean.shape)
    region = model.levels["cage"].face_region
    components = principal_components(drawn[:, region])
    everywhere = np.ones(int(region.sum()), bool)
    modes = components.modes[:used]
    return {
        "generalisation_mm": generalisation(components, everywhere, [used])[used],
        "specificity_mm": specificity(components.mean, modes, drawn[:, region], everywhere, draws=draws, seed=seed),
    }
