"""Presets: named choices of a job's settings. Whoever needs other settings writes a settings document."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.settings import settings_from_document
from rig.messages.message import Message, compose


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
