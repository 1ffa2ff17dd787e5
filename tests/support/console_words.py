"""The words of the operator's pages, read from their source: what their components and the service's modules say."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from html import unescape
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONSOLE = ROOT / "server" / "console"
PACKAGES = ("server", "calibration", "pipeline", "rig")

# As in static/language.js: tags with quoted values, and the text between them.
PARTS = re.compile(r"(<[^!](?:\"[^\"]*\"|[^\">])*>)|([^<]+)")
READ_OUT = re.compile(r"\s(?:aria-label|title|placeholder|alt|label)=\"([^\"]+)\"")
EXPRESSION = re.compile(r"\s(?:[:@]|v-)[\w.:-]+=\"([^\"]*)\"")
INTERPOLATION = re.compile(r"\{\{(.*?)\}\}", re.DOTALL)

TOKEN = re.compile(
    r"""(?P<comment>//[^\n]*|/\*.*?\*/)
      | (?P<regex>(?<=[(,=:\[!&|?+;{}\n ])/(?![/*\s])(?:\\.|\[(?:\\.|[^\]\n])*\]|[^/\n\\])+/[a-z]*)
      | (?P<string>"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')
      | (?P<tick>`)""",
    re.VERBOSE | re.DOTALL,
)


@dataclass
class Component:
    """What stands in one script: ``literals`` of its code and of expressions in its markup; ``markup``: words between
    tags and in attributes that are read out; ``mixed``: words beside an interpolation, which nobody can translate."""

    literals: set[str] = field(default_factory=set)
    markup: set[str] = field(default_factory=set)
    mixed: set[str] = field(default_factory=set)


def component(script: str) -> Component:
    found = Component()
    for literal in literals_of(script):
        if "<" in literal and re.search(r"<\w+[\s>]", literal):
            _read_markup(literal, found)
        else:
            found.literals.add(literal)
    return found


def literals_of(script: str) -> Iterator[str]:
    """String literals and template literals; a value within the latter is written ``{}``, and its literals follow."""
    at = 0
    while match := TOKEN.search(script, at):
        at = match.end()
        if match["string"]:
            yield re.sub(r"\\(.)", r"\1", match["string"][1:-1])
        elif match["tick"]:
            text, inner, at = _template(script, at)
            yield text
            for code in inner:
                yield from literals_of(code)


def _template(script: str, at: int) -> tuple[str, list[str], int]:
    text, inner = "", []
    while script[at] != "`":
        if script[at] == "\\":
            text, at = text + script[at : at + 2], at + 2
        elif script.startswith("${", at):
            end = _closing(script, at + 2)
            inner.append(script[at + 2 : end])
            text, at = text + "{}", end + 1
        else:
            text, at = text + script[at], at + 1
    return text, inner, at + 1


def _closing(script: str, at: int) -> int:
    depth = 1
    while depth:
        if script[at] in "\"'":
            at = script.index(script[at], at + 1)
        elif script[at] == "`":
            at = _template(script, at + 1)[2] - 1
        depth += {"{": 1, "}": -1}.get(script[at], 0)
        at += 1
    return at - 1


def _read_markup(markup: str, found: Component) -> None:
    for tag, text in PARTS.findall(markup):
        for code in EXPRESSION.findall(tag):
            found.literals.update(literals_of(unescape(code)))
        found.markup.update(words for words in READ_OUT.findall(tag) if is_words(words))
        for code in INTERPOLATION.findall(text):
            found.literals.update(literals_of(code))
        around = unescape(INTERPOLATION.sub("{}", text))
        if is_words(around.replace("{}", " ")):
            (found.mixed if "{}" in around else found.markup).add(" ".join(text.split()))


NAMES = frozenset(["px", "mm", "eigenhead", "IoU"])


def is_words(text: str) -> bool:
    """Whether a text between tags is more than signs, letters, units and names."""
    return any(word not in NAMES for word in re.findall(r"[A-Za-z]{2,}", unescape(text)))


@cache
def german(table: str = "de.js") -> dict[str, str]:
    """A table. Its lines are those of JSON, but for comments and the comma after the last."""
    lines = (CONSOLE / "static" / table).read_text().splitlines()
    pairs = [json.loads(f"{{{line.strip().rstrip(',')}}}") for line in lines if line.lstrip().startswith('"')]
    found = {key: value for pair in pairs for key, value in pair.items()}
    assert len(found) == len(pairs), "an English text stands in the table twice"
    return found
