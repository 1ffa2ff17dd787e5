"""What the service tells, in German: by code and parameters, whatever the English says."""

import re
from collections.abc import Mapping
from typing import Any

import pytest

from rig.messages import message
from rig.messages.message import CATALOGUE, FIELD, FORMS, Message, compose, fields_of, verbatim
from tests.support.console_words import CONSOLE, german
from tests.support.node import evaluate

SCRIPT = CONSOLE / "static" / "messages.js"
GERMAN = german("messages_de.js")
LIGHT = compose("light-changed", factor=1.5)
MARKS = {"en": [".", ","], "de": [",", "."]}


def shown(messages: list[object], templates: Mapping[str, str], language: str = "de") -> list[str]:
    """As the console shows them."""
    argument = {"told": messages, "templates": dict(templates), "words": german(), "marks": MARKS[language]}
    argument["words"] = german() if language == "de" else {}
    return evaluate(
        SCRIPT, "given.told.map((told) => m.sentence(told, given.templates, given.words, given.marks))", argument
    )


def in_german(*messages: Message) -> list[str]:
    return shown([message.document() for message in messages], GERMAN)


def sample(code: str) -> Message:
    """A message with some value for each parameter."""
    values: dict[str, Any] = {}
    for name, specification in fields_of(CATALOGUE[code]).items():
        number = specification not in ("", "word")
        values[name] = 12345 if specification == "," else 123.4567 if number else 3 if name == "count" else f"<{name}>"
    return compose(code, **values)


def test_every_code_has_its_german_and_no_other_has() -> None:
    assert GERMAN.keys() == CATALOGUE.keys()


@pytest.mark.parametrize("code", CATALOGUE)
def test_german_has_the_same_parameters(code: str) -> None:
    english, translated = CATALOGUE[code], GERMAN[code]
    assert fields_of(translated) == fields_of(english)
    assert len(translated.split(FORMS)) == len(english.split(FORMS))
    assert [
        text for text in re.findall(r"\{[^}]*\}", translated) if not FIELD.fullmatch(text) and '"' not in text
    ] == []


def test_the_console_fills_templates_in_as_the_service_does() -> None:
    """Its English, of the same templates, is the service's own text."""
    samples = [sample(code) for code in CATALOGUE]
    sentences = shown([one.document() for one in samples], CATALOGUE, "en")
    assert dict(zip(CATALOGUE, sentences, strict=True)) == {one.code: one.text for one in samples}


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (compose("disk-free", free_gb=12.34, spare_gb=2), "12,3 GB frei; Hochladen und Aufträge lassen 2,0 GB übrig"),
        (compose("upload-too-large", bytes=1234567), "Hochgeladen werden dürfen 1.234.567 Bytes."),
        (compose("heads-stay", thing=compose("captures-pictures", count=2), count=1),
         "die Bilder von 2 Aufnahmen; 1 Kopf mit Fotos in den Überlagerungen bleibt"),
        (compose("job-without-result", state="failed"), "Der Auftrag hat kein Ergebnis (Status: gescheitert)."),
        (compose("not-in-sync", cameras=["front", "cam03"]), "nicht synchron: front, cam03"),  # a camera's name is none
        (compose("view-left-out", remark=compose("located", where="cam03", fault=compose("view-unused", remark=LIGHT))),
         "nicht jede Ansicht wird benutzt: cam03: das Licht weicht um den Faktor 1,50 von dem des Leerbilds ab: "
         "neues Leerbild aufnehmen; die Ansicht wird weggelassen"),
        (compose("print-off", side="width", percent=-0.5), "Breite ist um -0,50 % daneben"),
        (compose("jobs-queued", count=3), "3 Aufträge eingereiht. Zu verfolgen auf der Seite Aufträge."),
        (verbatim("nobody translates what a camera's maker says"), "nobody translates what a camera's maker says"),
    ],
)  # fmt: skip
def test_german_by_code_and_parameters(message: Message, text: str) -> None:
    assert in_german(message) == [text]


def test_new_english_of_every_code_changes_no_german(monkeypatch: pytest.MonkeyPatch) -> None:
    before = in_german(*(sample(code) for code in CATALOGUE))
    reworded = {code: FORMS.join(f"Anew: {form}" for form in CATALOGUE[code].split(FORMS)) for code in CATALOGUE}
    monkeypatch.setattr(message, "CATALOGUE", reworded)
    after = [sample(code) for code in CATALOGUE]
    assert all(changed.text.startswith("Anew: ") for changed in after)
    assert in_german(*after) == before


@pytest.mark.parametrize(
    "message",
    [
        "a text of an earlier version",
        {"code": "view", "message": "cam03: a warning of an earlier version"},
        {"code": "said-by-a-later-version", "message": "a message of a later version", "parameters": {"x": 1}},
        {"code": "camera-gain", "message": "of another version", "parameters": {"camera": "cam00"}},
    ],
)
def test_what_is_not_known_is_shown_as_it_came(message: Any) -> None:
    assert shown([message], GERMAN) == [message if isinstance(message, str) else message["message"]]
