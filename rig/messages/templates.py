"""Fills in templates of sentences: ``{name}`` is replaced by a parameter, ``{name:.1f}`` by a number; "one | several"
are the forms for a count.

Format specifications are those of Python that the console's ``messages.js`` knows, too (``SPECIFICATIONS``). ``word``
marks a value that is translated, such as the state of a job, unlike a name.
"""

import re
from collections.abc import Mapping
from typing import Any

FIELD = re.compile(r"\{(\w+)(?::([^{}]+))?\}")
SPECIFICATIONS = re.compile(r"word|g|,|[+]?\.\d[f%g]")
FORMS = " | "


def fields_of(template: str) -> dict[str, str]:
    """Returns the format specification of every field: "" without one, ``count`` if the template has forms for it."""
    fields = {name: specification or "" for name, specification in FIELD.findall(template)}
    return {"count": "", **fields} if FORMS in template else fields


def render(template: str, parameters: Mapping[str, Any]) -> str:
    """Fills a template in. Raises KeyError for a field without a parameter."""
    forms = template.split(FORMS)
    form = forms[0] if len(forms) == 1 or parameters["count"] == 1 else forms[-1]
    return FIELD.sub(lambda field: _written(parameters[field[1]], field[2] or ""), form)


def _written(value: object, specification: str) -> str:
    """Lists have commas between names, and semicolons between sentences."""
    if isinstance(value, tuple):
        between = ", " if all(isinstance(item, str | int | float) for item in value) else "; "
        return between.join(_written(item, specification) for item in value)
    if isinstance(value, int | float) and specification != "word":
        return format(value, specification)
    return str(value)
