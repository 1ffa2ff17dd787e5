"""Finds the captures with a truth and the foreign head model that the experiments read beside the checkout."""

from pathlib import Path
from typing import Annotated

from pipeline.applications.model_building.sources.imports import import_model
from pipeline.head_model.model import HeadModel, assemble, load_model
from pipeline.head_model.model_names import model_path, models_folder
from rig.errors import InputError

SHARED = Path("../shared/data")
Shared = Annotated[Path, "where captures/ and ict-facekit/ are"]


def truths(shared: Path) -> dict[str, Path]:
    """Returns the truths beside the captures of a folder, by the captures' names. Raises InputError if it has none."""
    found = {path.stem: path for path in sorted((shared / "captures").glob("*.truth"))}
    if not found:
        raise InputError(str(shared), ["holds no captures/<name>.truth; name the folder that does with --shared"])
    return found


def facekit(*, shared: Shared = SHARED) -> HeadModel:
    """Returns ICT-FaceKit: the user's own import, or the compact copy in the shared folder. Raises InputError if
    there is neither."""
    if (models_folder() / "ict-facekit.npz").is_file():
        return load_model(model_path("ict-facekit"))
    source = shared / "ict-facekit" / "ict_facekit_light.npz"
    if not source.exists():
        raise InputError("ict-facekit", ["is not at hand: run `eigenhead model fetch ict-facekit`, or name --shared"])
    return assemble(import_model(source), "imported")
