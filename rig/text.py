"""What a text from outside must be before it is stored or sent on, and what a mistyped word may have meant."""

import difflib
from collections.abc import Iterable


def is_encodable(text: str) -> bool:
    """Tells whether a text can be written as UTF-8: an escape of JSON can name half of a character, which cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(text: str) -> str:
    """Returns the text with what cannot be written as UTF-8 escaped, so that a message can quote it."""
    return text.encode("utf-8", "backslashreplace").decode()


def suggest(word: str, known: Iterable[str], *, most: int = 1, min_likeness: float = 0.6) -> list[str]:
    """Returns the known words that somebody who wrote ``word`` may have meant, the nearest first.

    Args:
        word: what was written.
        known: what there is.
        most: words returned at most.
        min_likeness: share of letters, 0 to 1, that both have in the same order (difflib's ratio); 0.6 lets two wrong
            letters of five pass.
    """
    return difflib.get_close_matches(word, list(known), n=most, cutoff=min_likeness)
