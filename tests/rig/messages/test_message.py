"""Messages: made, written, read, and carried from process to process; templates that are filled in."""

import json
import pickle

import numpy as np
import pytest

from rig.errors import EigenheadError, InputError
from rig.messages.message import (
    CATALOGUE,
    FIELD,
    SPECIFICATIONS,
    Message,
    compose,
    documents_of,
    fields_of,
    message_of,
    read_message,
    render,
    texts_of,
    verbatim,
)

MOVED = compose("camera-moved", finding=compose("camera-misplaced", camera="cam03"))


def through_json(message: Message) -> Message:
    return read_message(json.loads(json.dumps(message.document(), allow_nan=False)))


@pytest.mark.parametrize(
    "message",
    [
        MOVED,
        compose("not-in-sync", cameras=["cam00", "cam01"]),
        compose("input-refused", subject="capture", faults=[MOVED, verbatim("as it came")]),
        compose("disk-free", free_gb=12.34567, spare_gb=2),
        compose("no-json-object"),
    ],
)
def test_code_and_parameters_survive_every_way(message: Message) -> None:
    for carried in (through_json(message), pickle.loads(pickle.dumps(message))):
        assert carried == message
        assert str(carried) == message.text


def test_the_text_is_the_templates_with_plain_numbers_and_infinite_ones_as_words() -> None:
    assert "12.3 GB free; uploads and jobs must leave 2.0 GB" in compose("disk-free", free_gb=12.34567, spare_gb=2).text
    assert MOVED.text.startswith("a camera is not where it was calibrated: cam03 contradicts all other")
    message = compose("camera-gain", camera="cam00", factor=np.float32(0.5))
    assert type(message.parameters["factor"]) is float
    endless = compose("camera-gain", camera="cam00", factor=np.inf)
    assert endless.document()["parameters"] == {"camera": "cam00", "factor": "inf"}  # pyright: ignore
    assert through_json(endless).text == "cam00 is inf times as bright as the others: check its exposure"


@pytest.mark.parametrize(
    ("code", "parameters"),
    [
        ("no-json-object", {"more": 1}),
        ("camera-gain", {"camera": "cam00"}),
        ("camera-gain", {}),
        ("nobody-says-this", {}),
    ],
)
def test_codes_and_parameters_are_those_of_the_templates(code: str, parameters: dict[str, str]) -> None:
    with pytest.raises((AssertionError, KeyError)):
        compose(code, **parameters)


def test_what_is_no_text_is_escaped() -> None:
    document = verbatim("key \ud800").document()
    assert json.dumps(document).encode()
    assert (document["message"], document["parameters"]) == ("key \\ud800", {"text": "key \\ud800"})  # pyright: ignore


@pytest.mark.parametrize("stored", ["the view is left out", {"code": "view", "message": "the view is left out"}])
def test_messages_of_earlier_versions_have_their_text(stored: object) -> None:
    assert read_message(stored).text == "the view is left out"
    assert read_message(stored).code in ("view", "verbatim")


@pytest.mark.parametrize("stored", [None, 3, {"code": "view"}, {"message": "text"}, ["text"]])
def test_what_is_no_message_is_refused(stored: object) -> None:
    with pytest.raises(ValueError, match="no message"):
        read_message(stored)


def test_an_error_carries_its_message_and_one_of_input_those_of_its_faults() -> None:
    error = EigenheadError(MOVED)
    assert (error.message, str(error)) == (MOVED, MOVED.text)
    assert pickle.loads(pickle.dumps(error)).message == MOVED
    assert EigenheadError("as it came").message == verbatim("as it came")
    error = InputError("cam.json", ["is no JSON", compose("no-json-object")])
    assert error.faults == (message_of("is no JSON"), compose("no-json-object"))
    assert str(error) == "cam.json: is no JSON; the request is no JSON object; send one, as application/json"
    assert texts_of(error.located()) == [f"cam.json: {fault}" for fault in error.faults]
    assert [document["code"] for document in documents_of(error.faults)] == ["verbatim", "no-json-object"]


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
