"""Implements the commands that make and judge heads: reconstruct, check, verify, demo."""

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from rig.errors import EigenheadError, InputError
from rig.progress import Progress
from server.cli.answers import (
    Anyway,
    Data,
    Json,
    Overwrite,
    Strict,
    answer,
    completing,
    file_in,
    model_names,
    number,
    prepare_file,
    progress_bar,
    switch,
    warn,
    warn_of_replacement,
)
from server.tasks.settings_file import settings_document

if TYPE_CHECKING:
    from pipeline.applications.verification.judgement import Limits
    from pipeline.applications.verification.report import VerificationReport

app = typer.Typer(rich_markup_mode=None)


def _templates() -> tuple[str, ...]:
    from pipeline.applications.templates.header import list_templates

    return tuple(list_templates())


def format_names(value: str | None) -> str | None:
    """Checks a list of file formats separated by commas and returns the list without spaces. Raises typer.BadParameter
    for a name that is none of ``FORMATS``."""
    from pipeline.settings import FORMATS

    names = [] if value is None else [name.strip() for name in value.split(",")]
    strange = [name for name in names if name not in FORMATS]
    if strange:
        raise typer.BadParameter(f"{strange[0]!r} is none of {', '.join(FORMATS)}")
    return ",".join(names) or None


Formats = Annotated[
    str | None,
    typer.Option(
        help="Of the head: glb, ply (both by default), obj, usdz, stl, 3mf, with commas between.", callback=format_names
    ),
]
Trace = Annotated[
    Path | None,
    typer.Option(
        help="Write there what ran on which thread when, for Perfetto or chrome://tracing.",
        metavar="FILE",
        dir_okay=False,
    ),
]

Device = Annotated[
    Literal["auto", "cpu", "gl"] | None,
    typer.Option(help="What compares photographs; auto takes a GPU beside few cores.", show_default="auto"),
]
Method = Annotated[
    Literal["contour", "simplex"] | None,
    typer.Option(
        help="contour is fast; simplex is the paper's downhill simplex, slower and coarser.", show_default="contour"
    ),
]
Detail = Annotated[
    Literal["span", "kernel", "photo", "fine", "pores"] | None,
    typer.Option(
        help="span is the model alone, kernel follows outlines (seconds); photo, fine, pores photographs (minutes).",
        show_default="fine",
    ),
]
Surface = Annotated[
    Literal["head", "bust", "both", "hair"] | None, typer.Option(help="What is written.", show_default="both")
]
TemplateName = Annotated[
    str | None,
    typer.Option(
        help="Write head-NAME.obj too, in the vertex order of this template.",
        metavar="NAME",
        autocompletion=completing(_templates),
    ),
]
Morphs = Annotated[
    bool, switch("--morphs", "Write posed.glb too, with morph targets by Apple's names; of a template head-NAME.glb.")
]
Albedo = Annotated[bool, switch("--albedo", "Also texture/albedo.png: the texture with its light taken off.")]
Model = Annotated[
    str | None,
    typer.Option(help="A model's name or file; makehuman-138 by default.", autocompletion=completing(model_names)),
]
Slicer = Annotated[bool, switch("--slicer", "Write landmarks.mrk.json too, a point list for 3D Slicer.")]
CapColour = Annotated[
    str | None, typer.Option(help="Of a worn swim or wig cap, about: #rrggbb, or a name as blue.", metavar="COLOUR")
]
CapThickness = Annotated[float | None, number("How thick the cap is, mm; 1 by default.", min=0, max=10)]


@app.command(epilog="Example: eigenhead reconstruct shots/anna.tar.gz --out heads/anna --method contour")
def reconstruct(
    capture: Annotated[Path, typer.Argument(help="A capture folder, or a .zip, .tar or .tar.gz of one.", exists=True)],
    out: Annotated[Path, typer.Option(help="The result folder.", file_okay=False)],
    *,
    method: Method = None,
    model: Model = None,
    front: Annotated[str | None, typer.Option(help="The camera that the subject faces; guessed by default.")] = None,
    anyway: Anyway = False,
    strict: Strict = False,
    detail: Detail = None,
    surface: Surface = None,
    formats: Formats = None,
    albedo: Albedo = False,
    cap: CapColour = None,
    cap_thickness: CapThickness = None,
    chart: Annotated[bool, switch("--chart", "True colours, by a ColorChecker in clean plates.")] = False,
    normal_map: Annotated[
        bool, switch("--normal-map", "head.glb of few triangles, with a normal map of what they leave out.")
    ] = False,
    neutral: Annotated[bool, switch("--neutral", "Write neutral.glb too, without the expression.")] = False,
    morphs: Morphs = False,
    slicer: Slicer = False,
    template: TemplateName = None,
    device: Device = None,
    settings: Annotated[Path | None, typer.Option(help="More settings, a TOML or JSON file.", exists=True)] = None,
    trace: Trace = None,
    data: Data = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Reconstruct one capture without the service."""
    from server.cli.reconstruct_local import flame_lines, reconstruct_locally

    requested = {"normal_map": normal_map, "neutral": neutral, "morphs": morphs, "slicer": slicer, "surface": surface}
    requested |= {"template": template, "formats": formats and formats.split(","), "albedo": "file" if albedo else None}
    outputs: dict[str, object] = {name: value for name, value in requested.items() if value}
    options: dict[str, bool | dict[str, object] | None] = {"outputs": outputs or None, "anyway": anyway or None}
    options["texture"] = {"chart": True} if chart else None
    worn = {"colour": cap, "thickness_mm": cap_thickness}
    options["cap"] = {name: value for name, value in worn.items() if value is not None} or None
    named = {"method": method, "front": front, "detail": detail, "device": device}
    document = settings_document(settings, strict=strict, **named, **options)
    warn_of_replacement(out / "report.json", overwrite)
    with progress_bar() as report:
        written = reconstruct_locally(capture, out, model=model, settings=document, report=report, trace=trace)
    warn(*(f"{warning['code']}: {warning['message']}" for warning in written["warnings"]))
    names = ("contact_sheet.png", "head.ply", "bust.ply", f"head-{template}.obj")  # in the order of looking at them
    files = [out / name for name in names if (out / name).is_file()]
    answer(written, json_out, [*(str(path) for path in files), *flame_lines(written, out)])


@app.command(epilog="Example: eigenhead check shots/anna.tar.gz --json")
def check(
    capture: Annotated[Path, typer.Argument(help="A capture folder, or a .zip, .tar or .tar.gz of one.", exists=True)],
    settings: Annotated[Path | None, typer.Option(help="Of the job, a TOML or JSON file.", exists=True)] = None,
    chart: Annotated[bool, switch("--chart", "Look for the colour chart in the clean plates.")] = False,
    strict: Strict = False,
    json_out: Json = False,
) -> None:
    """Say what is wrong with a capture, without a fit.

    Status 2 where it cannot be reconstructed; with warnings it can, and the status is 0."""
    from server.cli.check import checked, lines

    with progress_bar() as report:
        document = settings_document(settings, strict=strict, texture={"chart": True} if chart else None)
        checks = checked(capture, document, report=report)
    answer(checks, json_out, lines(checks))
    if checks["faults"]:
        raise typer.Exit(2)


@app.command(epilog="Example: eigenhead verify shots/m1 shots/m2 shots/m3 --reference mannequin.ply --out acceptance")
def verify(
    captures: Annotated[
        list[Path], typer.Argument(help="Captures of the mannequin, or folders of their results.", exists=True)
    ],
    reference: Annotated[Path, file_in("Its scan: .ply, .obj or .glb in mm, in any frame.")],
    out: Annotated[Path, typer.Option(help="Where report.json and certificate.pdf go.", file_okay=False)] = Path(
        "out/verify"
    ),
    *,
    landmarks: Annotated[
        Path | None, typer.Option(help="Of the scan, in its frame; by default the file beside it.", exists=True)
    ] = None,
    limits: Annotated[Path | None, typer.Option(help="Limits, a TOML or JSON file.", exists=True)] = None,
    model: Annotated[str | None, typer.Option(help="A model's name or file.")] = None,
    settings: Annotated[Path | None, typer.Option(help="Of the reconstructions, TOML or JSON.", exists=True)] = None,
    data: Data = None,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Judge a rig by a mannequin of known shape.

    Status 1 where a limit is missed."""

    wanted, chosen = read_limits(limits), settings_document(settings)
    warn_of_replacement(out / "report.json", overwrite)
    prepare_file(out / "report.json")
    with progress_bar() as report:
        verification = verify_captures(
            captures, out, reference=reference, landmarks=landmarks, model=model, settings=chosen, limits=wanted,
            report=report,
        )  # fmt: skip
    answer(verification, json_out, verification_lines(verification, out))
    if not verification["passed"]:
        missed = [
            f"{name} is {figure['value']:.3g}, the limit is {figure['limit']:g}"
            for name, figure in verification["checks"].items()
            if figure["passed"] is False and figure["value"] is not None
        ]
        raise EigenheadError(f"not passed: {'; '.join(missed)} ({out / 'certificate.pdf'} says where)")


@app.command(epilog="Example: eigenhead demo --out out/demo")
def demo(
    out: Annotated[Path, typer.Option(help="Where the result goes.", file_okay=False)] = Path("out/demo"),
    seed: Annotated[int, typer.Option(help="Subject and noise of the simulated studio.", min=0)] = 1,
    full: Annotated[bool, switch("--full", "The default job, with the dense surface and the bust.")] = False,
    json_out: Json = False,
) -> None:
    """Run the main job end to end.

    Simulated rig, capture, service, head at level photo."""
    from server.cli.demo import run_demo

    with progress_bar() as report:
        done = run_demo(out, seed=seed, full=full, report=report)
    error = done["error_mm"]
    lines = [
        f"head           {done['ply']}",
        f"error          {error['median']:.2f} mm median, {error['mean']:.2f} mm mean, {error['max']:.2f} mm max",
        f"time           {done['seconds']:.1f} s",
        f"contact sheet  {done['contact_sheet']}",
    ]
    answer(done, json_out, lines)


def verify_captures(
    captures: Sequence[Path],
    out: Path,
    *,
    reference: Path,
    landmarks: Path | None,
    model: str | None,
    settings: Mapping[str, object],
    limits: "Limits",
    report: Progress,
) -> "VerificationReport":
    """Judges captures of a mannequin, or their results, by comparison with the scan ``reference``. Writes report.json
    and certificate.pdf into ``out``, and results of captures into ``out/results``.

    The scan is checked before any capture is reconstructed. Raises InputError, for example if results were made with
    different head models, and the pipeline's errors.
    """
    from pipeline.applications.verification.judgement import judge
    from pipeline.applications.verification.measured import identity_of, is_result, read_measured
    from pipeline.applications.verification.reference import read_reference
    from pipeline.applications.verification.report import Occasion
    from pipeline.applications.verification.write import write_verification
    from pipeline.head_model.model import load_model
    from server.cli.reconstruct_local import reconstruct_locally

    names = capture_names(captures)
    scan = read_reference(reference, landmarks)
    folders: list[Path] = []
    for i, (capture, name) in enumerate(zip(captures, names, strict=True)):
        folder = capture
        if not is_result(capture):
            folder = out / "results" / name

            def report_one(stage: str, fraction: float, i: int = i) -> None:
                report(f"{names[i]}: {stage}", (i + fraction) / len(captures))

            report_one("read", 0.0)
            reconstruct_locally(capture, folder, model=model, settings=head_alone(settings), report=report_one)
        folders.append(folder)
    report("judge", 1.0)
    identities = {name: identity_of(folder) for name, folder in zip(names, folders, strict=True)}
    identity = identities[names[0]]
    others = [name for name, of in identities.items() if of != identity]
    if others:
        raise InputError("captures", [f"{name} was made with another model than {names[0]}" for name in others])
    chosen = load_model(model or identity.model)
    measured = [read_measured(folder, chosen, name) for folder, name in zip(folders, names, strict=True)]
    judgement = judge(measured, scan, limits)
    occasion = Occasion(date.today().isoformat(), identity, limits)
    return write_verification(out, measured[0], scan, judgement, occasion)


def read_limits(path: Path | None) -> "Limits":
    """Reads limits from a TOML or JSON file. Limits that the file omits, or all limits if ``path`` is None, have their
    default values. Raises InputError."""
    from pipeline.applications.verification.judgement import Limits
    from rig.typed_tables import read_table

    return read_table(Limits, settings_document(path), path.name if path else "limits")


def verification_lines(document: "VerificationReport", out: Path) -> list[str]:
    """Returns lines for people: each figure beside its limit, then the paths of report and certificate."""
    verdicts = {None: "not judged", True: "met", False: "missed"}
    visits = [
        f"{name:<20} {'-' if check['value'] is None else format(check['value'], '.4g'):>8}   "
        f"limit {check['limit']:<6g} {verdicts[check['passed']]}"
        for name, check in document["checks"].items()
    ]
    return [*visits, str(out / "report.json"), str(out / "certificate.pdf")]


def capture_names(captures: Sequence[Path]) -> list[str]:
    """Returns the captures' names. Raises InputError if two captures have the same name."""
    names = [path.resolve().name.removesuffix(".gz").removesuffix(".tar").removesuffix(".zip") for path in captures]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError("captures", [f"more than one is called {name}: rename one" for name in twice])
    return names


def head_alone(settings: Mapping[str, object]) -> dict[str, object]:
    """Returns the settings with the bust switched off, because a verification needs only the head, which saves ten
    seconds for each capture."""
    outputs = settings.get("outputs")
    return {**settings, "outputs": {"surface": "head", **(outputs if isinstance(outputs, Mapping) else {})}}
