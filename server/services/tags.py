"""Tags: short words that people give captures, to find them by."""

import unicodedata
from collections.abc import Iterable

from rig.errors import InputError

TAG_MOST = 50  # characters
TAGS_MOST = 20  # of one capture
SEPARATOR = ","  # between tags where people type them, and so in none of them
UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")  # Unicode's classes of control, direction, no character, new lines


def checked_tags(tags: Iterable[str]) -> tuple[str, ...]:
    """The tags in one spelling (NFC, single blanks), each once whatever its case, in their order. Raises InputError
    naming every fault."""
    found: dict[str, str] = {}
    faults = []
    for number, tag in enumerate(tags, start=1):
        plain = " ".join(word for word in unicodedata.normalize("NFC", tag).split(" ") if word)
        shown = f"tag {number}"
        if any(unicodedata.category(character) in UNSEEN for character in plain):
            faults.append(f"{shown} has control characters or line breaks: type it anew")
        elif SEPARATOR in plain:
            faults.append(f"{shown} has a comma, which stands between tags")
        elif not plain:
            faults.append(f"{shown} is empty")
        elif len(plain) > TAG_MOST:
            faults.append(f"{shown} is longer than {TAG_MOST} characters")
        else:
            found.setdefault(plain.casefold(), plain)
    if len(found) > TAGS_MOST:
        faults.append(f"{len(found)} tags: a capture has at most {TAGS_MOST}")
    if faults:
        raise InputError("tags", faults)
    return tuple(found.values())


def typed_tags(text: str) -> tuple[str, ...]:
    """Tags as a person types them, with commas between. Raises InputError."""
    return checked_tags(tag for tag in text.split(SEPARATOR) if tag.strip())
