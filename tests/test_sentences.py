"""The draw of sentences: from every kind of text, whole ones, the same for one seed."""

import subprocess
import sys

from tests.tools.sentences import MIN_WORDS, ROOT, list_sentences


def drawn(*arguments: str) -> str:
    command = [sys.executable, "-m", "tests.tools.sentences", *arguments]
    return subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=60, check=True).stdout


def test_sentences_come_from_documents_docstrings_and_messages() -> None:
    sentences = list_sentences()
    for kind in ("docs/", "README.md", "pipeline/", "rig/", "calibration/", "server/", "message "):
        assert sum(place.startswith(kind) for place, _ in sentences) > 10, kind
    assert all(len(sentence.split()) >= MIN_WORDS and ". The " not in sentence for _, sentence in sentences)


def test_a_seed_draws_the_same_sentences_again() -> None:
    first = drawn("7", "a")
    assert first.count("\n") == 14
    assert first == drawn("7", "a")
    assert first != drawn("7", "b")
