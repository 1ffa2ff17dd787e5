"""Draws sentences for a newcomer to judge: ``python -m tests.tools.sentences [N] [SEED]``.

N (40) sentences of documents, docstrings and messages are printed with the place where each stands. The seed is the
hash of the commit, so that nobody chooses them; another text as SEED draws others.
"""

import ast
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache

from rig.messages.message import CATALOGUE, FORMS
from tests.tools.counts import ROOT, parse_modules, read_modules

BLOCK = re.compile(r"\n\s*\n|\n(?=- |\d\. )")
NO_PROSE = re.compile(r"^(?:[|#<!`]|    |Args:|Attributes:)")
END = re.compile(r"(?<!\b[A-Z]\.)(?<=[.?!]) +(?=[A-Z`*\[])")  # no end after an initial
MIN_WORDS = 5


@cache
def list_sentences() -> tuple[tuple[str, str], ...]:
    """Returns every sentence of at least ``MIN_WORDS`` words with its place, in a fixed order."""
    messages = ((f"message {code}", text.split(FORMS)[-1]) for code, text in sorted(CATALOGUE.items()))
    blocks = [
        (place, block) for place, text in (*_documents(), *_docstrings(), *messages) for block in BLOCK.split(text)
    ]
    prose = [(place, " ".join(block.split())) for place, block in blocks if not NO_PROSE.match(block)]
    sentences = [(place, sentence) for place, block in prose for sentence in END.split(block)]
    return tuple((place, sentence) for place, sentence in sentences if len(sentence.split()) >= MIN_WORDS)


def _documents() -> Iterator[tuple[str, str]]:
    for path in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]):
        text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        yield path.relative_to(ROOT).as_posix(), text


def _docstrings() -> Iterator[tuple[str, str]]:
    places = {name: module.path.relative_to(ROOT) for name, module in read_modules().items()}
    for name, tree in parse_modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{places[name]}:{getattr(node, 'lineno', 1)}", ast.get_docstring(node) or ""


def draw(count: int, seed: str) -> list[tuple[str, str]]:
    """Returns ``count`` sentences with their places, the same ones for the same seed."""
    return random.Random(seed).sample(list_sentences(), count)


if __name__ == "__main__":
    commit = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=ROOT, text=True)
    options = dict(enumerate(sys.argv[1:]))
    for number, (place, sentence) in enumerate(draw(int(options.get(0, 40)), options.get(1, commit.strip())), 1):
        sys.stdout.write(f"{number:3} {place}\n    {sentence}\n")
