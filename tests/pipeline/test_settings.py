"""Settings from decoded JSON or TOML: what cannot be is named, whatever it is."""

from typing import Any

import pytest

from pipeline.settings import settings_from_document
from rig.errors import InputError


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    ("document", "fault"),
    [
        ({"front": "\ud800"}, r"front is '\ud800', wanted a text"),
        ({"fail_on": ["\ud800"]}, "fail_on is "),
        ({"\ud800": 1}, r"unknown key '\ud800'"),
        ({"outputs": {"\ud800": 1}}, r"unknown key 'outputs.\ud800'"),
        ({"surface": "head"}, "unknown key 'surface'; did you mean 'outputs.surface'?"),
        ({"outputs": {"texture_sizes": 1}}, "unknown key 'outputs.texture_sizes'; did you mean 'texture_size'?"),
        ({"bust": {"spacing_mm": 10**400}}, "bust.spacing_mm is 1000"),
        ({"bust": {"spacing_mm": 10**5000}}, "bust.spacing_mm is too large a value"),
        ({"bust": {"spacing_mm": True}}, "bust.spacing_mm is True"),
        ({"cap": {"colour": "nude"}}, "cap.colour: 'nude' is neither #rrggbb nor one of black"),
        ({"cap": {"thickness_mm": 12}}, "cap.thickness_mm is 12, wanted 0 to 10"),
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


def test_a_whole_number_is_a_length() -> None:
    assert settings_from_document({"bust": {"spacing_mm": 1}}).bust.spacing_mm == 1.0
