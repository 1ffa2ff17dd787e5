"""Finds a template by its name for a job."""

from pipeline.applications.templates.names import template_path
from pipeline.applications.templates.template_file import Template, read_template
from pipeline.head_model.model import HeadModel


def load_template(name: str | None, model: HeadModel) -> Template | None:
    """Loads the named template for a job with this model; returns None if ``name`` is None.

    Raises UnknownTemplate, BadTemplate, OtherModel.
    """
    if name is None:
        return None
    template = read_template(template_path(name))
    template.check_model(model.name, model.sha256)
    return template
