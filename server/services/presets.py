"""Settings of a job by names that people choose from; whoever needs more writes a document of settings."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.settings import settings_from_document


@dataclass(frozen=True, slots=True)
class Preset:
    """``settings``: the document that it stands for."""

    id: str
    title: str
    explanation: str
    settings: Mapping[str, object]

    def __post_init__(self) -> None:
        settings_from_document(self.settings)


PRESETS = (
    Preset("", "Standard", "Head, hair and clothes as deep as the photographs carry. The right choice for most.", {}),
    Preset(
        "quick",
        "Quick look",
        "The head from its outlines alone, in seconds: to see whether a shot is worth more.",
        {"detail": "span", "outputs": {"surface": "head"}},
    ),
    Preset("head", "Head only", "The head in full detail, without hair and clothes.", {"outputs": {"surface": "head"}}),
    Preset(
        "texture",
        "For renderers",
        "As Standard, and the textured head as OBJ and USDZ, too: for renderers, games and telephones.",
        {"outputs": {"formats": ["glb", "ply", "obj", "usdz"]}},
    ),
    Preset(
        "simplex",
        "The paper's method",
        "The downhill simplex of the paper: minutes, and less exact. For comparison.",
        {"method": "simplex"},
    ),
)


def settings_of(preset: str | None) -> Mapping[str, object]:
    """The settings of a preset by its id; those of Standard for None and for what is none."""
    return next((known.settings for known in PRESETS if known.id == (preset or "")), {})
