"""Reads the settings of a job from a TOML or JSON file, and overrides them by options."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path

from rig.errors import InputError
from rig.messages.message import compose

LOST = "picture-lost"  # the warning of a camera that takes no part because its pictures cannot be used


def read_settings_file(path: Path) -> dict[str, object]:
    """Reads settings from a TOML or JSON file. Raises InputError if the file cannot be read or holds no table."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # Windows editors add a byte order mark
        braced = path.suffix == ".json" or (path.suffix != ".toml" and text.lstrip().startswith("{"))
        document = json.loads(text) if braced else tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path.name, [compose("settings-unreadable", reason=reason_of(error))]) from error
    if not isinstance(document, dict):
        raise InputError(path.name, [compose("settings-no-table")])
    return document


def settings_of_text(text: str) -> dict[str, object]:
    """Reads settings from a JSON text. Raises InputError if it is no JSON object."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError("settings", [compose("no-json-because", reason=str(error))]) from error
    if not isinstance(document, dict):
        raise InputError("settings", [compose("settings-no-json-object")])
    return document


def reason_of(error: OSError | ValueError | RecursionError) -> str:
    """Returns the reason why a file cannot be read, without the file's path."""
    return getattr(error, "strerror", None) or str(error)


def settings_document(
    path: Path | None, *, strict: bool = False, **options: str | bool | Mapping[str, object] | None
) -> dict[str, object]:
    """Returns the settings of a TOML or JSON file (none without one), overridden by ``options``, whose tables are
    merged with the file's. ``strict``: a camera without usable pictures fails. Raises InputError for a bad file."""
    document = merged_settings({} if path is None else read_settings_file(path), options)
    codes = document.get("fail_on", [])
    return document | ({"fail_on": [*codes, LOST]} if strict and isinstance(codes, list) else {})


def merged_settings(document: Mapping[str, object], over: Mapping[str, object]) -> dict[str, object]:
    """Returns ``document`` overridden by ``over``, except by values of None; tables in both documents are merged."""
    merged = dict(document)
    for name, value in over.items():
        old = merged.get(name)
        if value is not None:
            merged[name] = value
            if isinstance(old, Mapping) and isinstance(value, Mapping):
                merged[name] = {**old, **value}
    return merged
