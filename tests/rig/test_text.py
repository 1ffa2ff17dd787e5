"""Texts from outside: what can be stored, and what a mistyped word may have meant."""

from rig.text import is_encodable, printable, suggest


def test_half_a_character_is_escaped() -> None:
    assert is_encodable("häad")
    assert not is_encodable("a\ud800")
    assert printable("a\ud800") == "a\\ud800"


def test_the_nearest_known_word_is_suggested() -> None:
    known = ("settings", "setting", "model", "front")
    assert suggest("settigns", known) == ["settings"]
    assert suggest("settigns", known, most=3) == ["settings", "setting"]
    assert suggest("colour", known) == []
    assert suggest("frnt", iter(known)) == ["front"]
    assert suggest("modl", known, min_likeness=0.95) == []
