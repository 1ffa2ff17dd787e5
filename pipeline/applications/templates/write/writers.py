"""Lists what applications add to a job's result."""

from functools import partial
from pathlib import Path

import numpy as np

from pipeline.applications.templates.flame_fit import FlameFit, fit_flame
from pipeline.applications.templates.template_file import Template, load_template
from pipeline.applications.templates.write.mesh import write_template, write_template_hair
from pipeline.applications.templates.write.shapes import write_posed, write_template_shapes
from pipeline.head_model.model import HeadModel
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.report_types import AddedReport, TemplateReport
from pipeline.results.write import ResultWriter
from rig.atomic_write import write_atomically
from rig.formats.meshes.flame_param import FILE, encoded, flame_param


def load_template_writers(name: str | None, model: HeadModel) -> tuple[ResultWriter, ...]:
    """Loads the named template, if any, for a job with this model; returns the writer of posed.glb, and the template's.

    Raises UnknownTemplate, BadTemplate, OtherModel.
    """
    template = load_template(name, model)
    return (write_posed, *(() if template is None else template_writers(template)))


def template_writers(template: Template) -> tuple[ResultWriter, ...]:
    """Returns what ``write_result`` calls to write a result in the order of this template too:

    - head-NAME.obj with its textures, head_hair-NAME.obj if the head was pushed out to its hair,
    - with morphs head-NAME.glb and head-NAME-shapes.npz,
    - flame_param.npz if the template was made of a FLAME model, and ``template`` of report.json.
    """
    writers = (write_flame, write_template, write_template_shapes, write_template_hair)
    return tuple(partial(write, template=template) for write in writers)


DEEP = 0.1  # how much a vertex off the skin counts


def write_flame(folder: Path, result: Reconstruction, template: Template) -> AddedReport:
    """Fits the template's FLAME model, if it has one, to the head and writes its parameters. Returns what the report
    says of the template, with the figures of the fit. Raises OSError."""
    report: TemplateReport = {
        "name": template.name,
        "source": template.source,
        "sha256": template.source_sha256,
        "registration": dict(template.figures),
    }
    if template.flame is None:
        return {"template": report}
    head, skin = result.mesh_world, template.surface_binding.skin
    weights = np.full(len(template.surface_binding.rest), DEEP)
    weights[skin] = 1.0
    fit = fit_flame(template.flame, template.surface_binding.on(head.vertices, head.faces) / 1000.0, weights)
    of = fit.parameters
    file = flame_param(of.shape, of.expression, of.pose, of.translation, fit.offsets)
    write_atomically(folder / FILE, encoded(file))
    report["flame"] = _flame_figures(fit, skin)
    return {"template": report}


def _flame_figures(fit: FlameFit, skin: np.ndarray) -> dict[str, float]:
    """Returns how far the skin of the fitted model lies from the head without ``static_offset``, mm, and how unlike the
    mean its parameters are (RMS, in standard deviations)."""
    off_mm = 1000.0 * fit.distances[skin]
    return {
        "residual_median_mm": float(np.median(off_mm)),
        "residual_p95_mm": float(np.percentile(off_mm, 95)),
        "shape_sigmas": float(np.sqrt((fit.parameters.shape**2).mean())),
        "expression_sigmas": float(np.sqrt((fit.parameters.expression**2).mean())),
    }
