"""Checks the texts that people enter: names, labels, notes, and tags by which they find captures. HTTP, forms and the
console all use the module's checks."""

import re
import unicodedata
from collections.abc import Iterable, Mapping

from rig.errors import InputError
from rig.messages.message import compose
from rig.text import is_encodable

TEXT_MOST = 500  # characters
PLAIN = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f]*$"  # no control characters but tabs and line breaks, which notes have
CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
TAG_MOST = 50  # characters
TAGS_MOST = 20  # of one capture
SEPARATOR = ","  # between tags where people type them, and so in none of them
UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")  # Unicode's classes of control, direction, no character, new lines


def check_texts(texts: Mapping[str, str | None], subject: str = "form") -> None:
    """Raises InputError naming the field of every text that is longer than ``TEXT_MOST`` characters or holds characters
    that a database cannot store. Fields that are None are skipped. ``subject`` is the owner of the fields in the error
    ("form", "request")."""
    faults = []
    for name, text in texts.items():
        if text is not None and len(text) > TEXT_MOST:
            faults.append(compose("text-too-long", field=name, most=TEXT_MOST))
        elif text is not None and (CONTROL.search(text) or not is_encodable(text)):
            faults.append(compose("text-with-control-characters", field=name))
    if faults:
        raise InputError(subject, faults)


def checked_tags(tags: Iterable[str]) -> tuple[str, ...]:
    """Returns the tags in one spelling (Unicode NFC, single blanks), in their order. Of tags that differ only in case,
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
