"""Runs the cases of ``../shared/reports`` through check, upload, reconstruct and batch, and judges what each answers.

A case's make.py makes the inputs alone: its calls of ``check``, ``upload`` and ``reconstruct`` collect folders, which
all doors see; other commands run as they stand. An answer is right if it has the words of ``WANTED``; where none are
wanted, if it is a success, and a head within ``NEAR_MM`` of a known truth.
"""

import contextlib
import io
import json
import os
import re
import runpy
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence, Set
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import numpy as np

from rig.files import write_atomically
from rig.formats.meshes.mesh_file import read_mesh
from rig.studio.devices.folder import simulate_to_folder
from tests.laboratory.experiments.markdown import table
from tests.support.services import free_port

NEAR_MM = 8.0  # heads of the span level lie within 3 mm; heads of wrong poses or scales are off by more than 20
Answer = tuple[bool, str]  # whether it succeeded (with a head at its place), and its words
DOORS = ("check", "upload", "reconstruct", "batch")
COMMAND = Path(sys.executable).with_name("eigenhead")
SCALED = "known length|times as (large|small)|as large as|looks? like|cameras show|size of a head|too (large|small)"
WANTED = {  # by CASE/INPUT, the longest that fits; any of these words; no words: read, and right
    "01-free-scale/x": SCALED, "01-free-scale/x1": "", "01-free-scale/x5": SCALED,
    "31-far-origin": "km from the world's origin", "05-four-to-seven-cameras": "", "08-inverted-masks": "invert",
    "14-metashape-labels/slaves": "slave", "13-legacy-charuco/ratio-0.6": "times as wide as the squares",
    "19-machine-vision-pictures/mosaic": "mosaic", "19-machine-vision-pictures/twelve-bits": "12 bits",
    "23-unread-cameras-uploaded/camchain-yaml": "Kalibr", "23-unread-cameras-uploaded/calibration-json": "calib.io",
    "23-unread-cameras-uploaded/cameras-opk": "phi, kappa", "23-unread-cameras-uploaded/blocks-xml": "ContextCapture",
    "26-one-camera-upside-down": "turned by 180 degrees", "28-compressed-glb": "Draco|quantised",
    "32-conventions/world-to-camera": "inverse", "32-conventions/opencv-axes": "negate",
    "32-conventions/centimetres": "centimetres", "32-conventions/quaternion-w-last": "real part",
}  # fmt: skip


def reports(
    cases: Sequence[str] = (),
    *,
    scratch: Path,
    out: Annotated[Path | None, "keeps the answers: the inputs that are there are not asked again"] = None,
    place: Annotated[Path, "the case folders"] = Path("../shared/reports"),
    base: Annotated[Path | None, "keeps the capture that all cases start from"] = None,
    doors: Annotated[Sequence[str], "these doors alone"] = DOORS,
    inputs: Annotated[str, "inputs alone whose name has this pattern"] = "",
    program: Annotated[Path, "the program, perhaps another checkout's"] = COMMAND,
) -> dict[str, Any]:
    """Returns the table of all inputs and doors, and how many answers are wrong."""
    os.environ |= {"EIGENHEAD": str(program.absolute()), "BASE": str((base or scratch / "base").resolve())}
    os.environ |= {"CLONE": ".", "EIGENHEAD_DATA": str(scratch / "data")}
    found = sorted(path for path in place.iterdir() if (path / "make.py").is_file())
    kept = (out or scratch) / "answers.json"
    rows: list[list[str]] = json.loads(kept.read_text()) if kept.is_file() else []
    with _service(scratch) if "upload" in doors else contextlib.nullcontext("") as url:
        for case in (path for path in found if path.name.startswith(tuple(cases or [""]))):
            for name, answers in _answers(case, scratch / case.name, doors, url, inputs, {row[0] for row in rows}):
                judged = {door: _judged(answer, name) for door, answer in answers.items()}
                said = next((answers[d][1] for d, j in judged.items() if j == "wrong"), next(iter(answers.values()))[1])
                said = " ".join(said.replace(str(scratch), "").split())
                rows.append([name, *(judged.get(door, "-") for door in (*DOORS, "other")), f"{said:.150}"])
                sys.stderr.write(" | ".join(rows[-1]) + "\n")
                write_atomically(kept, json.dumps(rows, indent=1).encode())
    lines = table(("input", *DOORS, "other", "said"), rows).splitlines()
    wrong = sum(row.count("wrong") for row in rows)
    return {"lines": [*lines, f"{wrong} answers of {len(rows)} inputs are wrong"], "figures": {"wrong": wrong}}


def _judged(answer: Answer, name: str) -> str:
    done, said = answer
    wanted = next((WANTED[known] for known in sorted(WANTED, key=len, reverse=True) if name.startswith(known)), "")
    if wanted:
        return ("right, told" if done else "refused") if re.search(wanted, said, re.IGNORECASE) else "wrong"
    return "right" if done else "wrong"


def _answers(
    case: Path, out: Path, doors: Sequence[str], url: str, inputs: str, known: Set[str]
) -> Iterator[tuple[str, dict[str, Answer]]]:
    folders, others = _made(case, out)
    for (command, name), answer in others.items():
        if re.search(inputs, name) and (called := f"{case.name}/{name} ({command})") not in known:
            yield called, {"other": answer}
    chosen = {f"{case.name}/{name}": path for name, path in folders.items() if re.search(inputs, name)}
    chosen = {name: path for name, path in chosen.items() if name not in known}
    batch = _batch(chosen, out) if "batch" in doors and chosen else {}
    for name, (folder, truth) in chosen.items():
        answers = {"check": _command("check", folder)} if "check" in doors else {}
        answers |= {"upload": _uploaded(folder, url)} if "upload" in doors else {}
        answers |= {"reconstruct": _reconstructed(folder, truth)} if "reconstruct" in doors else {}
        yield name, answers | ({"batch": batch[name]} if "batch" in doors else {})


def _made(case: Path, out: Path) -> tuple[dict[str, tuple[Path, Path | None]], dict[tuple[str, str], Answer]]:
    """Runs a make.py. Returns its capture folders with their truths, and the answers of other commands."""
    sys.path.insert(0, str(case.parent))
    import common  # type: ignore[import-not-found]

    common.BASE = Path(os.environ["BASE"])
    common.CAP, common.TRUTH = common.BASE / "cap", common.BASE / "cap.truth"
    real, folders, others = common.eigenhead, {}, {}

    def noted(folder: Path, *_: object, truth: Path | None = common.TRUTH) -> None:
        folders.setdefault(Path(folder).name, (Path(folder), truth))

    def run(*words: object) -> Any:
        done = real(*words)
        if words[0] != "simulate" and Path(str(words[1])) != common.CAP / "cameras.json":
            name = Path(str(words[1])).relative_to(out).as_posix()
            others[str(words[0]), name] = done.returncode == 0, f"{done.stderr} {done.stdout}".strip()
        return done

    def simulated(folder: Path, *of: Any, features: bool = True, **named: Any) -> Path:
        truth = simulate_to_folder(folder, *of, **named)
        if not features:
            (folder / "features.json").unlink()
        return truth

    said, changed = io.StringIO(), {"check": noted, "upload": noted, "reconstruct": noted, "eigenhead": run}
    with (
        mock.patch.multiple(common, **changed),
        mock.patch("rig.studio.devices.folder.simulate_to_folder", simulated),  # which the cases call
        mock.patch.object(sys, "argv", [str(case / "make.py"), str(out)]),
        contextlib.redirect_stdout(said),
        contextlib.suppress(FileNotFoundError),  # of results that no door made yet
    ):
        runpy.run_path(str(case / "make.py"), run_name="__main__")
    for line in said.getvalue().splitlines() if not folders and not others else ():
        others["read", line.split()[0]] = "refused" not in line, line
    return folders, others


def _command(*words: object) -> Answer:
    command = [os.environ["EIGENHEAD"], *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode == 0, f"{done.stdout} {done.stderr}".strip()


def _reconstructed(folder: Path, truth: Path | None) -> Answer:
    out = Path(f"{folder}.out")
    done, said = _command("reconstruct", folder, "--out", out, "--detail", "span", "--surface", "head")
    return done and (truth is None or _distance_mm(out, truth) < NEAR_MM), said


def _distance_mm(result: Path, truth: Path) -> float:
    """Returns how far apart the middles of a head and of the true one are."""
    middles = [read_mesh(path / "head.ply").vertices.mean(axis=0) for path in (result, truth)]
    return float(np.linalg.norm(middles[0] - middles[1]))


def _batch(chosen: dict[str, tuple[Path, Path | None]], out: Path) -> dict[str, Answer]:
    """Runs one batch of all folders."""
    listed, results = out / "batch.csv", out / "batch"
    rows = [f"{folder.resolve()},{name.replace('/', '_')}\n" for name, (folder, _) in chosen.items()]
    listed.write_text("".join(["capture,name\n", *rows]))
    _command("batch", listed, "--out", results, "--detail", "span", "--surface", "head", "--workers", "1")
    answers, table_of = {}, [line for file in results.glob("heads.csv") for line in file.read_text().splitlines()]
    for name, (_, truth) in chosen.items():
        result = results / name.replace("/", "_")
        if (result / "report.json").is_file():
            warnings = json.loads((result / "report.json").read_text())["warnings"]
            whole = truth is None or _distance_mm(result, truth) < NEAR_MM
            answers[name] = whole, "; ".join(warning["message"] for warning in warnings)
        else:
            answers[name] = False, next((line for line in table_of if result.name in line), "")
    return answers


@contextlib.contextmanager
def _service(scratch: Path) -> Iterator[str]:
    """Yields the address of a service without a worker: uploads are checked by it."""
    port = free_port()
    words = [os.environ["EIGENHEAD"], "serve", "--no-worker", "--data", str(scratch / "service"), "--port", str(port)]
    with (scratch / "service.log").open("w") as log:
        process = subprocess.Popen(words, stdout=log, stderr=log)
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(120):
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{url}/healthz"):
                break
            time.sleep(1)
        yield url
    finally:
        process.terminate()
        process.wait()


def _uploaded(folder: Path, url: str) -> Answer:
    import common  # type: ignore[import-not-found]

    packed = folder if folder.is_file() else common.zipped(folder)
    said = json.loads(subprocess.check_output(["curl", "-sS", "-F", f"file=@{packed}", f"{url}/v1/captures/uploads"]))
    messages = [*said.get("errors", []), *(warning["message"] for warning in said.get("warnings", []))]
    return "id" in said, "; ".join(map(str, messages))
