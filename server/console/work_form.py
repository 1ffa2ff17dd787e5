"""Converts what a form asks before a job is queued (model, preset, template) to a request, and lists the choices."""

from typing import NotRequired, TypedDict, cast

from rig.messages.message import MessageDocument
from server.console.page import Chosen
from server.services.presets import PRESETS, settings_of
from server.services.templates import templates_at_hand
from server.services.work import ReconstructionRequest


class PresetLine(TypedDict):
    """Holds a preset (a named choice of settings) as an entry of a form's list."""

    id: str
    title: MessageDocument
    explanation: MessageDocument


class TemplateLine(TypedDict):
    """Holds a template as an entry of a form's list. ``models``: names of the model that has it."""

    name: str
    models: list[str]


class WorkForm(Chosen):
    """Holds what a form asks before a job is queued. ``method``: id of a preset."""

    model: NotRequired[str | None]
    method: NotRequired[str | None]
    template: NotRequired[str | None]


def preset_lines() -> list[PresetLine]:
    """Converts all presets to entries of a form's list."""
    return [{"id": p.id, "title": p.title.document(), "explanation": p.explanation.document()} for p in PRESETS]


def template_lines() -> list[TemplateLine]:
    """Converts the templates whose model is at hand to entries of a form's list."""
    return [
        {"name": template.name, "models": list(template.models)} for template in templates_at_hand() if template.models
    ]


def chosen_work(event: WorkForm) -> ReconstructionRequest:
    """Returns the request that a form describes: model, preset and template. What is not chosen is left to the
    service's defaults."""
    settings, template = dict(settings_of(event.get("method"))), event.get("template")
    if template:
        settings["outputs"] = cast(dict[str, object], settings.get("outputs", {})) | {"template": template}
    return ReconstructionRequest(event.get("model") or None, settings)
