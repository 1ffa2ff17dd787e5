"""Lists templates for callers of the service: their names, their accuracy, and their models."""

from collections.abc import Mapping

from pydantic import Field

from pipeline.applications.templates.header import BadTemplate, TemplateHeader, list_templates, read_header
from pipeline.head_model.model_names import list_models, model_path, model_sha256
from server.services.answer import Answer


class RegistrationOut(Answer):
    """Describes how accurately a template was fitted to its model. Distances are in mm: the median, and the value that
    95 % of vertices stay below (``p95``)."""

    skin_share: float = Field(ge=0, le=1, description="of its vertices, on the model's skin; the others follow it")
    face_covered_share: float = Field(ge=0, le=1, description="of the model's face, that it shows")
    unlike_median_mm: float = Field(description="between the mesh as it came and the nearest head of the model")
    unlike_p95_mm: float
    off_median_mm: float = Field(description="between the mesh drawn onto that head and the head")
    off_p95_mm: float


class TemplateOut(Answer):
    """Describes a template: a mesh in whose vertex order a job writes its head if ``settings.outputs.template`` names
    it."""

    id: str = Field(description="what a job calls it")
    name: str
    source: str | None = Field(description="file of the mesh")
    sha256: str | None = Field(description="of that file")
    model: str | None = Field(description="that it was registered to; a job with another one is refused")
    models: list[str] = Field(description="names of that model at /v1/models; none where it is not at hand")
    vertices: int | None
    registration: RegistrationOut | None
    fault: str | None = Field(description="why it cannot be used, and nothing else is known of it; null: it can")


def templates_at_hand() -> list[TemplateOut]:
    """Returns the available templates, sorted by name. A template whose file cannot be used has only a ``fault``.
    Raises OSError if a model's file disappears while it is read."""
    found, digests = [], None
    for name, path in list_templates().items():
        try:
            header = read_header(path)
        except BadTemplate as error:
            unknown = dict.fromkeys(("source", "sha256", "model", "vertices", "registration"))
            found.append(TemplateOut(id=name, name=name, models=[], fault=str(error.why), **unknown))
            continue
        digests = digests or {
            model: model_sha256(path) for model, path in {"default": model_path("default"), **list_models()}.items()
        }
        found.append(_at_hand(name, header, digests))
    return found


def _at_hand(name: str, header: TemplateHeader, digests: Mapping[str, str]) -> TemplateOut:
    figures = dict(header.figures)
    vertices = figures.pop("vertices", None)
    return TemplateOut(
        id=name,
        name=name,
        source=header.source,
        sha256=header.source_sha256,
        model=header.model_name,
        models=[model for model, digest in digests.items() if digest == header.model_sha256],
        vertices=None if vertices is None else int(vertices),
        registration=RegistrationOut(**figures) if figures else None,
        fault=None,
    )
