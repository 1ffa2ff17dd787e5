"""Lists the registered templates and their files. Loads nothing else: settings and the command line call it.

Templates lie in the folder ``templates`` of the data folder, each with its picture.
"""

from pathlib import Path

from pipeline.head_model.model_names import data_folder
from pipeline.settings import TEMPLATE_NAME
from rig.errors import EigenheadError
from rig.messages.message import compose


class UnknownTemplate(EigenheadError):
    """Reports a name that no registered template has."""

    def __init__(self, name: str) -> None:
        known = [*list_templates()] or ["none"]
        super().__init__(compose("template-unknown", name=f"{name!r:.60}", known=known))


class WrongName(EigenheadError):
    """Reports a name that is not allowed for a template."""

    def __init__(self, name: str) -> None:
        super().__init__(compose("template-name-wrong", name=f"{name!r:.60}"))


def is_name(name: str) -> bool:
    """Tells whether a name is allowed for a template."""
    return TEMPLATE_NAME.fullmatch(name) is not None


def templates_folder() -> Path:
    """Returns the folder of registered templates. It need not exist."""
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
    """Returns the path at which a template of this name is stored, whether it exists or not. Raises WrongName."""
    if not is_name(name):
        raise WrongName(name)
    return templates_folder() / f"{name}.npz"


def remove_template(name: str) -> Path:
    """Removes a template and its picture. Returns the path of the removed file. Raises UnknownTemplate."""
    path = template_path(name)
    path.unlink()
    path.with_suffix(".png").unlink(missing_ok=True)
    return path
