"""Chooses the modes of a head model that a reconstruction fits."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from pipeline.compute.array_cache import cached_arrays
from pipeline.head_model.gaussian_process import with_kernel
from pipeline.head_model.model import HeadModel, with_expressions, with_modes
from pipeline.settings import Settings
from rig.mesh import vertex_normals


def model_basis(model: HeadModel, settings: Settings) -> HeadModel:
    """Returns the model with the modes that the settings require: eigenheads alone or, if the fit may leave their span,
    eigenheads, modes of the Gaussian process, and expressions."""
    within_span = settings.detail == "span" or settings.method == "simplex"
    return basis_of(model, min(settings.fitting.modes, len(model.modes)), kernel=not within_span)


@lru_cache(maxsize=2)  # models are few, jobs are many, and others keep what they make of the same model
def basis_of(model: HeadModel, eigenheads: int, *, kernel: bool) -> HeadModel:
    """Returns the model with its first ``eigenheads`` modes and, if ``kernel``, the modes of the Gaussian process and
    the expressions after them."""
    if not kernel:
        return with_modes(model, eigenheads)
    inputs = (model.mean, model.modes[:eigenheads], model.sigma[:eigenheads], model.levels["cage"].faces)

    def make() -> dict[str, np.ndarray]:
        wider = with_kernel(model, eigenheads)
        return {"modes": wider.modes, "sigma": wider.sigma}

    arrays = cached_arrays("kernel-modes", inputs, make, made_by=(with_kernel, vertex_normals, HeadModel))
    wide = replace(with_modes(model, eigenheads), modes=arrays["modes"], sigma=arrays["sigma"], _bases={})
    return with_expressions(wide)
