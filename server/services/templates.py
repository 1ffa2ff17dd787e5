"""Lists templates for callers of the service: which there are, how well they fit, which models have them."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.applications.templates.header import BadTemplate, TemplateHeader, read_header
from pipeline.applications.templates.names import list_templates
from pipeline.head_model.model_names import list_models, model_path, model_sha256


@dataclass(frozen=True, slots=True)
class TemplateAtHand:
    """Holds a template that a job can name. ``registration`` has the figures that say how well it was fitted to its
    model."""

    id: str
    name: str
    source: str | None  # the mesh's file, as it was called
    sha256: str | None  # of that file
    model: str | None  # that it was registered to
    models: tuple[str, ...]  # what a job may call that model here; none where it is not at hand
    vertices: int | None
    registration: Mapping[str, float] | None
    fault: str | None  # of a file that cannot be used; nothing else is known of it


def templates_at_hand() -> list[TemplateAtHand]:
    """Returns the available templates, sorted by name. One whose file cannot be used has a ``fault`` and nothing else.
    Raises OSError if a model's file disappears while it is read."""
    found, digests = [], None
    for name, path in list_templates().items():
        try:
            header = read_header(path)
        except BadTemplate as error:
            found.append(TemplateAtHand(name, name, None, None, None, (), None, None, str(error.why)))
            continue
        digests = digests or {
            model: model_sha256(path) for model, path in {"default": model_path("default"), **list_models()}.items()
        }
        found.append(_at_hand(name, header, digests))
    return found


def _at_hand(name: str, header: TemplateHeader, digests: Mapping[str, str]) -> TemplateAtHand:
    figures = dict(header.figures)
    vertices = figures.pop("vertices", None)
    return TemplateAtHand(
        id=name,
        name=name,
        source=header.source,
        sha256=header.source_sha256,
        model=header.model_name,
        models=tuple(model for model, digest in digests.items() if digest == header.model_sha256),
        vertices=None if vertices is None else int(vertices),
        registration=figures or None,
        fault=None,
    )
