"""Settings by names: what a page offers is what the pipeline means today."""

import pytest

from pipeline.head_model.model import load_model
from pipeline.settings import settings_from_document
from pipeline.texturing.paint import find_layout
from server.console.pages.captures import PRESETS, Preset, settings_of


@pytest.mark.parametrize("preset", PRESETS, ids=lambda preset: preset.id or "standard")
def test_no_preset_is_warned_of(preset: Preset) -> None:
    _, warnings = find_layout(load_model(), settings_from_document(preset.settings))
    assert [warning.text for warning in warnings] == []


def test_renderers_get_the_formats_that_they_read() -> None:
    settings = settings_from_document(settings_of("texture"))
    assert {"obj", "usdz"} <= set(settings.outputs.formats)
    assert settings.outputs.textured


def test_what_is_no_preset_is_the_standard() -> None:
    assert settings_of(None) == settings_of("nobody") == {}
