"""Makes what experiments and benchmarks take besides options of the command line: a parameter of theirs that is named
as a function here gets its value from that function. Records with needs of their own name another function."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from pipeline.head_model.model import HeadModel, load_model
from rig.errors import InputError
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.studio.sensor.preset import PRESET, made_real, realism_names
from server.cli.answers import progress_bar, wrong_usage
from server.processes import python_command, python_environment
from tests.laboratory.experiments.paper import span
from tests.laboratory.experiments.records import Bench
from tests.laboratory.experiments.shared_data import SHARED, Shared, facekit, truths
from tests.laboratory.experiments.speed.growth import Size, sizes
from tests.laboratory.experiments.speed.scaling import JobCommand

Only = Annotated[Sequence[str], "these rows, sizes or captures alone; may be repeated"]


def model(*, model: Annotated[str, "name or file of a head model"] = "default") -> HeadModel:
    """Returns the head model of ``--model``."""
    return load_model(model)


def models(model: HeadModel, facekit: HeadModel) -> dict[str, HeadModel]:
    """Returns the head model of ``--model`` and ICT-FaceKit."""
    return {"default": model, "ict": facekit}


def folder(*, out: Annotated[Path | None, "keeps rows, the table and pictures there"] = None) -> Path | None:
    """Returns the folder of ``--out``."""
    return out


def bench(report: Progress, folder: Path | None) -> Bench:
    """Returns the progress bar and the folder of ``--out``."""
    return Bench(report, folder)


@contextmanager
def scratch() -> Iterator[Path]:
    """Yields a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="eigenhead-laboratory-") as place:
        yield Path(place)


def command() -> JobCommand:
    """Returns the command that reconstructs a capture."""
    return JobCommand(python_command("cli", "reconstruct"), python_environment())


INPUTS = {
    **{"model": model, "models": models, "facekit": facekit, "others": facekit, "folder": folder, "bench": bench},
    **{"scratch": scratch, "command": command, "renderer": Renderer.create, "report": progress_bar},
}


def facekit_or_none(*, shared: Shared = SHARED) -> HeadModel | None:
    """Returns ICT-FaceKit, or None if it is not at hand."""
    try:
        return facekit(shared=shared)
    except InputError:
        return None


def requested_captures(
    *, captures: Annotated[bool, "those of --shared, too"] = False, shared: Shared = SHARED
) -> dict[str, Path]:
    """Returns the shared captures that have a truth if ``--captures`` is given."""
    return known_captures(shared=shared) if captures else {}


def known_captures(*, shared: Shared = SHARED) -> dict[str, Path]:
    """Returns the shared captures that have a truth."""
    return {name: path.with_suffix("") for name, path in truths(shared).items()}


def chosen_truths(*, only: Only = (), shared: Shared = SHARED) -> dict[str, Path]:
    """Returns the shared captures' truths, or those of ``--only``."""
    return {name: path for name, path in truths(shared).items() if not only or name in only}


def folders_or_known(folders: Sequence[Path] = (), *, shared: Shared = SHARED) -> list[Path]:
    """Returns the captures of the command line, or the shared ones that have a truth (perhaps none)."""
    return list(folders) or [path.with_suffix("") for path in sorted((shared / "captures").glob("*.truth"))]


def named_captures(folders: Sequence[Path] = (), *, shared: Shared = SHARED) -> Mapping[str, Path]:
    """Returns the captures of the command line, or the shared ones that have a truth, by name."""
    return {path.name: path for path in folders} or known_captures(shared=shared)


def timed_captures(folders: Sequence[Path] = (), *, shared: Shared = SHARED) -> list[Path]:
    """Returns the captures of the command line, or scan-a. Raises InputError for one that does not exist."""
    captures = list(folders) or [shared / "captures" / "scan-a"]
    missing = [str(path) for path in captures if not path.exists()]
    if missing:
        raise InputError(", ".join(missing), ["is not at hand: name captures, or --shared"])
    return captures


def photograph_folders(folders: Sequence[Path] = ()) -> list[Path]:
    """Returns the folders of the command line. Raises typer.BadParameter if there is none, or one does not exist."""
    missing = [str(place) for place in folders if not place.is_dir()]
    if missing or not folders:
        fault = f"{', '.join(missing)}: no such folder" if missing else "name the folders of the photographs"
        raise typer.BadParameter(fault, param_hint="FOLDERS")
    return list(folders)


def realism(*, realism: Annotated[str | None, "simulate's --realism, beside none"] = None) -> tuple[str, ...]:
    """Returns the names in ``--realism``. Raises typer.BadParameter for an unknown one."""
    names = realism_names(realism)
    with wrong_usage("--realism"):
        made_real(PRESET, names)
    return names


def job_sizes(*, only: Only = ()) -> list[Size]:
    """Returns the sizes of views and pixels, or those of ``--only`` alone."""
    return sizes(only)


def span_truths(facekit: HeadModel, *, subjects: int = 20, shared: Shared = SHARED) -> list[span.Truth]:
    """Returns the true faces of the shared captures, and random heads of ICT-FaceKit."""
    return [span.read_truth(path) for path in truths(shared).values()] + span.random_draws(facekit, subjects)
