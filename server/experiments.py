"""The experiments behind ``eigenhead experiments``: which there are, and what each needs from this machine."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.eigenheads.imports import import_model
from pipeline.eigenheads.model import HeadModel, assemble, load_model, model_path, models_folder
from rig.errors import EigenheadError, InputError

Report = Callable[[str, float], None]
NAMES = ("table1", "table2", "table3", "limit", "span", "detail")


class UnknownExperiment(EigenheadError):
    """A name that no experiment has."""

    def __init__(self, name: str) -> None:
        super().__init__(f"no experiment is called {name!r}; there are {', '.join(NAMES)}")


def run_experiment(
    name: str, *, model: str, subjects: int | None, shared: Path, folder: Path | None, report: Report
) -> dict[str, Any]:
    """Figures and rows of one experiment; rows are kept in ``folder``, so that a stopped run goes on.

    ``shared`` holds captures/ with their truths and ict-facekit/. Raises UnknownExperiment, InputError.
    """
    if name not in NAMES:
        raise UnknownExperiment(name)
    head = load_model(model)
    if name == "span":
        return _span(head, shared, subjects, report)
    from rig.render.renderer import Renderer

    with Renderer.create() as renderer:
        if name == "detail":
            return _detail(head, shared, subjects, folder, renderer, report)
        from pipeline.experiments import limit, tables

        if name == "limit":
            return limit.limit(head, renderer=renderer, report=report, subjects=subjects or 15)
        count = {"subjects": subjects} if subjects else {}
        table = tables.table3 if name == "table3" else tables.table1
        return table(head, renderer=renderer, report=report, folder=folder, **count)


def _span(head: HeadModel, shared: Path, draws: int | None, report: Report) -> dict[str, Any]:
    from pipeline.experiments import span

    other = _facekit(shared)
    truths = [span.read_truth(path) for path in _truths(shared).values()]
    truths += span.random_draws(other, draws or 20)
    return span.run({"default": head, "ict": other}, truths, report=report)


def _detail(
    head: HeadModel, shared: Path, draws: int | None, folder: Path | None, renderer: Any, report: Report
) -> dict[str, Any]:
    from pipeline.experiments import detail

    other = _facekit(shared)
    captures = {name: path.with_suffix("") for name, path in _truths(shared).items()}
    return detail.run(
        {"default": head, "ict": other},
        captures,
        renderer=renderer,
        report=report,
        others=other,
        draws=draws or 20,
        in_span=draws or 10,
        folder=folder,
    )


def _truths(shared: Path) -> dict[str, Path]:
    found = {path.stem: path for path in sorted((shared / "captures").glob("*.truth"))}
    if not found:
        raise InputError(str(shared), ["holds no captures/<name>.truth; name the folder that does with --shared"])
    return found


def _facekit(shared: Path) -> HeadModel:
    """ICT-FaceKit: the user's own import, or the compact copy in the shared folder."""
    if (models_folder() / "ict-facekit.npz").is_file():
        return load_model(model_path("ict-facekit"))
    source = shared / "ict-facekit" / "ict_facekit_light.npz"
    if not source.exists():
        raise InputError("ict-facekit", ["is not at hand: run `eigenhead model fetch ict-facekit`, or name --shared"])
    return assemble(import_model(source), "imported")
