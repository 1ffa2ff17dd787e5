"""The pages' own words in German: each has its entry in the table, and no entry is without its word. What the service
tells has its German by code: ``tests/server/console/test_messages.py``.

What the table does in a browser is driven in ``tests/end_to_end/console/test_german_pages.py``.
"""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args

from nicegui.translations import translations

from calibration.quality import checks as calibration_checks
from pipeline.evidence.measurements import DISTANCES
from rig.acquisition import shot, verdict
from server.console.theme import PAGES
from server.services.batches import ITEM_STATES
from server.services.job_rows import FINISHED
from server.services.storage_use import KINDS
from server.storage.batches import BatchState
from tests.support.console_words import CONSOLE, Component, component, german

SCRIPTS = [path for path in sorted(CONSOLE.rglob("*.js")) if path.name not in ("de.js", "messages_de.js")]
CHECKS = ("cheirality", "held-out shots", "scale", "frame", "determined", "known layout", "lens stability")
PARTS = ("database", "disk", "worker", "rig")
SENTENCE = re.compile(r"[a-z]{2,}[,.:;]? [a-z({\d]")
# What looks like words in a script and is not shown: keys of the keyboard, names in the browser's store, styles.
NOT_SHOWN = re.compile(
    r"Arrow|Escape|Backspace|Delete|eigenhead |(batches|calibration|captures?|subjects) (name|source|form|draft)"
    r"|fit again|pose graph"
    r"|Deutsch|English|.*(px|span|-gradient|input|var)\b.*[(;:)-]|\.[\w-]+ span|\{\}px sans-serif|\{\} min"
)


@cache
def components() -> dict[Path, Component]:
    return {path: component(path.read_text()) for path in SCRIPTS}


def test_every_word_of_a_script_has_its_german() -> None:
    table, missing = german(), []
    for path, found in components().items():
        words = {text for text in found.literals if SENTENCE.search(text) or re.match("[A-Z][a-z]+", text)}
        words |= {text for text in found.literals if re.search(r"\{[a-z]\w*\}", text)} | found.markup
        missing += [f"{path.name}: {text}" for text in sorted(words - table.keys()) if not NOT_SHOWN.match(text)]
    assert missing == []


def test_no_markup_mixes_words_and_values() -> None:
    """`{{ count }} shots` has no place for another order of words: it is said as a whole."""
    assert {path.name: found.mixed for path, found in components().items() if found.mixed} == {}


def vocabulary() -> Iterator[str]:
    """Words that reach the pages as values."""
    yield from ("queued", "running", *FINISHED)
    yield from (*get_args(BatchState), *(f"{state} (captures)" for state in ITEM_STATES))
    yield from (*get_args(verdict.Verdict), *get_args(calibration_checks.Word), *get_args(shot.Status))
    yield from (title for _, _, title in PAGES)
    yield from (name.replace("_", " ") for name in DISTANCES)
    yield from KINDS
    yield from (*CHECKS, *PARTS)
    yield from shot.REMEDIES.keys() - named_faults().keys()
    yield from ("left", "right", "top", "bottom", "width", "height", "first", "second", "simulated", "real")
    yield from ("capture", "captures", "job", "jobs")  # what a message counts, or what it found faults in
    yield from translations["en-US"].values()


def test_every_word_that_comes_as_a_value_has_its_german() -> None:
    assert set(vocabulary()) - german().keys() == set()


def named_faults() -> dict[str, str]:
    """The title of a fault's code where it is not the code itself."""
    script = (CONSOLE / "static" / "verdict.js").read_text()
    return dict(re.findall(r'"?([\w-]+)"?: "([a-z ]+)"', script.partition("const CODES")[2].partition("};")[0]))


def test_every_code_of_a_fault_is_named() -> None:
    assert {named_faults().get(code, code) for code in shot.REMEDIES} - german().keys() == set()


def test_no_entry_of_the_table_is_unused() -> None:
    said = set().union(*(found.literals | found.markup for found in components().values())) | set(vocabulary())
    assert [text for text in german() if re.sub(r" \(\w+\)$", "", text) not in said and text not in said] == []


def test_both_languages_have_the_same_values_and_forms() -> None:
    wrong = []
    for text, translated in german().items():
        values = set(re.findall(r"\{(\w+)\}", text))
        forms, theirs = text.split(" | "), translated.split(" | ")
        if values != set(re.findall(r"\{(\w+)\}", translated)) or len(forms) != len(theirs):
            wrong.append(text)
        if len(forms) > 1 and "{count}" not in forms[1]:
            wrong.append(text)
    assert wrong == []


def test_german_stands_in_markup_as_it_is() -> None:
    """It is put between tags and into quoted attributes without being escaped."""
    markup = set().union(*(found.markup for found in components().values()))
    assert [text for text in markup if set(german().get(text, "")) & set('<>&"{}')] == []


def test_every_script_with_words_is_spoken() -> None:
    silent = [path.name for path, found in components().items() if found.markup and "spoken({" not in path.read_text()]
    assert silent == []
