"""Templates: what is filled in, and how."""

import pytest

from rig.messages.message import CATALOGUE, FIELD, SPECIFICATIONS, fields_of, render


@pytest.mark.parametrize(
    ("template", "parameters", "text"),
    [
        ("no {name}", {"name": "cam03"}, "no cam03"),
        ("{share:.0%} of {width:,} px", {"share": 0.126, "width": 12345}, "13% of 12,345 px"),
        ("{change:+.1f} %", {"change": 0.04}, "+0.0 %"),
        ("{names} moved", {"names": ("a", "b")}, "a, b moved"),
        ("{sizes}", {"sizes": (1024, 2048)}, "1024, 2048"),
        ("{count} view | {count} views", {"count": 1}, "1 view"),
        ("{count} view | {count} views", {"count": 0}, "0 views"),
        ("{state:word}", {"state": "failed"}, "failed"),
        ("{value:.1f}", {"value": "inf"}, "inf"),  # of a number that JSON does not have
        ('such as {"fitting": {"modes": 80}}', {}, 'such as {"fitting": {"modes": 80}}'),
    ],
)
def test_a_template_is_filled_in(template: str, parameters: dict[str, object], text: str) -> None:
    assert render(template, parameters) == text


def test_forms_ask_for_a_count_and_a_missing_parameter_is_no_empty_place() -> None:
    assert fields_of("one view of {name} | {name}: several") == {"count": "", "name": ""}
    with pytest.raises(KeyError):
        render("{name}", {})


@pytest.mark.parametrize("code", CATALOGUE)
def test_every_format_is_one_that_the_console_knows(code: str) -> None:
    specifications = [specification for _, specification in FIELD.findall(CATALOGUE[code]) if specification]
    assert [text for text in specifications if not SPECIFICATIONS.fullmatch(text)] == []
