"""What a page asks before a job is queued: model, preset and template."""

from typing import NotRequired, TypedDict, cast

from rig.messages.message import MessageDocument
from server.console.page import Chosen
from server.services.presets import PRESETS, settings_of
from server.services.templates import templates_at_hand
from server.services.work import ReconstructionRequest


class PresetLine(TypedDict):
    """Holds a preset as forms list it."""

    id: str
    title: MessageDocument
    explanation: MessageDocument


class TemplateLine(TypedDict):
    """Holds a template as forms list it. ``models``: names of the model that has it."""

    name: str
    models: list[str]


class WorkForm(Chosen):
    """Holds what a form asks before a job is queued. ``method``: id of a preset."""

    model: NotRequired[str | None]
    method: NotRequired[str | None]
    template: NotRequired[str | None]


def preset_lines() -> list[PresetLine]:
    """Returns all presets as forms list them."""
    return [{"id": p.id, "title": p.title.document(), "explanation": p.explanation.document()} for p in PRESETS]


def template_lines() -> list[TemplateLine]:
    """Returns the templates whose model is at hand, as forms list them."""
    return [{"name": found.name, "models": list(found.models)} for found in templates_at_hand() if found.models]


def chosen_work(event: WorkForm) -> ReconstructionRequest:
    """Returns the request that a form describes: model, preset and template. What is not chosen is left to the
    service's defaults."""
    settings, template = dict(settings_of(event.get("method"))), event.get("template")
    if template:
        settings["outputs"] = cast(dict[str, object], settings.get("outputs", {})) | {"template": template}
    return ReconstructionRequest(event.get("model") or None, settings)
