"""Measures what tracking makes of a film: a subject of the studio that nods, turns, speaks and blinks, before eleven
cameras of 640 x 480 pixels, and one that sits still.

``error`` is the mean distance (mm) of the face's vertices from the true ones, aligned to nothing, over all frames;
``single_error`` that of single jobs at level photo of every tenth frame, ``same_error`` that of tracking in the same
frames. ``jitter`` is the RMS over still frames of a vertex's distance from its own mean, ``raw_jitter`` that before
smoothing. A blink is kept if the lids are shut by ``SHUT`` or more, and most within a frame of the truth. CPU seconds
are of this process, decoding included. The command is killed ``KILLS`` times while it tracks; its files must be the
bytes of a run that nobody killed.
"""

import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.moments.footage import TRACKED_PIXELS, Footage, open_footage
from pipeline.applications.moments.sequence import Course, smooth_course, track_sequence
from pipeline.applications.moments.sequence_files import CHUNKS, FILES
from pipeline.applications.moments.sequence_person import SequencePerson
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import start_reconstruction
from pipeline.settings import settings_from_document
from pipeline.stages.context import ReconstructionContext
from rig.formats.pictures.work_size import work_rig
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.sensor.preset import PRESET
from server.cli.heads import head_alone
from server.processes import python_command, python_environment
from server.tasks.moving_subject import Person, simulate_sequence
from server.tasks.settings_file import settings_document
from tests.laboratory.experiments.records import Bench, Outcome

SEED, STILL_FRAMES, EACH, KILLS = 3, 40, 10, 5
SHUT, NEAR = 0.4, 1  # weight; frames
PAGE = os.sysconf("SC_PAGE_SIZE")
SETTINGS = settings_from_document(head_alone(settings_document(None, detail="photo")))  # the command's own


def sequences(model: HeadModel, renderer: Renderer, bench: Bench, folder: Path, frames: int) -> Outcome:
    """Runs the leg ``--sequence``. Films and results are kept in ``folder``, by the number of frames: a run that was
    killed films on."""
    folder = folder / str(frames)
    for name, count in (("moving", frames), ("still", STILL_FRAMES)):
        film(folder / name, model, renderer, count, bench, still=name == "still")
    figures = moving_figures(folder, model, renderer, bench) | still_figures(folder, model, renderer, bench)
    figures |= killed_figures(folder, bench)
    return {"figures": {name: round(value, 4) for name, value in figures.items()}, "rows": []}


def film(folder: Path, model: HeadModel, renderer: Renderer, frames: int, bench: Bench, *, still: bool) -> None:
    """Films a person of the model's population."""
    coefficients = np.random.default_rng((SEED, 0)).standard_normal(len(model.modes))
    studio, person = work_rig(default_layout(), TRACKED_PIXELS), Person(model, coefficients, SEED)
    simulate_sequence(folder, person, studio, PRESET, frames, renderer=renderer, report=bench.report, still=still)


class Meter:
    """Measures CPU seconds and memory (MB) at every frame that tracking reports."""

    def __init__(self, bench: Bench) -> None:
        self._bench, self.seen = bench, dict[str, tuple[float, float]]()

    def __call__(self, stage: str, fraction: float) -> None:
        """Takes a stage and its share, as ``Progress``."""
        self._bench.report(stage, fraction)
        if stage.startswith("frame"):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.seen.setdefault(stage, (time.process_time(), pages * PAGE / 1e6))

    def figures(self) -> dict[str, float]:
        """Returns the CPU seconds a frame, and by how much memory grew from a fifth of the film to its end."""
        cpu, memory = np.array(list(self.seen.values())).T
        quarter = len(memory) // 5
        per_frame = float((cpu[-1] - cpu[0]) / (len(cpu) - 1))
        return {"cpu_s_a_frame": per_frame, "memory_mb": memory[-1], "memory_growth_mb": memory[-1] - memory[quarter]}


def moving_figures(folder: Path, model: HeadModel, renderer: Renderer, bench: Bench) -> dict[str, float]:
    """Returns the figures of the subject that moves."""
    footage, meter, kept = open_footage(folder / "moving"), Meter(bench), folder / "moving-track" / CHUNKS
    shutil.rmtree(kept, ignore_errors=True)
    begun = time.process_time()
    person, raw = track_sequence(footage, model, SETTINGS, kept, renderer=renderer, report=meter)
    assert raw is not None, "there are no other shares"
    whole, course = time.process_time() - begun, smooth_course(raw)
    with np.load(folder / "moving.truth" / "truth.npz") as arrays:
        truth = dict(arrays)
    found, before = (errors(person, each, truth["vertices"], truth["face"]) for each in (course, raw))
    sample = range(EACH // 2, len(course), EACH)
    singles = [single_error(footage, model, renderer, truth, number) for number in sample]
    blinks, kept_blinks = blinks_of(truth, person, course)
    return meter.figures() | {
        "frames": len(course),
        "identity_cpu_s": whole - meter.figures()["cpu_s_a_frame"] * len(course),
        "failed": float(course.failed.sum()),
        "error": float(found.mean()),
        "error_worst": float(found.max()),
        "raw_error": float(before.mean()),
        "drift": float(found[-len(found) // 5 :].mean() - found[: len(found) // 5].mean()),
        "single_error": float(np.mean(singles)),
        "same_error": float(found[list(sample)].mean()),
        "blinks": blinks,
        "blinks_kept": kept_blinks,
        "weights_correlation": correlation(truth, person, course),
    }


def errors(
    person: SequencePerson, course: Course, vertices: Float[np.ndarray, "t v 3"], face: Bool[np.ndarray, " v"]
) -> Float[np.ndarray, " t"]:
    """Returns the mean error of the face's vertices in every frame (mm)."""
    found = []
    for number in range(len(course)):
        motion = course.motion(number)
        off = motion.world_from_head.apply(person.head(motion.weights)) - vertices[number]
        found.append(np.linalg.norm(off[face], axis=1).mean())
    return np.array(found)


def single_error(footage: Footage, model: HeadModel, renderer: Renderer, truth: dict, number: int) -> float:
    """Returns the same error of a frame's single job at level photo."""
    with footage.capture(number) as (capture, rig):
        steps = start_reconstruction(ReconstructionContext(capture, rig, model, SETTINGS, renderer))
        head = next(steps).mesh_world.vertices
        steps.close()
    return float(np.linalg.norm(head - truth["vertices"][number], axis=1)[truth["face"]].mean())


def lids(names: list[str], weights: Float[np.ndarray, "t e"]) -> Float[np.ndarray, " t"]:
    """Returns the mean weight of both blinks in every frame."""
    return weights[:, [names.index("eyeBlinkLeft"), names.index("eyeBlinkRight")]].mean(axis=1)


def blinks_of(truth: dict, person: SequencePerson, course: Course) -> tuple[float, float]:
    """Returns how many blinks there are, whole ones, and how many of them are kept."""
    true, found = lids(list(truth["expressions"]), truth["weights"]), lids(list(person.names), course.weights)
    peaks = [k for k in range(3, len(true) - 3) if true[k] > SHUT and true[k] == true[k - 3 : k + 4].max()]
    kept = 0
    for peak in peaks:
        near = found[peak - 3 : peak + 4]
        kept += bool(near.max() >= SHUT and abs(int(near.argmax()) - 3) <= NEAR)
    return float(len(peaks)), float(kept)


def correlation(truth: dict, person: SequencePerson, course: Course) -> float:
    """Returns the correlation of all weights with the true ones."""
    rows = [list(truth["expressions"]).index(name) for name in person.names]
    return float(np.corrcoef(truth["weights"][:, rows].ravel(), course.weights.ravel())[0, 1])


def still_figures(folder: Path, model: HeadModel, renderer: Renderer, bench: Bench) -> dict[str, float]:
    """Returns the jitter of a head that sits still."""
    footage, kept = open_footage(folder / "still"), folder / "still-track" / CHUNKS
    person, raw = track_sequence(footage, model, SETTINGS, kept, renderer=renderer, report=bench.report)
    assert raw is not None, "there are no other shares"
    face = model.levels["full"].face_region
    return {"jitter": jitter(person, smooth_course(raw), face), "raw_jitter": jitter(person, raw, face)}


def jitter(person: SequencePerson, course: Course, face: Bool[np.ndarray, " v"]) -> float:
    """Returns the RMS distance (mm) of the face's vertices from their means over all frames."""
    motions = [course.motion(number) for number in range(len(course))]
    heads = np.stack([each.world_from_head.apply(person.head(each.weights))[face] for each in motions])
    return float(np.sqrt(((heads - heads.mean(axis=0)) ** 2).sum(axis=2).mean()))


def killed_figures(folder: Path, bench: Bench) -> dict[str, float]:
    """Runs the command to its end, and once more with kills in between, from the same identity."""
    kept, drawn = folder / "moving-track" / CHUNKS, random.Random(SEED)
    outs = [folder / "run", folder / "killed"]
    for out in outs:
        shutil.rmtree(out, ignore_errors=True)
        (out / CHUNKS).mkdir(parents=True)
    begun = time.monotonic()
    run(folder, outs[0], kept, None)
    whole_s, kills = time.monotonic() - begun, 0
    while kills < KILLS and not (outs[1] / "report.json").is_file():
        bench.report("kills", kills / KILLS)
        kills += run(folder, outs[1], outs[0] / CHUNKS, drawn.uniform(0.08, 0.2) * whole_s)
    run(folder, outs[1], outs[0] / CHUNKS, None)
    equal = [(outs[0] / name).read_bytes() == (outs[1] / name).read_bytes() for name in FILES]
    with np.load(outs[1] / "sequence.npz") as arrays:
        once = len(set(arrays["frames"].tolist())) == len(arrays["frames"]) == len(arrays["weights"])
    return {
        "kills": float(kills),
        "files_equal": float(sum(equal)),
        "files": float(len(FILES)),
        "every_once": float(once),
    }


def run(folder: Path, out: Path, kept: Path, after_s: float | None) -> bool:
    """Runs the command, and kills it after some seconds. Returns whether it was killed. It begins with the identity
    that is ``kept``."""
    for name in ("person.npz", "inputs.json"):
        if not (out / CHUNKS / name).is_file():
            shutil.copyfile(kept / name, out / CHUNKS / name)
    words = [*python_command("cli", "sequence"), str(folder / "moving"), "--out", str(out), "--json"]
    process = subprocess.Popen(words, env=python_environment(), stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        process.wait(after_s)
        assert process.returncode == 0, "the command failed"
        return False
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True
