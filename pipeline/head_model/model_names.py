"""Lists the available head models and their files. The module loads no model, so the command line can call it quickly.

The data folder is given by the option ``--data``, otherwise by the variable EIGENHEAD_DATA; it is otherwise
``$XDG_DATA_HOME/eigenhead`` or ~/.local/share/eigenhead. Models are stored in the data folder's subfolder ``models``,
unless EIGENHEAD_MODELS names another folder. The command line, the service and its workers use the same folders."""

import os
from functools import lru_cache
from pathlib import Path

from rig.errors import EigenheadError
from rig.files import sha256_of

DATA, MODELS = "EIGENHEAD_DATA", "EIGENHEAD_MODELS"
PACKS = Path(__file__).parent / "packs"
DEFAULT = "makehuman-138"
PACK_FILES = {"default": "makehuman.npz", DEFAULT: "makehuman.npz", "makehuman": "makehuman.npz"}


class UnknownModel(EigenheadError):
    """Reports a model name that is neither shipped with the program, nor in the user's folder, nor a file."""

    def __init__(self, name: str) -> None:
        known = ", ".join(sorted(list_models()))
        super().__init__(
            f"no head model {name!r}: known are {known}. Give a file path, or put one into {models_folder()} "
            "with `eigenhead model import` or `eigenhead model fetch ict-facekit`"
        )


class ShippedModel(EigenheadError):
    """Reports an attempt to remove a head model that comes with the program."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the head model {name!r} comes with the program and cannot be removed")


def list_models() -> dict[str, Path]:
    """Returns the files of the available head models by name: the shipped default and those in the user's folder."""
    found = {DEFAULT: PACKS / PACK_FILES[DEFAULT]}
    folder = models_folder()
    if folder.is_dir():
        found |= {path.stem: path for path in sorted(folder.glob("*.npz"))}
    return found


def model_path(name_or_path: str | Path) -> Path:
    """Returns the file of a head model that is given by its name or path. Raises UnknownModel if no file exists."""
    name = str(name_or_path)
    if name in PACK_FILES:
        return PACKS / PACK_FILES[name]
    named = list_models().get(name)
    if named is not None:
        return named
    path = Path(name_or_path)
    if path.is_file():
        return path
    raise UnknownModel(name)


def model_sha256(path: Path) -> str:
    """Returns the SHA-256 of a model file; results state the model that they were made with by this hash. Raises
    OSError."""
    state = path.stat()
    return _sha256(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=64)
def _sha256(path: Path, changed_ns: int, size: int) -> str:
    return sha256_of(path)


def remove_model(name: str) -> Path:
    """Removes a head model from the user's folder and returns the path of the removed file. Raises UnknownModel, and
    ShippedModel for a model that comes with the program."""
    path = models_folder() / f"{name}.npz"
    if path.parent != models_folder() or not path.is_file():
        raise ShippedModel(name) if name in PACK_FILES else UnknownModel(name)
    path.unlink()
    return path


def data_folder() -> Path:
    """Returns the data folder, which holds captures, results, keys, jobs and models and may not exist yet."""
    configured = os.environ.get(DATA)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "eigenhead"


def models_folder() -> Path:
    """Returns the folder of the user's head models, which may not exist yet."""
    configured = os.environ.get(MODELS)
    return Path(configured) if configured else data_folder() / "models"
