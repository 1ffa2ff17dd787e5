"""Implements the commands that make and judge heads: check, reconstruct, verify, simulate, demo."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from rig.studio.sensor.faults import KINDS
from server.cli.answers import (
    Data,
    Json,
    Overwrite,
    Overwrites,
    answer,
    chosen,
    completing,
    model_names,
    number,
    prepare_file,
    progress_bar,
    warn,
    wrong_usage,
)

if TYPE_CHECKING:
    from rig.studio.sensor.preset import Preset

app = typer.Typer(rich_markup_mode=None)


def of_setting(name: str) -> Callable[[], tuple[str, ...]]:
    """Returns a function that lists the allowed values of a setting of the pipeline, read from its type annotation."""

    def choices() -> tuple[str, ...]:
        from pipeline.settings import Settings

        options = get_type_hints(Settings)[name]
        return tuple(v for option in (options, *get_args(options)) for v in get_args(option) if isinstance(v, str))

    return choices


def of_output(name: str) -> Callable[[], tuple[str, ...]]:
    """Returns a function that lists the allowed values of a setting of the outputs, read from its type annotation."""

    def choices() -> tuple[str, ...]:
        from pipeline.settings import OutputSettings

        return get_args(get_type_hints(OutputSettings)[name])

    return choices


def _templates() -> tuple[str, ...]:
    from pipeline.templates.names import list_templates

    return tuple(list_templates())


def format_names(value: str | None) -> str | None:
    """Checks a list of file formats separated by commas and returns it without blanks. Raises typer.BadParameter for a
    name that is none of ``FORMATS``."""
    from pipeline.settings import FORMATS

    names = [] if value is None else [name.strip() for name in value.split(",")]
    strange = [name for name in names if name not in FORMATS]
    if strange:
        raise typer.BadParameter(f"{strange[0]!r} is none of {', '.join(FORMATS)}")
    return ",".join(names) or None


Formats = Annotated[
    str | None,
    typer.Option(
        help="Of the head: glb, ply (both by default), obj, usdz, stl, 3mf, with commas between.",
        callback=format_names,
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
    str | None,
    chosen(
        "What compares photographs: cpu, gl (OpenGL), or auto, the default: a GPU beside few cores.",
        of_setting("device"),
    ),
]
TemplateName = Annotated[
    str | None,
    typer.Option(
        help="Write head-NAME.obj too, in the vertex order of this template.",
        metavar="NAME",
        autocompletion=completing(_templates),
    ),
]


CapColour = Annotated[
    str | None, typer.Option(help="Of a worn swim or wig cap, about: #rrggbb, or a name as blue.", metavar="COLOUR")
]
HairNames = Annotated[
    str | None,
    typer.Option(
        help="NAME[,NAME]: short, over-ears, long, curly, fringe, bun, beard, bald, cap, swim-cap, wig-cap, glasses."
    ),
]
CapThickness = Annotated[float | None, number("How thick the cap is, mm; 1 by default.", min=0, max=10)]


@app.command(epilog="Example: eigenhead reconstruct shots/anna.tar.gz --out heads/anna --method contour")
def reconstruct(
    capture: Annotated[Path, typer.Argument(help="A capture folder, or a .zip, .tar or .tar.gz of one.", exists=True)],
    out: Annotated[Path, typer.Option(help="The result folder.", file_okay=False)],
    *,
    method: Annotated[str | None, chosen("contour (the default) or simplex.", of_setting("method"))] = None,
    model: Annotated[
        str | None,
        typer.Option(help="A model's name or file; makehuman-138 by default.", autocompletion=completing(model_names)),
    ] = None,
    front: Annotated[str | None, typer.Option(help="The camera that the subject faces; guessed by default.")] = None,
    detail: Annotated[
        str | None, chosen("span, kernel, photo, fine (the default) or pores.", of_setting("detail"))
    ] = None,
    surface: Annotated[str | None, chosen("head, bust, both (the default), or hair.", of_output("surface"))] = None,
    formats: Formats = None,
    delight: Annotated[
        bool, typer.Option("--delight", help="Also texture/albedo.png: the texture with its light taken off.")
    ] = False,
    cap: CapColour = None,
    cap_thickness: CapThickness = None,
    chart: Annotated[bool, typer.Option("--chart", help="True colours, by a ColorChecker in clean plates.")] = False,
    obj: Annotated[
        bool, typer.Option("--obj", hidden=True)
    ] = False,  # from earlier versions; a warning says what replaced it
    atlas: Annotated[bool, typer.Option("--atlas", hidden=True)] = False,
    normal_map: Annotated[
        bool, typer.Option("--normal-map", help="head.glb of few triangles, with a normal map of what they leave out.")
    ] = False,
    neutral: Annotated[bool, typer.Option("--neutral", help="Write neutral.glb too, without the expression.")] = False,
    morphs: Annotated[
        bool,
        typer.Option(
            "--morphs", help="Write posed.glb too, with morph targets by Apple's names; of a template head-NAME.glb."
        ),
    ] = False,
    slicer: Annotated[
        bool, typer.Option("--slicer", help="Write landmarks.mrk.json too, a point list for 3D Slicer.")
    ] = False,
    template: TemplateName = None,
    device: Device = None,
    settings: Annotated[Path | None, typer.Option(help="More settings, a TOML or JSON file.", exists=True)] = None,
    trace: Trace = None,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Reconstruct one capture without the service."""
    from server.cli.reconstruct_local import flame_lines, reconstruct_locally
    from server.tasks.settings_file import settings_document

    switches = {"obj": obj, "atlas": atlas, "delight": delight, "normal_map": normal_map}
    switches |= {"neutral": neutral, "morphs": morphs, "slicer": slicer}
    outputs: dict[str, object] = {name: True for name, is_requested in switches.items() if is_requested}
    words = {"surface": surface, "template": template, "formats": formats.split(",") if formats else None}
    outputs |= {name: word for name, word in words.items() if word}
    options = {"outputs": outputs or None, "texture": {"chart": True} if chart else None}
    worn = {"colour": cap, "thickness_mm": cap_thickness}
    options["cap"] = {name: value for name, value in worn.items() if value is not None} or None
    document = settings_document(settings, method=method, front=front, detail=detail, device=device, **options)
    with progress_bar() as report:
        written = reconstruct_locally(capture, out, model=model, settings=document, report=report, trace=trace)
    for warning in written["warnings"]:
        warn(f"{warning['code']}: {warning['message']}")
    names = ("contact_sheet.png", "head.ply", "bust.ply", f"head-{template}.obj")  # in the order of looking at them
    made = [out / name for name in names if (out / name).is_file()]
    answer(written, json_out, [*(str(path) for path in made), *flame_lines(written, out)])


@app.command(epilog="Example: eigenhead check shots/anna.tar.gz --json")
def check(
    capture: Annotated[Path, typer.Argument(help="A capture folder, or a .zip, .tar or .tar.gz of one.", exists=True)],
    settings: Annotated[Path | None, typer.Option(help="Of the job, a TOML or JSON file.", exists=True)] = None,
    chart: Annotated[bool, typer.Option("--chart", help="Look for the colour chart in the clean plates.")] = False,
    json_out: Json = False,
) -> None:
    """Say what is wrong with a capture, without a fit.

    Status 2 where it cannot be reconstructed; with warnings it can, and the status is 0."""
    from server.cli.check import checked, lines
    from server.tasks.settings_file import settings_document

    with progress_bar() as report:
        document = settings_document(settings, texture={"chart": True} if chart else None)
        found = checked(capture, document, report=report)
    answer(found, json_out, lines(found))
    if found["faults"]:
        raise typer.Exit(2)


@app.command(epilog="Example: eigenhead verify shots/m1 shots/m2 shots/m3 --reference mannequin.ply --out acceptance")
def verify(
    captures: Annotated[
        list[Path], typer.Argument(help="Captures of the mannequin, or folders of their results.", exists=True)
    ],
    reference: Annotated[
        Path, typer.Option(help="Its scan: .ply, .obj or .glb in mm, in any frame.", exists=True, dir_okay=False)
    ],
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
    json_out: Json = False,
) -> None:
    """Judge a rig by a mannequin of known shape.

    Status 1 where a limit is missed."""
    from server.cli.verify import LimitsMissed, lines, read_limits, verify_captures
    from server.tasks.settings_file import settings_document

    wanted, chosen = read_limits(limits), settings_document(settings)
    prepare_file(out / "report.json")
    with progress_bar() as report:
        found = verify_captures(
            captures, out, reference=reference, landmarks=landmarks, model=model, settings=chosen, limits=wanted,
            report=report,
        )  # fmt: skip
    answer(found, json_out, lines(found, out))
    if not found["passed"]:
        raise LimitsMissed(found, out)


@app.command(
    epilog="Example: eigenhead simulate shots/anna --seed 7 --fault bumped:cam03=0.5   "
    "eigenhead simulate studio --serve --port 8700"
)
def simulate(
    out: Annotated[
        Path | None,
        typer.Argument(help="The capture folder to write (--serve: the rig's); the truth goes to OUT.truth."),
    ] = None,
    *,
    subject: Annotated[str, typer.Option(help="random, mean, or a mesh file (head frame, mm).")] = "random",
    seed: Annotated[int, typer.Option(help="Of subject, looks, pose and noise.", min=0)] = 0,
    noise: Annotated[float | None, number("Sensor noise, share of full scale.", min=0, max=1)] = None,
    light_drift: Annotated[float | None, number("From plate to shot, share.", min=0, max=1)] = None,
    defocus: Annotated[float | None, number("Blur, pixels.", min=0)] = None,
    rolling_ms: Annotated[float | None, number("Readout of a rolling shutter.", min=0, max=200)] = None,
    hair: HairNames = None,
    realism: Annotated[
        str | None,
        typer.Option(help="NAME[,NAME] of what real photographs have: smooth, oily, scattering, mosaic, jpeg; or all."),
    ] = None,
    no_hair: Annotated[bool, typer.Option("--no-hair", help="Neither hair nor beard.")] = False,
    expression: Annotated[
        list[str] | None,
        typer.Option(help="NAME=WEIGHT, 0 to 1; may be repeated. `eigenhead model info` lists the names."),
    ] = None,
    fault: Annotated[
        list[str] | None, typer.Option(help=f"KIND[:CAMERA][=AMOUNT]; may be repeated. Kinds: {', '.join(KINDS)}.")
    ] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Keep the studio running as cameras and a trigger box, until Ctrl-C.")
    ] = False,
    port: Annotated[int, typer.Option(help="--serve: of the cameras; 0 takes a free one.", min=0, max=65535)] = 0,
    fps: Annotated[float, number("--serve: of the live views.", min=0.5, max=30)] = 4.0,
    overwrite: Overwrite = False,
    json_out: Json = False,
) -> None:
    """Take a capture with the simulated studio.

    The truth is written beside it.

    --serve opens eleven motion-JPEG cameras and a trigger box, and writes OUT/rig.toml (OUT is "studio" where none is
    given) with which the rig commands and the service work as with a real rig."""
    chosen = {"noise": noise, "light_drift": light_drift, "defocus_px": defocus, "rolling_ms": rolling_ms}
    preset = _studio_preset(realism, hair=not no_hair, hairstyle=tuple(hair.split(",")) if hair else (), **chosen)
    if serve:
        _serve_studio(out or Path("studio"), json_out, port=port, fps=fps, subject=subject, seed=seed, preset=preset,
                      faults=fault or [], expression=expression or [])  # fmt: skip
        return
    if out is None:
        raise typer.BadParameter("say where the capture goes, or --serve", param_hint="OUT")
    _check_planted(fault or [], expression or [])
    _make_way(out, overwrite)
    from rig.render.renderer import Renderer
    from server.tasks.subjects import simulate_folder

    with progress_bar() as report, Renderer.create() as renderer:
        report("simulate", 0.0)
        truth = simulate_folder(out, subject=subject, seed=seed, preset=preset, faults=fault or [], renderer=renderer,
                                expression=expression or [])  # fmt: skip
    answer({"capture": str(out), "truth": str(truth)}, json_out, [str(out), str(truth)])


def _studio_preset(realism: str | None, **chosen: Any) -> "Preset":
    """Returns the studio's preset with the chosen values. Raises typer.BadParameter for an unknown name in
    ``realism``."""
    from dataclasses import replace

    from rig.studio.sensor.preset import PRESET
    from rig.studio.sensor.realism import made_real, realism_names

    with wrong_usage("--realism"):
        return made_real(
            replace(PRESET, **{key: value for key, value in chosen.items() if value is not None}),
            realism_names(realism),
        )


def _check_planted(faults: list[str], expression: list[str]) -> None:
    """Raises typer.BadParameter for faults or expressions that are unknown."""
    from rig.studio.sensor.faults import fault_from_text

    with wrong_usage("--fault"):
        for text in faults:
            fault_from_text(text)
    if expression:
        from pipeline.head_model.expressions import weights_from_text
        from pipeline.head_model.model import load_model

        with wrong_usage("--expression"):
            weights_from_text(expression, load_model().expressions.names)


def _make_way(out: Path, overwrite: bool) -> None:
    """Removes an earlier simulated capture if ``overwrite`` is true. Raises Overwrites and CannotWrite."""
    there = out.exists() and (not out.is_dir() or any(out.iterdir()))
    if there and not (overwrite and (out / "cameras.json").is_file()):
        raise Overwrites(out)
    prepare_file(out)
    if there:
        shutil.rmtree(out)
        shutil.rmtree(out.with_name(out.name + ".truth"), ignore_errors=True)


def _serve_studio(folder: Path, json_out: bool, **options: Any) -> None:
    """Serves the simulated studio until Ctrl-C, which ends it with status 0."""
    from contextlib import ExitStack, suppress

    from server.cli.studio import OpenStudio, serve_studio

    with ExitStack() as bar, suppress(KeyboardInterrupt):
        report = bar.enter_context(progress_bar())

        def ready(studio: OpenStudio) -> None:
            bar.close()
            answer(studio.document(), json_out, studio.lines())
            sys.stdout.flush()

        serve_studio(folder, ready=ready, report=report, **options)


@app.command(epilog="Example: eigenhead demo --out out/demo")
def demo(
    out: Annotated[Path, typer.Option(help="Where the result goes.", file_okay=False)] = Path("out/demo"),
    seed: Annotated[int, typer.Option(help="Subject and noise of the simulated studio.", min=0)] = 1,
    full: Annotated[bool, typer.Option("--full", help="The default job, with the dense surface and the bust.")] = False,
    compare: Annotated[bool, typer.Option("--compare", help="Solve by the paper's simplex too: minutes more.")] = False,
    json_out: Json = False,
) -> None:
    """Run the main job end to end.

    Simulated rig, capture, service, head at level photo."""
    from server.cli.demo import run_demo

    with progress_bar() as report:
        done = run_demo(out, seed=seed, full=full, compare=compare, report=report)
    error = done["error_mm"]
    answer(
        done,
        json_out,
        [
            f"head           {done['ply']}",
            f"error          {error['median']:.2f} mm median, {error['mean']:.2f} mm mean, {error['max']:.2f} mm max",
            *(
                f"  {name:<12} {of['error_mm']['mean']:.2f} mm mean, {of['seconds']:.1f} s, {of['evaluations']} steps"
                for name, of in done["methods"].items()
            ),
            f"time           {done['seconds']:.1f} s",
            f"contact sheet  {done['contact_sheet']}",
        ],
    )
