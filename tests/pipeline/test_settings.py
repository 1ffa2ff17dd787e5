"""Settings from decoded JSON or TOML: what cannot be is named, whatever it is."""

from dataclasses import replace
from typing import Any

import pytest

from pipeline.settings import OutputSettings, Settings, document_from_settings, settings_from_document
from rig.errors import InputError


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    ("document", "fault"),
    [
        ({"front": "\ud800"}, r"front is '\ud800'; expected a text"),
        ({"fail_on": ["\ud800"]}, "fail_on[0] is "),
        ({"\ud800": 1}, r"unknown key '\ud800'"),
        ({"outputs": {"\ud800": 1}}, r"unknown key 'outputs.\ud800'"),
        ({"warnings": []}, "unknown key 'warnings'"),
        ({"surface": "head"}, "unknown key 'surface'; did you mean 'outputs.surface'?"),
        ({"outputs": {"texture_sizes": 1}}, "unknown key 'outputs.texture_sizes'; did you mean 'texture_size'?"),
        ({"bust": {"spacing_mm": 0.4}}, "bust.spacing_mm is 0.4, expected 0.5 to 3"),
        ({"bust": {"spacing_mm": 10**400}}, "bust.spacing_mm is 1000"),
        ({"bust": {"spacing_mm": 10**5000}}, "bust.spacing_mm is too large a value"),
        ({"bust": {"spacing_mm": True}}, "bust.spacing_mm is True"),
        ({"cap": {"colour": "nude"}}, "cap.colour: 'nude' is neither #rrggbb nor one of black"),
        ({"cap": {"thickness_mm": 12}}, "cap.thickness_mm is 12, expected 0 to 10"),
        ({"bust": {"spacing_mm": float("nan")}}, "bust.spacing_mm is nan"),
        ({"front": nested(100_000)}, "front is too large a value"),
    ],
)
def test_what_cannot_be_is_named_in_text_that_can_be_sent(document: dict[str, Any], fault: str) -> None:
    with pytest.raises(InputError) as error:
        settings_from_document(document)
    (message,) = error.value.faults
    assert fault in message.text
    message.text.encode()


def test_a_whole_number_is_a_length_and_the_least_one_is_allowed() -> None:
    for spacing in (1, 0.5):
        assert settings_from_document({"bust": {"spacing_mm": spacing}}).bust.spacing_mm == spacing


def test_numbers_of_earlier_versions_are_passed_over_with_one_warning() -> None:
    old = {"segmentation": {"evidence": 8.0}, "fitting": {"modes": 40, "bare_px": 3}, "texture": {"selection": {}}}
    settings = settings_from_document(old)
    (warning,) = settings.warnings
    assert warning.parameters["setting"] == "segmentation, fitting.bare_px, texture.selection"
    assert settings.fitting.modes == 40
    assert document_from_settings(settings).keys() == document_from_settings(Settings()).keys()


def test_the_old_names_of_the_albedo_are_read() -> None:
    read = {"none": [{"delight": False}, {"delight": True, "albedo": "none"}], "glb": [{"skin": "albedo"}]}
    read |= {
        "file": [{"delight": True, "skin": "photograph"}],
        "glb": [*read["glb"], {"delight": True, "skin": "albedo"}],
    }
    for albedo, documents in read.items():
        for outputs in documents:
            settings = settings_from_document({"outputs": outputs})
            assert settings.outputs == replace(OutputSettings(), albedo=albedo), outputs
            assert [w.code for w in settings.warnings] == ["setting-renamed"] * len(outputs.keys() - {"albedo"})
