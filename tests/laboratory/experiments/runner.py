"""Runs the experiments of ``eigenhead experiments``: lists them, says what each needs from this machine, and writes
their files: rows (so that a stopped run can continue), a Markdown table, and pictures."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.head_model.model import HeadModel, load_model
from rig.atomic_write import write_atomically
from rig.errors import EigenheadError, InputError
from rig.formats.pictures.images import write_image
from rig.progress import Progress
from rig.render.renderer import Renderer
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.faults.drift import drift
from tests.laboratory.experiments.faults.exchanges import exchanges, false_alarms
from tests.laboratory.experiments.faults.planted import planted
from tests.laboratory.experiments.outcome import Outcome
from tests.laboratory.experiments.paper import detail, span, tables
from tests.laboratory.experiments.paper.alignment import alignment
from tests.laboratory.experiments.paper.convergence import convergence
from tests.laboratory.experiments.paper.cost import cost
from tests.laboratory.experiments.paper.levels import levels
from tests.laboratory.experiments.paper.limit import limit
from tests.laboratory.experiments.paper.posterior_check import posterior_check
from tests.laboratory.experiments.paper.robustness import robustness
from tests.laboratory.experiments.paper.views import views
from tests.laboratory.experiments.people.expressions import expressions
from tests.laboratory.experiments.people.gazes import gazes
from tests.laboratory.experiments.people.people import people
from tests.laboratory.experiments.shared_data import facekit, truths
from tests.laboratory.experiments.speed.farm import scale
from tests.laboratory.experiments.speed.growth import growth, sizes
from tests.laboratory.experiments.speed.scaling import JobCommand, scaling
from tests.laboratory.experiments.surface.capped import capped
from tests.laboratory.experiments.surface.eyeballs import eyeballs
from tests.laboratory.experiments.surface.hair_shells import hair_shells
from tests.laboratory.experiments.surface.hidden import hidden
from tests.laboratory.experiments.surface.inner_mouth import inner_mouths
from tests.laboratory.experiments.surface.light import light
from tests.laboratory.experiments.surface.meshes import meshes
from tests.laboratory.experiments.surface.pores import pores
from tests.laboratory.experiments.surface.relief import relief
from tests.laboratory.experiments.surface.repeat import repeat
from tests.laboratory.experiments.surface.shapes import shapes
from tests.laboratory.experiments.surface.surfaces import surfaces
from tests.laboratory.experiments.surface.templates import templates
from tests.laboratory.experiments.surface.texture import texture
from tests.laboratory.experiments.surface.visible import visible
from tests.laboratory.experiments.surface.wrapping import wrapping

SHORT_HAIR = ("draw-b", "beard-smile")  # of the shared captures


class UnknownExperiment(EigenheadError):
    """Reports a name that no experiment has."""

    def __init__(self, name: str) -> None:
        super().__init__(f"no experiment is called {name!r}; there are {', '.join(EXPERIMENTS)}")


class MissingPeers(EigenheadError):
    """Reports that a package of the group ``peers`` is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(f"{package} is not installed: run `uv sync --group peers`")


@dataclass(frozen=True, slots=True)
class Options:
    """Holds options that only some experiments take.

    Attributes:
        simplex: how many subjects of a table the simplex fits too.
        captures: whether the captures of the shared folder are used besides the studio's heads.
        openmvs: folder of the programs of OpenMVS.
        folders: captures, of people and relief; of scaling, those to run a job on; of meshes, results.
        only: which rows of people, growth, wrap and hair-shell to run.
        detail: level of detail of people.
        realism: names of ``rig.studio.sensor.realism``, of hidden and visible.
        job: command that scaling runs.
    """

    simplex: int | None = None
    captures: bool = False
    openmvs: Path | None = None
    folders: tuple[Path, ...] = ()
    only: tuple[str, ...] = ()
    detail: str | None = None
    realism: tuple[str, ...] = ()
    job: JobCommand | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Holds what a command asks an experiment to do."""

    head: HeadModel
    subjects: int | None
    shared: Path
    folder: Path | None
    report: Progress
    options: Options


NO_OPTIONS = Options()


def run_experiment(
    name: str,
    *,
    model: str,
    subjects: int | None,
    shared: Path,
    folder: Path | None,
    report: Progress,
    options: Options = NO_OPTIONS,
) -> Outcome:
    """Runs one experiment and returns its figures and rows. Rows are kept in ``folder``, so that a stopped run can
    continue; a table and pictures are written there. ``shared`` holds captures/ with their truths, and ict-facekit/.
    Raises UnknownExperiment, MissingPeers, InputError."""
    if name not in EXPERIMENTS:
        raise UnknownExperiment(name)
    found = EXPERIMENTS[name](Task(load_model(model), subjects, shared, folder, report, options))
    pictures = found.pop("pictures", {})
    text = found.pop("markdown", None) or markdown.of_figures(found["figures"])
    if folder is not None:
        write_atomically(folder / f"{name}.md", text.encode())
        for title, image in pictures.items():
            write_image(folder / f"{name}-{title}.png", image)
    return found


def _drawn(experiment: Callable[..., Outcome]) -> Callable[[Task], Outcome]:
    """An experiment that needs a renderer, the model and a number of subjects."""

    def run(task: Task) -> Outcome:
        count = {"subjects": task.subjects} if task.subjects else {}
        with Renderer.create() as renderer:
            return experiment(task.head, renderer=renderer, report=task.report, folder=task.folder, **count)

    return run


def _table(table: Callable[..., Outcome]) -> Callable[[Task], Outcome]:
    def run(task: Task) -> Outcome:
        requested = {"subjects": task.subjects, "simplex_subjects": task.options.simplex}
        count = {key: value for key, value in requested.items() if value is not None}
        with Renderer.create() as renderer:
            return table(task.head, renderer=renderer, report=task.report, folder=task.folder, **count)

    return run


def _peers(task: Task) -> Outcome:
    for package in ("cma", "pybobyqa", "jax"):
        if importlib.util.find_spec(package) is None:
            raise MissingPeers(package)
    from tests.laboratory.experiments.peers.peers import peers

    return _drawn(peers)(task)


def _limit(task: Task) -> Outcome:
    with Renderer.create() as renderer:
        return limit(task.head, renderer=renderer, report=task.report, subjects=task.subjects or 15)


def _span(task: Task) -> Outcome:
    other = facekit(task.shared)
    heads = [span.read_truth(path) for path in truths(task.shared).values()]
    heads += span.random_draws(other, task.subjects or 20)
    return span.run({"default": task.head, "ict": other}, heads, report=task.report)


def _detail(task: Task) -> Outcome:
    other = facekit(task.shared)
    captures = {name: path.with_suffix("") for name, path in truths(task.shared).items()}
    with Renderer.create() as renderer:
        return detail.run(
            {"default": task.head, "ict": other},
            captures,
            renderer=renderer,
            report=task.report,
            others=other,
            draws=task.subjects or 20,
            in_span=task.subjects or 10,
            folder=task.folder,
        )


def _expressions(task: Task) -> Outcome:
    models = {"default": task.head, "ict": facekit(task.shared)}
    for name, model in models.items():
        if not len(model.expressions):
            raise InputError(name, ["has no expressions: import it again, or name --shared"])
    count = {"subjects": task.subjects} if task.subjects else {}
    with Renderer.create() as renderer:
        return expressions(models, renderer=renderer, report=task.report, folder=task.folder, **count)


def _hidden(task: Task) -> Outcome:
    with Renderer.create() as renderer:
        return hidden(
            task.head,
            _captures(task),
            renderer=renderer,
            report=task.report,
            others=facekit(task.shared),
            subjects=task.subjects or 4,
            realism=task.options.realism,
            folder=task.folder,
        )


def _capped(task: Task) -> Outcome:
    count, others = {"subjects": task.subjects} if task.subjects else {}, facekit(task.shared)
    with Renderer.create() as renderer:
        return capped(task.head, renderer=renderer, report=task.report, others=others, folder=task.folder, **count)


def _visible(task: Task) -> Outcome:
    count = {"subjects": task.subjects} if task.subjects else {}
    with Renderer.create() as renderer:
        return visible(
            task.head, _captures(task), renderer=renderer, report=task.report, realism=task.options.realism,
            folder=task.folder, **count,
        )  # fmt: skip


def _texture(task: Task) -> Outcome:
    count = {"subjects": task.subjects} if task.subjects else {}
    with Renderer.create() as renderer:
        return texture(task.head, _captures(task), renderer=renderer, report=task.report, folder=task.folder, **count)


def _surfaces(task: Task) -> Outcome:
    found = {name: path.with_suffix("") for name, path in truths(task.shared).items()}
    with Renderer.create() as renderer:
        return surfaces(
            task.head, found, renderer=renderer, report=task.report, openmvs=task.options.openmvs, folder=task.folder
        )


def _people(task: Task) -> Outcome:
    shared = sorted((task.shared / "captures").glob("*.truth"))  # the studio has heads where there are none
    try:
        others = facekit(task.shared)
    except InputError:
        others = None
    with Renderer.create() as renderer:
        return people(
            task.head,
            others,
            list(task.options.folders) or [path.with_suffix("") for path in shared],
            renderer=renderer,
            report=task.report,
            subjects=task.subjects,
            only=task.options.only,
            detail=task.options.detail,
            folder=task.folder,
        )


def _relief(task: Task) -> Outcome:
    folders = list(task.options.folders) or [path.with_suffix("") for path in truths(task.shared).values()]
    named = {path.name: path for path in folders}
    with Renderer.create() as renderer:
        return relief(task.head, named, renderer=renderer, report=task.report, folder=task.folder)


def _scaling(task: Task) -> Outcome:
    if task.options.job is None:
        raise InputError("scaling", ["runs jobs of the command line, and there is none"])
    captures = list(task.options.folders) or [task.shared / "captures" / "scan-a"]
    missing = [str(path) for path in captures if not path.exists()]
    if missing:
        raise InputError(", ".join(missing), ["is not at hand: name captures, or --shared"])
    return scaling(captures, command=task.options.job, report=task.report, folder=task.folder)


def _growth(task: Task) -> Outcome:
    if task.options.job is None:
        raise InputError("growth", ["runs jobs of the command line, and there is none"])
    with Renderer.create() as renderer:
        return growth(
            task.head,
            sizes(task.options.only),
            command=task.options.job,
            renderer=renderer,
            report=task.report,
            folder=task.folder,
        )


def _scale(task: Task) -> Outcome:
    return scale()


def _templates(task: Task) -> Outcome:
    count = {"draws": task.subjects} if task.subjects else {}
    return templates({"default": task.head}, facekit(task.shared), report=task.report, folder=task.folder, **count)


def _shapes(task: Task) -> Outcome:
    return shapes(task.head, facekit(task.shared), report=task.report, folder=task.folder)


def _of_facekit(experiment: Callable[..., Outcome]) -> Callable[[Task], Outcome]:
    return lambda task: experiment(facekit(task.shared), report=task.report, folder=task.folder)


def _gazes(task: Task) -> Outcome:
    count = {"subjects": task.subjects} if task.subjects else {}
    models = {"default": task.head, "ict": facekit(task.shared)}
    with Renderer.create() as renderer:
        return gazes(models, renderer=renderer, report=task.report, folder=task.folder, **count)


def _wrap(task: Task) -> Outcome:
    only = task.options.only
    scans = {name: path for name, path in truths(task.shared).items() if not only or name in only}
    return wrapping(facekit(task.shared), scans, report=task.report, folder=task.folder)


def _hair_shell(task: Task) -> Outcome:
    chosen = task.options.only or SHORT_HAIR
    found = {name: path.with_suffix("") for name, path in truths(task.shared).items() if name in chosen}
    with Renderer.create() as renderer:
        return hair_shells(
            task.head, facekit(task.shared), found, renderer=renderer, report=task.report, folder=task.folder
        )


def _meshes(task: Task) -> Outcome:
    models = {"default": task.head, "ict": facekit(task.shared)}
    count = {"subjects": task.subjects} if task.subjects else {}
    return meshes(models, task.options.folders, report=task.report, folder=task.folder, **count)


def _captures(task: Task) -> dict[str, Path]:
    """The shared captures that have a truth, where they are asked for."""
    return {name: path.with_suffix("") for name, path in truths(task.shared).items()} if task.options.captures else {}


EXPERIMENTS: dict[str, Callable[[Task], Outcome]] = {
    "table1": _table(tables.table1),
    "table2": _table(tables.table2),
    "table3": _table(tables.table3),
    "cost": _drawn(cost),
    "levels": _drawn(levels),
    "peers": _peers,
    "limit": _limit,
    "robustness": _drawn(robustness),
    "convergence": _drawn(convergence),
    "alignment": _drawn(alignment),
    "drift": _drawn(drift),
    "exchanges": _drawn(exchanges),
    "false-alarms": _drawn(false_alarms),
    "posterior": _drawn(posterior_check),
    "views": _drawn(views),
    "repeat": _drawn(repeat),
    "relief": _relief,
    "pores": _drawn(pores),
    "span": _span,
    "detail": _detail,
    "hidden": _hidden,
    "capped": _capped,
    "expressions": _expressions,
    "people": _people,
    "planted": _drawn(planted),
    "visible": _visible,
    "surfaces": _surfaces,
    "texture": _texture,
    "light": _drawn(light),
    "templates": _templates,
    "shapes": _shapes,
    "eyeballs": _of_facekit(eyeballs),
    "gazes": _gazes,
    "inner-mouth": _of_facekit(inner_mouths),
    "wrap": _wrap,
    "hair-shell": _hair_shell,
    "meshes": _meshes,
    "scaling": _scaling,
    "growth": _growth,
    "scale": _scale,
}
