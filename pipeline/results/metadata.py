"""Describes a result inside its files: model, version, unit, frame, and the inputs of the job. There are no ids and no
times, so that the same job gives the same bytes."""

from importlib.metadata import version
from typing import Any

from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import document_from_settings
from rig.digest import document_sha256

QUALITY = "quality is the posterior standard deviation in mm, views the number of images that coloured a vertex"


def ply_comments(result: Reconstruction) -> list[str]:
    """Returns the comment lines that the headers of a result's PLY and OBJ files share."""
    return [
        "unit mm",
        "frame world",
        f"model {_ascii(result.model_name)} sha256 {result.model_sha256}",
        f"job inputs sha256 {document_sha256(result.digests)}",
        f"job settings sha256 {document_sha256(document_from_settings(result.settings))}",
        f"version eigenhead {version('eigenhead')}",
    ]


def asset_extras(result: Reconstruction) -> dict[str, Any]:
    """Returns the object ``asset.extras`` of head.glb and bust.glb."""
    return {
        "unit": "m",
        "frame": "head",
        "model": {"name": result.model_name, "sha256": result.model_sha256},
        "inputs_sha256": document_sha256(result.digests),
        "settings_sha256": document_sha256(document_from_settings(result.settings)),
        "version": version("eigenhead"),
    }


def _ascii(text: str) -> str:
    """Returns the text with every character that a PLY header cannot hold replaced by a question mark."""
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
