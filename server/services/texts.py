"""Checks the texts that people enter: names, labels, notes. HTTP, forms and the console all call this."""

import re
from collections.abc import Mapping

from rig.errors import InputError
from rig.messages.message import compose
from rig.text import is_encodable

TEXT_MOST = 500  # characters
PLAIN = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f]*$"  # no control characters but tabs and line breaks, which notes have
CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


def check_texts(texts: Mapping[str, str | None], subject: str = "form") -> None:
    """Raises InputError naming the field of every text that is longer than ``TEXT_MOST`` characters or holds characters
    that a database cannot store. Fields that are None are skipped. ``subject`` names in the error what the fields
    belong to ("form", "request")."""
    faults = []
    for name, text in texts.items():
        if text is not None and len(text) > TEXT_MOST:
            faults.append(compose("text-too-long", field=name, most=TEXT_MOST))
        elif text is not None and (CONTROL.search(text) or not is_encodable(text)):
            faults.append(compose("text-with-control-characters", field=name))
    if faults:
        raise InputError(subject, faults)
