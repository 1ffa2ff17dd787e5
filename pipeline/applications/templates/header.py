"""Lists the registered templates, which are files in the folder ``templates`` of the data folder. Reads the header of a
template's file without its arrays, and checks whether a job may use the template. The module ``header`` loads no head
model, because the command line, the service and the console call it before any job starts."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.head_model.model_names import data_folder, model_path, model_sha256
from pipeline.settings import TEMPLATE_NAME
from rig.errors import EigenheadError
from rig.formats.meshes.pickled_arrays import DAMAGE, open_npz
from rig.messages.message import Message, compose

FORMAT = "eigenhead-template/1"
WORDS = ("name", "source", "source_sha256", "model_name", "model_sha256")


class UnknownTemplate(EigenheadError):
    """Reports a name for which no template is registered."""

    def __init__(self, name: str) -> None:
        known = [*list_templates()] or ["none"]
        super().__init__(compose("template-unknown", name=f"{name!r:.60}", known=known))


class WrongName(EigenheadError):
    """Reports a name that is not allowed for a template."""

    def __init__(self, name: str) -> None:
        super().__init__(compose("template-name-wrong", name=f"{name!r:.60}"))


def is_name(name: str) -> bool:
    """Returns whether a name is allowed for a template."""
    return TEMPLATE_NAME.fullmatch(name) is not None


def templates_folder() -> Path:
    """Returns the folder of the registered templates, which exists once the first template is registered."""
    return data_folder() / "templates"


def list_templates() -> dict[str, Path]:
    """Returns the files of all registered templates, by name."""
    folder = templates_folder()
    found = sorted(folder.glob("*.npz")) if folder.is_dir() else []
    return {path.stem: path for path in found if is_name(path.stem)}


def template_path(name: str) -> Path:
    """Returns the file of the named template. Raises UnknownTemplate."""
    found = list_templates().get(name)
    if found is None:
        raise UnknownTemplate(name)
    return found


def new_path(name: str) -> Path:
    """Returns the path at which a template of this name is or would be stored. Raises WrongName."""
    if not is_name(name):
        raise WrongName(name)
    return templates_folder() / f"{name}.npz"


def remove_template(name: str) -> Path:
    """Removes a template and its picture. Returns the path of the removed file. Raises UnknownTemplate."""
    path = template_path(name)
    path.unlink()
    path.with_suffix(".png").unlink(missing_ok=True)
    return path


class BadTemplate(EigenheadError):
    """Reports a template file that is damaged or is not a template file."""

    def __init__(self, path: Path, why: Message | str) -> None:
        super().__init__(compose("template-unusable", path=str(path), why=why, name=path.stem))
        self.why = why


class OtherModel(EigenheadError):
    """Reports a template that was registered to a head model other than the one in use."""

    def __init__(self, template: "TemplateHeader", model_name: str) -> None:
        same = template.model_name == model_name
        super().__init__(
            compose(
                "template-of-other-version" if same else "template-of-other-model",
                template=f"{template.name!r}",
                model=f"{template.model_name!r}",
                wanted=f"{model_name!r}",
                source=template.source,
                name=f"{template.name[:20]}-2",
                wanted_name=model_name,
            )
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TemplateHeader:
    """Holds which mesh was registered to which head model, and figures that measure the quality of the registration."""

    name: str
    source: str  # the OBJ file's name
    source_sha256: str
    model_name: str
    model_sha256: str
    figures: Mapping[str, float] = field(default_factory=dict)  # of the registration

    def check_model(self, model_name: str, model_sha256: str) -> None:
        """Raises OtherModel if the template was registered to another model."""
        if model_sha256 != self.model_sha256:
            raise OtherModel(self, model_name)


def read_header(path: Path) -> TemplateHeader:
    """Returns the header of a template file. Raises BadTemplate if the file cannot be read, is damaged or of another
    kind."""
    try:
        with open_npz(path) as file:
            meta = read_meta(path, file)
        return TemplateHeader(**header_words(meta), figures=meta["figures"])
    except OSError as error:
        raise BadTemplate(path, error.strerror or compose("file-unreadable")) from None
    except DAMAGE as fault:
        raise BadTemplate(path, compose("file-incomplete", reason=str(fault))) from None


def read_meta(path: Path, file: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Returns the decoded ``meta`` entry of an open template file. Raises BadTemplate if the file is no template."""
    if "meta" not in file:
        raise BadTemplate(path, compose("template-without-format"))
    meta = json.loads(file["meta"].tobytes())
    if meta.get("format") != FORMAT:
        raise BadTemplate(path, compose("format-other", format=f"{meta.get('format')!r:.40}", wanted=f"{FORMAT!r}"))
    return meta


def header_words(meta: Mapping[str, Any]) -> dict[str, str]:
    """Returns the text fields of a template's header from its ``meta`` entry. Raises KeyError for a missing field."""
    return {word: str(meta[word]) for word in WORDS}


def check_template(name: str | None, model: str) -> None:
    """Checks that a job with the head model ``model`` (a name or a file) can use the named template; ``name`` may be
    None. Raises UnknownTemplate, BadTemplate, OtherModel, UnknownModel."""
    path = model_path(model)
    if name is not None:
        read_header(template_path(name)).check_model(model, model_sha256(path))
