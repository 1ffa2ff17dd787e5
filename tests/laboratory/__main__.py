"""Implements ``eigenhead experiments``: repeats the paper's experiments and runs those of this project."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.errors import EigenheadError
from rig.messages.message import compose
from server.cli.answers import Json, answer, chosen, progress_bar, wrong_usage
from server.processes import python_command, python_environment

if TYPE_CHECKING:
    from tests.laboratory.experiments.speed.scaling import JobCommand

app = typer.Typer(rich_markup_mode=None)


def _detail_levels() -> tuple[str, ...]:
    return "span", "kernel", "photo", "fine"


Only = Annotated[
    list[str] | None,
    typer.Option(
        help="people: rows of this rig (front-3, circle-24), evidence (plates, masks, neither) or subject alone; "
        "or eyes. growth: views or pixels alone. wrap, hair-shell: this capture alone. May be repeated."
    ),
]
Realism = Annotated[str | None, typer.Option(help="hidden, visible: simulate's --realism, beside none.")]


@app.command(epilog="Example: eigenhead experiments limit --subjects 3 --json")
def experiments(
    name: Annotated[
        str,
        typer.Argument(
            help="table1, table2, table3, cost, levels, peers, limit, robustness, convergence, alignment, drift, "
            "exchanges, false-alarms, posterior, views, repeat, relief, pores, span, detail, hidden, capped, "
            "expressions, visible, people, planted, surfaces, texture, light, templates, shapes, eyeballs, gazes, "
            "inner-mouth, meshes, wrap, hair-shell, scaling, growth, scale or real."
        ),
    ],
    *,
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            help="real: captures, or photographs alone, of more views than are used. people: captures with a truth "
            "beside them, relief: any captures; those of --shared by default. scaling: captures, scan-a by default. "
            "meshes: results with a head.ply."
        ),
    ] = None,
    model: Annotated[str, typer.Option(help="A model's name or file.")] = "default",
    subjects: Annotated[int | None, typer.Option(help="How many, instead of the experiment's own.", min=1)] = None,
    simplex: Annotated[int | None, typer.Option(help="table1 to table3: how many the simplex fits too.", min=0)] = None,
    captures: Annotated[bool, typer.Option(help="hidden, visible, texture: the captures of --shared, too.")] = False,
    openmvs: Annotated[Path | None, typer.Option(help="surfaces: the folder of that peer's programs.")] = None,
    only: Only = None,
    detail: Annotated[str | None, chosen("people: span, kernel, photo or fine (the default).", _detail_levels)] = None,
    realism: Realism = None,
    front: Annotated[str | None, typer.Option(help="real: the view that the subject faces.")] = None,
    outlines: Annotated[
        Path | None, typer.Option(help="real: outlines drawn by hand, outlines.json.", exists=True, dir_okay=False)
    ] = None,
    shared: Annotated[Path, typer.Option(help="Where captures/ and ict-facekit/ are.")] = Path("../shared/data"),
    out: Annotated[
        Path | None, typer.Option(help="Keeps rows there, so that a stopped run goes on; and the table and pictures.")
    ] = None,
    json_out: Json = False,
) -> None:
    """Repeat the paper's experiments, and ours. Needs a checkout: a wheel does not carry them."""
    check_research()
    if name == "real":
        _experiment_real(folders or [], model, front, outlines, out, json_out)
        return
    _check_options(name, folders, only, detail, realism)
    skin = _realism_names(realism)
    from tests.laboratory.experiments.runner import Options, run_experiment

    options = Options(simplex, captures, openmvs, tuple(folders or ()), tuple(only or ()), detail, skin, _job_command())
    with progress_bar() as report:
        found = run_experiment(
            name, model=model, subjects=subjects, shared=shared, folder=out, report=report, options=options
        )
    lines = found.pop("lines", None)
    answer(found, json_out, lines or [f"{key:<40} {value:.6g}" for key, value in found["figures"].items()])


def _check_options(
    name: str, folders: list[Path] | None, only: list[str] | None, detail: str | None, realism: str | None
) -> None:
    if folders and name not in ("people", "relief", "scaling", "meshes"):
        raise typer.BadParameter("only real, people, relief, scaling and meshes take folders", param_hint="FOLDERS")
    if only and name not in ("people", "growth", "wrap", "hair-shell"):
        raise typer.BadParameter("only people, growth, wrap and hair-shell take it", param_hint="--only")
    if detail and name != "people":
        raise typer.BadParameter("only people takes it", param_hint="--detail")
    if realism and name not in ("hidden", "visible"):
        raise typer.BadParameter("only hidden and visible take it", param_hint="--realism")


def _realism_names(text: str | None) -> tuple[str, ...]:
    """Returns the names in ``--realism``. Raises typer.BadParameter for an unknown one."""
    from rig.studio.sensor.preset import PRESET
    from rig.studio.sensor.realism import made_real, realism_names

    names = realism_names(text)
    with wrong_usage("--realism"):
        made_real(PRESET, names)
    return names


def check_research() -> None:
    """Raises EigenheadError in an installed wheel, which does not contain the research code."""
    try:
        from pipeline import research  # noqa: F401
    except ImportError:
        raise EigenheadError(compose("research-not-carried")) from None


def _job_command() -> "JobCommand":
    from tests.laboratory.experiments.speed.scaling import JobCommand

    return JobCommand(python_command("cli", "reconstruct"), python_environment())


def _experiment_real(
    folders: list[Path], model: str, front: str | None, outlines: Path | None, out: Path | None, json_out: bool
) -> None:
    from tests.laboratory.experiments.judge_real import judge_folders

    missing = [str(folder) for folder in folders if not folder.is_dir()]
    if missing or not folders:
        fault = f"{', '.join(missing)}: no such folder" if missing else "name the folders of the photographs"
        raise typer.BadParameter(fault, param_hint="FOLDERS")
    with progress_bar() as report:
        found = judge_folders(folders, model=model, front=front, outlines=outlines, kept=out, report=report)
    answer(found, json_out, [f"{key:<40} {value:.6g}" for key, value in found["figures"].items()])
