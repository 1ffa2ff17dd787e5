"""Converts the fields of a form (model, preset, template) to a request for a job, and lists the choices.

A preset is a named choice of a job's settings. Other settings need a settings document."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NotRequired, cast

from pipeline.settings import settings_from_document
from rig.messages.message import Message, compose
from server.console.page import Chosen
from server.services.templates import templates_at_hand
from server.services.work import ReconstructionRequest
from server.storage.records import JsonObject


@dataclass(frozen=True, slots=True)
class Preset:
    """Holds a preset: its title and explanation for people, and the settings document that it stands for. Raises
    InputError for wrong settings."""

    id: str
    title: Message
    explanation: Message
    settings: Mapping[str, object]

    def __post_init__(self) -> None:
        settings_from_document(self.settings)


PRESETS = (
    Preset("", compose("preset-standard"), compose("preset-standard-explained"), {}),
    Preset(
        "quick",
        compose("preset-quick"),
        compose("preset-quick-explained"),
        {"detail": "span", "outputs": {"surface": "head"}},
    ),
    Preset("head", compose("preset-head"), compose("preset-head-explained"), {"outputs": {"surface": "head"}}),
    Preset(
        "texture",
        compose("preset-renderers"),
        compose("preset-renderers-explained"),
        {"outputs": {"formats": ["glb", "ply", "obj", "usdz"]}},
    ),
    Preset("simplex", compose("preset-paper"), compose("preset-paper-explained"), {"method": "simplex"}),
)


def settings_of(preset: str | None) -> Mapping[str, object]:
    """Returns the settings of the preset with this id. None and an unknown id give those of the preset Standard."""
    return next((known.settings for known in PRESETS if known.id == (preset or "")), {})


class WorkForm(Chosen):
    """Holds the fields of a form for a new job. ``method``: id of a preset."""

    model: NotRequired[str | None]
    method: NotRequired[str | None]
    template: NotRequired[str | None]


def preset_lines() -> list[JsonObject]:
    """Converts all presets to entries of a form's list."""
    return [{"id": p.id, "title": p.title.document(), "explanation": p.explanation.document()} for p in PRESETS]


def template_lines() -> list[JsonObject]:
    """Converts the templates whose model is at hand to entries of a form's list."""
    return [
        {"name": template.name, "models": list(template.models)} for template in templates_at_hand() if template.models
    ]


def chosen_work(event: WorkForm) -> ReconstructionRequest:
    """Returns the request that a form describes: model, preset and template. Fields without a choice have the service's
    defaults."""
    settings, template = dict(settings_of(event.get("method"))), event.get("template")
    if template:
        settings["outputs"] = cast(dict[str, object], settings.get("outputs", {})) | {"template": template}
    return ReconstructionRequest(event.get("model") or None, settings)
