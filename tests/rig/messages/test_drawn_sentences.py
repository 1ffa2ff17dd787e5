"""The draw of sentences: from every kind of text, whole ones, the same for one seed."""

from tests.tools.sentences import MIN_WORDS, draw, list_sentences


def test_sentences_come_from_documents_docstrings_and_messages() -> None:
    sentences = list_sentences()
    for kind in ("docs/", "README.md", "pipeline/", "rig/", "calibration/", "server/", "message "):
        assert sum(place.startswith(kind) for place, _ in sentences) > 10, kind
    assert all(len(sentence.split()) >= MIN_WORDS and ". The " not in sentence for _, sentence in sentences)


def test_a_seed_draws_the_same_sentences_again() -> None:
    first = draw(40, "a")
    assert len(set(first)) == 40
    assert first == draw(40, "a")
    assert first != draw(40, "b")
