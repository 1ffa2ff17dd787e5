"""Implements ``eigenhead simulate --serve``: serves the simulated studio as network cameras and a trigger box."""

import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.head_model.model import load_model
from rig.acquisition.commands import take_plates
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.rig_toml import read_rig_config
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.studio.devices.folder import write_truth
from rig.studio.devices.serve import STUDIO, StudioDevices, device_fault_from_text, serve_scene
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, build_scene
from rig.studio.sensor.preset import Preset
from server.tasks.subjects import SubjectChoice


def describe_studio(devices: StudioDevices, truth: Path) -> dict[str, Any]:
    """Returns the JSON object that ``simulate --serve --json`` prints: addresses of running devices, and files.
    ``truth`` is the folder with the subject's true head."""
    link = devices.port_link
    return {
        "url": devices.streams.address,
        "cameras": {name: devices.streams.url(name) for name in devices.names},
        "trigger": {"port": str(link), "terminal": str(link.readlink())},
        "rig": str(devices.folder / "rig.toml"),
        "truth": str(truth),
    }


def studio_lines(studio: Mapping[str, Any]) -> list[str]:
    """Returns lines for people: the devices of the studio, and commands to try on these devices."""
    url, rig, first = studio["url"], studio["rig"], next(iter(studio["cameras"]))
    return [
        "The simulated studio is open; Ctrl-C closes it.",
        "",
        f"  page         {url}/",
        f"  cameras      {len(studio['cameras'])}, {studio['cameras'][first]} and so on",
        f"  trigger box  {studio['trigger']['port']} ({studio['trigger']['terminal']})",
        f"  rig.toml     {rig}",
        f"  truth        {studio['truth']}",
        "",
        "Clean plates are taken and the subject is seated. In another terminal:",
        "",
        f"  eigenhead rig check --rig {rig}",
        f"  eigenhead rig capture --rig {rig} --out shots/one",
        "  eigenhead reconstruct shots/one --out heads/one",
        f"  eigenhead serve --rig {rig}",
        f"  curl -X POST '{url}/subject?present=0'",
        f"  curl -X POST '{url}/faults?kind=bumped&camera={first}'",
        f"  curl -X DELETE {url}/faults",
    ]


def serve_studio(
    folder: Path,
    *,
    subject: SubjectChoice,
    seed: int,
    preset: Preset,
    faults: Sequence[str],
    fps: float,
    port: int,
    ready: Callable[[dict[str, Any]], None],
    report: Progress,
) -> None:
    """Serves the subject that ``eigenhead simulate`` draws for the same ``seed``, until SIGINT or SIGTERM.

    Writes rig.toml, cameras.json and clean plates into ``folder``, and the true head into ``<folder>.truth``. ``ready``
    is called with ``describe_studio`` once all devices can be used. When the function returns, no thread, port or
    pseudo-terminal is left. Raises InputError for a folder of another rig, an unknown fault, or a port in use.
    """
    planted = [device_fault_from_text(text) for text in faults]
    _check_folder(folder)
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell's background jobs are started with SIGINT ignored
        signal.signal(number, signal.default_int_handler)
    rng = np.random.default_rng(seed)
    report("draw", 0.0)
    with Renderer.create() as renderer:
        chosen = subject.drawn(load_model(), seed, rng)
        scene = build_scene(chosen, default_layout(), preset, rng.spawn(1)[0], renderer=renderer)
    truth = folder.with_name(folder.name + ".truth")
    write_truth(truth, SimulatedCapture(Capture({}), scene.rig, scene, ()), seed=seed)
    report("devices", 0.5)
    with serve_scene(folder, scene, fps=fps, port=port) as devices:
        report("clean plates", 0.7)
        take_plates(read_rig_config(folder / "rig.toml"))
        report("subject", 0.8)
        devices.seat(True)
        for fault in planted:
            devices.inject(fault)
        report("ready", 1.0)
        ready(describe_studio(devices, truth))
        threading.Event().wait()


def _check_folder(folder: Path) -> None:
    """Raises InputError if the folder holds a rig.toml that no simulated studio has written."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    rig = folder / "rig.toml"
    if not rig.is_file() or read_rig_config(rig).name != STUDIO:
        raise InputError(str(folder), ["is there already and holds no simulated studio; name a folder that is not"])
