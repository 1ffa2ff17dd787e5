"""Measures the live head: a served studio of eleven cameras (motion JPEG, 1024 x 768), a service with a worker that
reconstructs all the time, and a client that takes the events of ``GET /v1/rig/live``. The studio's streams cost this
machine a fifth of a core, too, which real cameras do not.

``age`` is from before the cameras were asked until the head was ready, so it holds the wait for the next frame (a
quarter of a second at 4 frames a second). ``named`` is from the moment when the streams show a mistake until an answer
names it. ``false_words`` counts different words in ``GOOD_S`` seconds of a subject that makes no mistake.
"""

import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import httpx
import numpy as np
from jaxtyping import Float

from pipeline.head_model.model import HeadModel
from rig.acquisition.commands import take_plates
from rig.capture import ImageRgb
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.rig_toml import read_rig_config
from rig.geometry import Similarity, rotation_from_vector
from rig.render.renderer import Renderer
from rig.studio.devices.serve import StudioDevices
from rig.studio.devices.streams import Film as Stream
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import View, view_light
from rig.studio.sensor.preset import PRESET
from rig.studio.sensor.sensor import drift, expose
from server.settings import RECONSTRUCT
from server.tasks.moving_subject import JOINT_MM, Film, Person, Pose, of_model
from tests.laboratory.experiments.records import Bench, Outcome
from tests.support.services import served_client

SEED = 3
GOOD_S, NAMED_MOST_S = 60.0, 10.0
TURN_DEG, FAR_MM, DEFOCUS_PX, DIM = 25.0, 160.0, 4.0, 0.45
SHUT = {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}
Light = dict[str, Float[np.ndarray, "h w 3"]]
Streams = Mapping[str, Stream]


@dataclass
class Watch:
    """Holds every look, and when it came (s, ``time.monotonic``)."""

    client: httpx.Client
    answers: list[tuple[float, dict]] = field(default_factory=list)
    done: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Takes the events until ``done``."""
        with self.client.stream("GET", "/v1/rig/live?seconds=3600", headers={"Accept": "text/event-stream"}) as events:
            for line in events.iter_lines():
                if line.startswith("data: "):
                    self.answers.append((time.monotonic(), json.loads(line.removeprefix("data: "))))
                if self.done.is_set():
                    return

    def since(self, start_s: float) -> list[tuple[float, dict]]:
        """Returns the answers that came after a moment."""
        return [each for each in self.answers if each[0] >= start_s]

    def until(self, fits: Callable[[dict], bool], most_s: float) -> float:
        """Waits for an answer that fits, and returns the seconds until it came; ``most_s`` if none does."""
        begun = time.monotonic()
        while time.monotonic() - begun < most_s:
            for came, answer in self.since(begun):
                if fits(answer):
                    return came - begun
            time.sleep(0.02)
        return most_s


class Stage:
    """Draws a person of the model in the studio, in any pose."""

    def __init__(self, model: HeadModel, renderer: Renderer) -> None:
        coefficients = np.random.default_rng((SEED, 0)).standard_normal(len(model.modes))
        self.rig, self.model = default_layout(), model
        self._film, self.views = Film(Person(model, coefficients, SEED), self.rig, PRESET, renderer), dict[str, View]()

    def light(self, turn_deg: float = 0.0, away_mm: float = 0.0, weights: Mapping[str, float] | None = None) -> Light:
        """Returns what each camera sees of the person, turned to its left and moved away from the front camera."""
        turn, joint = rotation_from_vector(np.radians([0.0, turn_deg, 0.0])), np.array(JOINT_MM)
        placed = Similarity(1.0, turn, joint - turn @ joint - np.array([0.0, 0.0, away_mm]))
        self.views = self._film.light(Pose(of_model(self.model, weights or {}), placed))
        lights = {}
        for k, (name, view) in enumerate(self.views.items()):
            light = view_light(view)
            lights[name] = light * drift(light.shape[:2], PRESET.light_drift, np.random.default_rng((SEED, k)))
        return lights

    def stream(self, camera: str, light: Float[np.ndarray, "h w 3"], share: float = 1.0) -> Stream:
        """Returns a camera's stream of a light, of which a share is left: four takes with their own noise."""
        rng = np.random.default_rng()
        takes = [self.jpeg(expose(light * np.float32(share), self.views[camera].sensor, rng)) for _ in range(4)]
        return Stream(tuple(takes[:2]), tuple(takes[2:]))

    @staticmethod
    def jpeg(image: ImageRgb) -> bytes:
        """Returns the JPEG file of a picture."""
        return cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def mistakes(stage: Stage, good: Light) -> dict[str, tuple[Streams, str, str | None]]:
    """Returns six planted mistakes: the streams that show each, the code of its word, and its camera."""
    whole = {
        "turned": (stage.light(turn_deg=TURN_DEG), "live-turn-right"),
        "far": (stage.light(away_mm=FAR_MM), "live-closer"),
        "shut": (stage.light(weights=SHUT), "live-eyes-shut"),
    }
    planted: dict[str, tuple[Streams, str, str | None]] = {
        name: ({camera: stage.stream(camera, light) for camera, light in lights.items()}, code, None)
        for name, (lights, code) in whole.items()
    }
    soft = cv2.GaussianBlur(good["cam03"], (0, 0), DEFOCUS_PX)
    planted["dark"] = ({"cam06": stage.stream("cam06", good["cam06"], DIM)}, "live-darker", "cam06")
    planted["soft"] = ({"cam03": stage.stream("cam03", soft)}, "live-soft", "cam03")
    planted["covered"] = ({"cam04": stage.stream("cam04", good["cam04"], 0.005)}, "live-black", "cam04")
    return planted


def live(model: HeadModel, renderer: Renderer, bench: Bench, folder: Path) -> Outcome:
    """Runs the leg ``--live``."""
    bench.report("draw", 0.0)
    stage = Stage(model, renderer)
    good = stage.light()
    planted = mistakes(stage, good)
    rng, views = np.random.default_rng(SEED), stage.views
    fine = {name: stage.stream(name, light) for name, light in good.items()}

    def empty(camera: str, time_s: float) -> ImageRgb:
        return expose(view_light(views[camera], subject=False), views[camera].sensor, rng)

    def seated(camera: str, time_s: float) -> ImageRgb:
        return expose(good[camera], views[camera].sensor, rng)

    write_rig(stage.rig, folder / "studio" / "cameras.json")
    with StudioDevices(folder / "studio", stage.rig.names, empty, seated, calibration="cameras.json") as studio:
        take_plates(read_rig_config(folder / "studio" / "rig.toml"))
        studio.seat(True)
        rig_file = str(studio.folder / "rig.toml")
        with served_client(folder / "data", rig=rig_file, work=RECONSTRUCT) as (service, client):
            return {"figures": measured(client, service.url, studio, fine, planted, bench), "rows": []}


def measured(
    client: httpx.Client,
    url: str,
    studio: StudioDevices,
    fine: Streams,
    planted: Mapping[str, tuple[Streams, str, str | None]],
    bench: Bench,
) -> dict[str, float]:
    """Returns the figures of a service that is running, while jobs run."""
    capture = client.post("/v1/captures", json={"label": "live"}).raise_for_status().json()["id"]
    jobs = Jobs(url, capture)
    with httpx.Client(base_url=url, timeout=20) as asking:
        watch = Watch(asking)
        threads = [threading.Thread(target=each.run, daemon=True) for each in (jobs, watch)]
        for thread in threads:
            thread.start()
        figures = {"first_head_s": watch.until(lambda answer: answer["head"] is not None, 60.0)}
        time.sleep(5.0)
        bench.report("good subject", 0.2)
        begun = time.monotonic()
        time.sleep(GOOD_S)
        figures |= of_good(watch.since(begun))
        for done, (name, (streams, code, camera)) in enumerate(planted.items()):
            bench.report(name, 0.5 + 0.08 * done)
            show(studio, streams)
            figures[f"named_{name}_s"] = watch.until(partial(says, code, camera), NAMED_MOST_S)
            show(studio, fine)
            figures[f"over_{name}_s"] = watch.until(lambda answer: not answer["words"], NAMED_MOST_S)
            time.sleep(2.0)
        for each in (jobs, watch):
            each.done.set()
        for thread in threads:
            thread.join(60.0)
    return {**{name: round(value, 3) for name, value in figures.items()}, "jobs_done": float(jobs.ended)}


def show(studio: StudioDevices, streams: Streams) -> None:
    """Has cameras show other streams at once."""
    for name, stream in streams.items():
        studio.streams.show(name, stream)


def says(code: str, camera: str | None, answer: dict) -> bool:
    """Tells whether an answer has a word."""
    return any((word["code"], word["camera"]) == (code, camera) for word in answer["words"])


def of_good(answers: list[tuple[float, dict]]) -> dict[str, float]:
    """Returns the figures of a subject without mistakes."""
    with_head = [answer for _, answer in answers if answer["head"] is not None]
    ages = np.array([answer["age_s"] for answer in with_head])
    spans = np.diff([came for came, _ in answers])
    words = {(word["code"], word["camera"]) for _, answer in answers for word in answer["words"]}
    return {
        "heads_a_second": len(with_head) / (answers[-1][0] - answers[0][0]),
        "longest_gap_s": float(spans.max()),
        "age_median_s": float(np.median(ages)),
        "age_95_s": float(np.quantile(ages, 0.95)),
        "steady_share": float(np.mean([answer["steady"] for answer in with_head])),
        "false_words": float(len(words)),
    }


@dataclass
class Jobs:
    """Reconstructs a capture again and again."""

    url: str
    capture: str
    ended: int = 0
    done: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Queues one job after the other until ``done``."""
        with httpx.Client(base_url=self.url, timeout=60) as client:
            while not self.done.is_set():
                job = client.post("/v1/jobs", json={"capture_id": self.capture}).raise_for_status().json()["id"]
                while client.get(f"/v1/jobs/{job}").json()["state"] in ("queued", "running"):
                    if self.done.wait(0.5):
                        client.post(f"/v1/jobs/{job}/cancel")
                        return
                self.ended += 1
