"""SLR cameras: which of a camera's choices is taken."""

import pytest

from rig.drivers import gphoto


@pytest.mark.parametrize(
    ("value", "choices", "chosen"),
    [
        (0.008, ["1/60", "1/125", "1/250", "bulb"], "1/125"),
        (0.5, ["1", "0.5s", "0.3"], "0.5s"),
        (0.01, ["1/60", "1/500"], None),
        ("Large Fine JPEG", ["RAW", "Large Fine JPEG"], "Large Fine JPEG"),
        ("TIFF", ["RAW"], None),
        (5000, ["4800", "5000"], "5000"),
    ],
)
def test_dslr_settings_are_the_nearest_choice(value: object, choices: list[str], chosen: str | None) -> None:
    assert gphoto._nearest_choice(value, choices) == chosen
