"""Computes digests that identify files and documents."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def document_sha256(document: Mapping[str, Any]) -> str:
    """Computes the sha256 of a document's canonical JSON. Results refer to their settings and inputs by it."""
    return hashlib.sha256(json.dumps(document, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def sha256_of(path: Path) -> str:
    """Computes the SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
