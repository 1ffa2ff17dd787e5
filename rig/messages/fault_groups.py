"""Groups faults with one cause, so that an error in all cameras of a file is reported once."""

import re
from collections.abc import Iterable, Sequence

from rig.messages.message import Message, compose, message_of

NAMED_MOST = 4  # cameras or keys that one message names
SAME_LEAST = 3  # from so many faults on that differ in names alone, one message stands for all
MEASURED = re.compile(r"(?<![\w.])-?(?:\d+\.\d+(?:e[+-]?\d+)?(?![\w.])|\d+(?=%))")
# matches no sizes in pixels: cameras that differ in size stay apart


def say_once(faults: Sequence[Message | str], names: Iterable[str], *, named_most: int = NAMED_MOST) -> list[Message]:
    """Groups faults that differ only in the names of cameras and files, and in the values measured for each. Each group
    becomes one message that names the first and counts the others."""
    ordered = sorted(set(names), key=len, reverse=True)
    name = re.compile(r"(?<![^\W_])(" + "|".join(map(re.escape, ordered)) + r")(?![^\W_])") if ordered else None
    plate = re.compile(r"\b(background/)\S+")
    groups: dict[str, list[Message]] = {}
    for fault in dict.fromkeys(message_of(fault) for fault in faults):
        masked = plate.sub(r"\1", fault.text)
        masked = masked if name is None else name.sub("\0", masked)
        groups.setdefault(MEASURED.sub("\1", masked), []).append(fault)
    grouped = []
    for group in groups.values():
        if len(group) < SAME_LEAST or name is None:
            grouped += group
            continue
        others = dict.fromkeys(found[1] for fault in group[1:] if (found := name.search(fault.text)))
        grouped.append(
            compose("same-of-more", fault=group[0], count=len(group) - 1, names=some_of([*others], named_most))
        )
    return grouped


def some_of(names: Sequence[str], most: int = NAMED_MOST) -> Sequence[str] | Message:
    """Returns the first few names, and a note of how many more there are, for use in a message."""
    more = len(names) - most
    return compose("names-and-more", names=names[:most], more=more) if more > 0 else names
