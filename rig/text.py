"""Decodes, checks and escapes text from users and files, and suggests corrections of mistyped words."""

import codecs
import difflib
from collections.abc import Iterable

MARKS = (  # longest first, since one begins with another
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


def is_encodable(text: str) -> bool:
    """Returns whether a text can be written as UTF-8. Half of a surrogate pair, which JSON can contain, cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(text: str) -> str:
    """Escapes characters that UTF-8 cannot encode, so that a message can quote the text."""
    return text.encode("utf-8", "backslashreplace").decode()


def suggest(word: str, known: Iterable[str], *, most: int = 1, min_likeness: float = 0.6) -> list[str]:
    """Returns the words of ``known`` that are similar to the mistyped ``word``, the most similar first.

    Args:
        word: the word as it was written.
        known: all valid words.
        most: how many words are returned at most.
        min_likeness: share of letters, 0 to 1, that both have in the same order (difflib's ratio); 0.6 allows two wrong
            letters of five.
    """
    return difflib.get_close_matches(word, list(known), n=most, cutoff=min_likeness)


def as_utf8(data: bytes) -> bytes:
    """Removes the byte order mark of a text, and converts UTF-16 and UTF-32 to UTF-8."""
    for mark, encoding in MARKS:
        if data.startswith(mark):
            return data.removeprefix(mark).decode(encoding).encode()
    return data
