"""What a template's file says of itself, read without its arrays; and whether a job may use it. Loads no model: the
command line, the service and the console ask it before any work begins."""

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.eigenheads.model_names import model_path, model_sha256
from pipeline.templates.names import template_path
from rig.errors import EigenheadError

FORMAT = "eigenhead-template/1"
WORDS = ("name", "source", "source_sha256", "model_name", "model_sha256")
DAMAGE = (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error)


class BadTemplate(EigenheadError):
    """A file that is no template of this project, or a damaged one."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(
            f"{path} cannot be used as a template: {why}. Register it again: eigenhead template add FILE.obj "
            f"--name {path.stem} --overwrite"
        )
        self.why = why


class OtherModel(EigenheadError):
    """A template that another model carries than the one in use."""

    def __init__(self, template: "TemplateHeader", model_name: str) -> None:
        same = " of another version" if template.model_name == model_name else ""
        super().__init__(
            f"the template {template.name!r} was registered to the model {template.model_name!r}{same}, and the job's "
            f"is {model_name!r}: use that model (--model), or register the mesh to this one: eigenhead template add "
            f"{template.source} --name {template.name[:20]}-2 --model {model_name}"
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TemplateHeader:
    """Whose mesh was registered to which model, and how well."""

    name: str
    source: str  # the OBJ file's name
    source_sha256: str
    model_name: str
    model_sha256: str
    figures: Mapping[str, float] = field(default_factory=dict)  # of the registration

    def check_model(self, model_name: str, model_sha256: str) -> None:
        """Raises OtherModel."""
        if model_sha256 != self.model_sha256:
            raise OtherModel(self, model_name)


def read_header(path: Path) -> TemplateHeader:
    """Raises BadTemplate."""
    try:
        with np.load(path, allow_pickle=False) as file:
            meta = read_meta(path, file)
        return TemplateHeader(**header_words(meta), figures=meta["figures"])
    except OSError as error:
        raise BadTemplate(path, error.strerror or "cannot be read") from None
    except DAMAGE as fault:
        raise BadTemplate(path, f"damaged or incomplete ({fault})") from None


def read_meta(path: Path, file: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The decoded ``meta`` of an open template file. Raises BadTemplate for another kind of file."""
    if "meta" not in file:
        raise BadTemplate(path, "it does not carry this project's template format")
    meta = json.loads(file["meta"].tobytes())
    if meta.get("format") != FORMAT:
        raise BadTemplate(path, f"format {meta.get('format')!r:.40}, wanted {FORMAT!r}")
    return meta


def header_words(meta: Mapping[str, Any]) -> dict[str, str]:
    return {word: str(meta[word]) for word in WORDS}


def check_template(name: str | None, model: str) -> None:
    """Whether a job with this model, a name or a file, may ask for the template of this name, or for none.

    Raises UnknownTemplate, BadTemplate, OtherModel, UnknownModel."""
    path = model_path(model)
    if name is not None:
        read_header(template_path(name)).check_model(model, model_sha256(path))
