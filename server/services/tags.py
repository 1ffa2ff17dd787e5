"""Tags: short words that people give captures in order to find them."""

import unicodedata
from collections.abc import Iterable

from rig.errors import InputError
from rig.messages.message import compose

TAG_MOST = 50  # characters
TAGS_MOST = 20  # of one capture
SEPARATOR = ","  # between tags where people type them, and so in none of them
UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")  # Unicode's classes of control, direction, no character, new lines


def checked_tags(tags: Iterable[str]) -> tuple[str, ...]:
    """Returns the tags in one spelling (Unicode NFC, single blanks), in their order. Of tags that differ in case only,
    the first is kept. Raises InputError naming every fault."""
    found: dict[str, str] = {}
    faults = []
    for number, tag in enumerate(tags, start=1):
        plain = " ".join(word for word in unicodedata.normalize("NFC", tag).split(" ") if word)
        if any(unicodedata.category(character) in UNSEEN for character in plain):
            faults.append(compose("tag-with-control-characters", tag=number))
        elif SEPARATOR in plain:
            faults.append(compose("tag-with-comma", tag=number))
        elif not plain:
            faults.append(compose("tag-empty", tag=number))
        elif len(plain) > TAG_MOST:
            faults.append(compose("tag-too-long", tag=number, most=TAG_MOST))
        else:
            found.setdefault(plain.casefold(), plain)
    if len(found) > TAGS_MOST:
        faults.append(compose("tags-too-many", count=len(found), most=TAGS_MOST))
    if faults:
        raise InputError("tags", faults)
    return tuple(found.values())


def typed_tags(text: str) -> tuple[str, ...]:
    """Splits a text at its commas and returns the tags. Raises InputError naming every fault."""
    return checked_tags(tag for tag in text.split(SEPARATOR) if tag.strip())
