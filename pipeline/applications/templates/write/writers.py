"""Lists what applications add to a job's result."""

from functools import partial

from pipeline.applications.templates.load import load_template
from pipeline.applications.templates.template_file import Template
from pipeline.applications.templates.write.flame import write_flame
from pipeline.applications.templates.write.mesh import write_template, write_template_hair
from pipeline.applications.templates.write.shapes import write_posed, write_template_shapes
from pipeline.head_model.model import HeadModel
from pipeline.results.write import ResultWriter


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
