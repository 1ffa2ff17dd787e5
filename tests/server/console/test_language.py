"""The pages in German: every word has its entry in the table, and no entry is without its word.

What the table does in a browser is driven in ``tests/end_to_end/console/test_german_pages.py``.
"""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args

import pytest
from nicegui.translations import translations

from calibration.quality import verdict as calibration_verdict
from pipeline.evidence.measurements import DISTANCES
from rig.acquisition import shot, verdict
from server.console.theme import PAGES
from server.services.jobs import FINISHED
from server.services.presets import PRESETS
from server.services.storage_use import KINDS
from tests.support.console_words import (
    CONSOLE,
    PACKAGES,
    ROOT,
    Component,
    component,
    german,
    opened,
    sentences,
)

SCRIPTS = [path for path in sorted(CONSOLE.rglob("*.js")) if path.name != "de.js"]
SENTENCE = re.compile(r"[a-z]{2,}[,.:;]? [a-z({\d]")
# What looks like words in a script and is not shown: keys of the keyboard, names in the browser's store, styles.
NOT_SHOWN = re.compile(
    r"Arrow|Escape|Backspace|Delete|eigenhead |(calibration|captures?|subjects) (name|source|form|draft)"
    r"|fit again|pose graph"
    r"|Deutsch|English|.*(px|span|-gradient|input|var)\b.*[(;:)-]|\.[\w-]+ span|\{\}px sans-serif|\{\} min"
)
# Modules of which the operator reads every sentence; those of others are translated where the table has them.
READ = (
    *(path for path in sorted(CONSOLE.rglob("*.py"))),
    *(ROOT / name for name in ("rig/acquisition/judgement.py", "rig/acquisition/plate_checks.py")),
    *(ROOT / name for name in ("rig/acquisition/verdict.py", "rig/acquisition/shot.py")),
    *(ROOT / name for name in ("calibration/quality/verdict.py", "calibration/quality/checks.py")),
    *(ROOT / name for name in ("server/services/presets.py", "server/services/tags.py", "server/services/erasure.py")),
)
# Words of those modules that no page shows: names of caches and threads, headers, lines of the log, the command line.
UNREAD = {
    "server/console/comparison.py": ("number by vertex", "{} holds others"),
    "server/console/live.py": ("no live view", "live view"),
    "server/console/media.py": (
        "private, max-age=31536000, immutable",
        "sandbox; default-src",
        "surface of",
        "truth of",
    ),
    "server/console/mount.py": ("This page is not open to other web pages.",),
    "server/console/page.py": ("{} and all", "not removed", "<link"),
    "server/console/removal.py": ("not removed",),
    "server/console/theme.py": ("<link", "<meta", "document."),
    "server/console/pages/calibration.py": ("calibration board", "calibration page"),
    "server/console/pages/jobs.py": ("job counts",),
    "server/console/pages/sign_in.py": ("Sign in - eigenhead",),
    "calibration/quality/checks.py": ("{} by {}",),  # in lists, of cameras and how far each is off
    "rig/acquisition/shot.py": ("the shot failed: ", "frames came {} ms after the release"),
}


@cache
def components() -> dict[Path, Component]:
    return {path: component(path.read_text()) for path in SCRIPTS}


@cache
def said_by_the_service() -> set[str]:
    """Strings of all modules, and what stands between semicolons in them, which is understood by itself."""
    paths = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    found = {text for path in paths for _, text in sentences(path)}
    parts = {part for text in found if "; " in text for part in text.split("; ")}
    return found | parts | {text.replace("_", " ") for text in found} | set(translations["en-US"].values())


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
    yield from (*get_args(verdict.Verdict), *get_args(calibration_verdict.Word), *get_args(shot.Status))
    yield from (title for _, _, title in PAGES)
    yield from (name.replace("_", " ") for name in DISTANCES)
    yield from (text for preset in PRESETS for text in (preset.title, preset.explanation))
    yield from KINDS
    yield from shot.REMEDIES.values()
    yield from translations["en-US"].values()


def test_every_word_that_comes_as_a_value_has_its_german() -> None:
    assert set(vocabulary()) - german().keys() == set()


def test_every_code_of_a_fault_is_named() -> None:
    script = (CONSOLE / "static" / "verdict.js").read_text()
    named = dict(re.findall(r'"?([\w-]+)"?: "([a-z ]+)"', script.partition("const CODES")[2].partition("};")[0]))
    assert {named.get(code, code) for code in shot.FAULTS} - german().keys() == set()


@pytest.mark.parametrize("path", READ, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_sentence_that_the_operator_reads_has_its_german(path: Path) -> None:
    known = {opened(text) for text in german()}
    unread = UNREAD.get(str(path.relative_to(ROOT)), ())
    documents = set(shot.FAULTS.values())  # of the API's description
    missing = []
    for line, text in sentences(path):
        told = [part for part in (text, *text.split("; ")) if part]
        if not SENTENCE.search(text) or text.startswith(unread or ("\0",)) or text in documents:
            continue
        if told[0] not in known and not set(told[1:]) <= known:
            missing.append(f"{line}: {text}")
    assert missing == []


def test_no_entry_of_the_table_is_unused() -> None:
    said = set().union(*(found.literals | found.markup for found in components().values()))
    unused = [
        text
        for text in german()
        if text not in said
        and opened(text) not in said_by_the_service()
        and re.sub(r" \(\w+\)$", "", text) not in said  # two meanings of one English word
    ]
    assert unused == []


def test_both_languages_have_the_same_values_and_forms() -> None:
    wrong = []
    for text, translated in german().items():
        values = set(re.findall(r"\{#?(\w+)\}", text))
        forms, theirs = text.split(" | "), translated.split(" | ")
        numbers = sorted(value for value in values if value.isdigit())
        if values != set(re.findall(r"\{(\w+)\}", translated)) or len(forms) != len(theirs):
            wrong.append(text)
        if numbers != [str(i + 1) for i in range(len(numbers))] or (len(forms) > 1 and "{count}" not in forms[1]):
            wrong.append(text)
    assert wrong == []


def test_german_stands_in_markup_as_it_is() -> None:
    """It is put between tags and into quoted attributes without being escaped."""
    markup = set().union(*(found.markup for found in components().values()))
    assert [text for text in markup if set(german().get(text, "")) & set('<>&"{}')] == []


def test_every_script_with_words_is_spoken() -> None:
    silent = [path.name for path, found in components().items() if found.markup and "spoken({" not in path.read_text()]
    assert silent == []
