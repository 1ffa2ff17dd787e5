"""Implements the commands about head models: model list, info, import, build, fetch, show, remove."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.head_model.model_names import PACK_FILES, list_models, models_folder, remove_model
from server.cli.answers import Data, Json, Overwrite, answer, prepare_file, progress_bar, switch, warn_of_replacement

model_app = typer.Typer(help="Head models.", no_args_is_help=True, rich_markup_mode=None)


@model_app.command("list", epilog="Example: eigenhead model list")
def model_list(data: Data = None, json_out: Json = False) -> None:
    """List the head models at hand."""
    models = {name: str(path) for name, path in list_models().items()}
    answer({"models": models}, json_out, [f"{name}  {path}" for name, path in models.items()])


@model_app.command("info", epilog="Example: eigenhead model info --json")
def model_info(
    name: Annotated[str, typer.Argument(help="A model's name or file.")] = "default",
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Say what a head model is made of."""
    from pipeline.head_model.model import load_model
    from pipeline.head_model.model import model_info as describe

    document = describe(load_model(name))
    answer(document, json_out, [f"{key:<18} {_as_text(value)}" for key, value in document.items() if key != "figures"])


def _as_text(value: object) -> str:
    """Returns a value of a model's description as text for people."""
    if isinstance(value, dict):
        return "; ".join(f"{key}: {_as_text(inner)}" for key, inner in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


@model_app.command("import", epilog="Example: eigenhead model import ICT-FaceKit --name ict")
def model_import(
    source: Annotated[Path, typer.Argument(help="ICT-FaceKit, statismo or Basel HDF5, or npz.", exists=True)],
    name: Annotated[str | None, typer.Option(help="What to call it.")] = None,
    data: Data = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Import a head model from another program.

    It is kept among the models under its name.
    """
    from pipeline.applications.model_building.sources.imports import import_model
    from pipeline.head_model.model_file import save_model

    if name is not None and (Path(name).name != name or name in PACK_FILES):
        raise typer.BadParameter(f"{name!r}: a name without folders that no shipped model has", param_hint="--name")
    with progress_bar() as report:
        parts = import_model(source, name=name, report=report)
    path = models_folder() / f"{parts.name}.npz"
    prepare_file(path, overwrite=overwrite, option="--name")
    save_model(path, parts)
    document = {"name": parts.name, "file": str(path), "draws_mm": parts.figures.get("draws_mm")}
    answer(document, json_out, [f"{parts.name}  {path}"])


@model_app.command("build", epilog="Example: eigenhead model build scans --out model.npz")
def model_build(
    scans: Annotated[
        Path, typer.Argument(help="A folder of PLY, OBJ or GLB scans and their landmarks, or of results.", exists=True)
    ],
    out: Annotated[Path, typer.Option(help="The file to write; --model takes it.", dir_okay=False)],
    *,
    name: Annotated[str | None, typer.Option(help="What to call it.")] = None,
    skip_bad: Annotated[bool, typer.Option(help="Leave out scans that cannot be used, instead of stopping.")] = False,
    from_results: Annotated[
        bool, switch("--from-results", "Update the model that made the heads of these results.")
    ] = False,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Build a head model from raw scans.

    Or from delivered heads: results of one model, a result a person, whose deviations say how far each counts."""
    warn_of_replacement(out, overwrite)
    prepare_file(out)
    from pipeline.applications.model_building.training.build import build_model
    from pipeline.applications.verification.delivered_heads import build_from_results

    with progress_bar() as report:
        if from_results:
            built = build_from_results(scans, out, name=name or out.stem, report=report)
        else:
            built = build_model(scans, out, name=name or out.stem, on_bad="skip" if skip_bad else "stop", report=report)
    document = {
        "file": str(out),
        "used": list(built.used),
        "repaired": {scan: list(words) for scan, words in built.repaired.items()},
        "skipped": dict(built.skipped),
    }
    scan_lines = [f"repaired {scan}: {'; '.join(words)}" for scan, words in built.repaired.items()]
    scan_lines += [f"left out {scan}: {why}" for scan, why in built.skipped.items()]
    if from_results:
        before, after = (built.parts.figures[key] for key in ("held_out_before_mm", "held_out_mm"))
        document["figures"] = dict(built.parts.figures)
        scan_lines.append(f"a face that it does not know is {after:.2f} mm from its modes, {before:.2f} before (mean)")
    answer(document, json_out, [*scan_lines, f"{out}  from {len(built.used)} {'results' if from_results else 'scans'}"])


@model_app.command("fetch", epilog="Example: eigenhead model fetch ict-facekit")
def model_fetch(
    name: Annotated[str, typer.Argument(help="ict-facekit.")],
    source: Annotated[str | None, typer.Option(help="Another address or folder to take it from.")] = None,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Download a published head model.

    Its licence is shown, and it is kept among the models.
    """
    from pipeline.applications.model_building.sources.fetch import fetch_model

    with progress_bar() as report:
        fetched = fetch_model(name, source=source, report=report)
    document = {"name": name, "file": str(fetched.path), "commit": fetched.commit, "licence": fetched.licence_text}
    answer(document, json_out, [fetched.licence_text, f"{name}  {fetched.path}"])


@model_app.command("show", epilog="Example: eigenhead model show default --out out/model")
def model_show(
    name: Annotated[str, typer.Argument(help="A model's name or file.")] = "default",
    out: Annotated[Path, typer.Option(help="Folder for the pictures.", file_okay=False)] = Path("out/model"),
    modes: Annotated[int, typer.Option(help="How many modes to draw.", min=1)] = 5,
    data: Data = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Draw a model's modes and a correspondence.

    And how compact, general and specific it is."""
    warn_of_replacement(out, overwrite)
    from pipeline.applications.model_building.training.figures import show_model
    from pipeline.head_model.model import load_model

    with progress_bar() as report:
        drawn = [str(path) for path in show_model(load_model(name), out, modes=modes, report=report)]
    answer({"pictures": drawn}, json_out, drawn)


@model_app.command("remove", epilog="Example: eigenhead model remove ict-facekit")
def model_remove(
    name: Annotated[str, typer.Argument(help="A model of the models folder.")],
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Remove a head model.

    One that was imported or fetched; the shipped one stays."""
    path = remove_model(name)
    answer({"name": name, "file": str(path)}, json_out, [f"removed {path}"])
