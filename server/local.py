"""``eigenhead reconstruct``: one capture without the service, in this process."""

import json
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rig.archive import extract_archive
from rig.errors import InputError
from server.stages import Course, Expectation

Report = Callable[[str, float], None]


def settings_document(path: Path | None, **given: str | dict[str, Any] | None) -> dict[str, Any]:
    """Settings from a TOML or JSON file, then from options; tables are merged. Raises InputError."""
    document: dict[str, Any] = {}
    if path is not None:
        try:
            text = path.read_text(encoding="utf-8")
            document = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
        except (OSError, ValueError) as error:
            raise InputError(path.name, [f"cannot be read ({error})"]) from error
        if not isinstance(document, dict):
            raise InputError(path.name, ["is no table of settings"])
    for name, value in given.items():
        old = document.get(name)
        if value is not None:
            document[name] = old | value if isinstance(old, dict) and isinstance(value, dict) else value
    return document


def reconstruct_locally(
    capture: Path, out: Path, *, model: str | None, settings: dict[str, Any], report: Report
) -> dict[str, Any]:
    """Reconstructs a capture folder or archive into ``out`` and returns report.json."""
    from pipeline.eigenheads.model import load_model
    from pipeline.outputs import write_result
    from pipeline.reconstruct import reconstruct
    from pipeline.settings import settings_from_document
    from rig.capture import read_capture
    from rig.render.renderer import Renderer

    chosen = settings_from_document(settings)
    course = Course(Expectation().of(chosen.method))

    def tell(stage: str, fraction: float) -> None:
        course.report(stage, fraction)
        report(stage, course.progress())

    tell("read", 0.0)
    head_model = load_model(model or "default")
    with folder_of(capture) as folder, Renderer.create() as renderer:
        shot, rig = read_capture(folder)
        done = reconstruct(shot, rig, head_model, chosen, renderer=renderer, report=tell)
        tell("write", 0.0)
        write_result(out, done, shot)
    return json.loads((out / "report.json").read_text(encoding="utf-8"))


@contextmanager
def folder_of(capture: Path) -> Iterator[Path]:
    """A capture folder, or what is in an archive of one for as long as it is needed. Raises InputError."""
    if capture.is_dir():
        yield capture
        return
    with tempfile.TemporaryDirectory() as scratch:
        extract_archive(capture, Path(scratch) / "capture")
        yield Path(scratch) / "capture"
