"""Serves the simulated studio as devices: motion-JPEG streams on loopback and a trigger box on a pseudo-terminal.

The program's camera driver and trigger client use these devices as they use real ones. The caller provides an
``ImageSource`` of the empty studio and one with the seated subject. This module simulates a studio's lamps, cables,
triggers and their faults.
"""

import json
import threading
import time
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.pictures.images import encode_image
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.studio.devices.sources import ImageSource, SceneImages
from rig.studio.devices.streams import Film, StreamServer
from rig.studio.devices.trigger_box import LIGHTS, BoxLogic, Release, SimulatedTriggerBox
from rig.studio.scene.simulate import Scene
from rig.studio.sensor.faults import fault_parts

STUDIO = "simulated studio"  # the name in rig.toml
KINDS = {
    "dropped": "the next triggered frame of the camera gets lost",
    "late-trigger": "the output of the camera (no camera: every output) rises late (amount: seconds)",
    "frozen": "the camera sends the picture that it sent last over and over",
    "hung": "the camera keeps the connection and sends nothing",
    "swapped": "the cables of the camera and of the one after it are swapped",
    "bumped": "the camera was knocked (amount: pixels)",
    "lights-off": "the lamps stay dark whatever the box says",
    "dark": "the camera's picture is all but black (amount: what is left of the light)",
    "unplugged": "the cable of the trigger box is out",
}
DEFAULT_AMOUNT = {"late-trigger": 0.15, "bumped": 8.0, "dark": 0.01}
AMBIENT = 0.08  # of a picture's values, with the lamps off
_TAKES_LEAST = 2  # two that take turns are never alike
_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,  # subsampled colour would smear the silhouette by a pixel
]


@dataclass(frozen=True, slots=True)
class DeviceFault:
    """Holds a simulated fault of one of ``KINDS``. ``camera`` is None for the whole rig; ``amount`` is None for the
    usual amount of the kind."""

    kind: str
    camera: str | None = None
    amount: float | None = None

    @property
    def strength(self) -> float:
        """Returns the fault's amount, or the usual amount of its kind if ``amount`` is None."""
        return self.amount if self.amount is not None else DEFAULT_AMOUNT.get(self.kind, 0.0)


def device_fault_from_text(text: str) -> DeviceFault:
    """Reads a fault from ``kind[:camera][=amount]``. Raises InputError for another form or an unknown kind.
    ``StudioDevices.inject`` checks whether the fault's camera exists."""
    kind, camera, amount = fault_parts(text)
    if kind not in KINDS:
        raise InputError("fault", [compose("none-of", value=f"{kind!r}", known=KINDS)])
    return DeviceFault(kind, camera, amount)


@dataclass(frozen=True, slots=True)
class _Look:
    """Holds the state of lamps and faults that determines a camera's picture."""

    camera: str
    seated: bool
    light: float
    bump_px: float


class StudioDevices:
    """Runs camera streams and a trigger box during a ``with`` block. ``folder`` receives rig.toml and a link to the
    trigger box's port.

    ``takes`` is the number of pictures of the empty studio, with different noise, that the live view repeats. More
    clean plates than ``takes`` would be duplicates. ``close`` leaves no thread, port or link behind.
    """

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        empty: ImageSource,
        seated: ImageSource,
        *,
        fps: float = 4.0,
        takes: int = 5,
        host: str = "127.0.0.1",
        port: int = 0,
        calibration: str | None = None,
    ) -> None:
        self.folder = folder
        self.names = tuple(names)
        self.present = False
        self.faults: tuple[DeviceFault, ...] = ()
        self._sources = {False: empty, True: seated}
        self._takes = takes
        self._calibration = calibration
        self._lamps = 0
        self._films: dict[_Look, Film] = {}
        self._busy = threading.RLock()
        self.box: SimulatedTriggerBox | None = None
        self._started_s = time.monotonic()
        self.streams = StreamServer(names, self._answer, fps=fps, host=host, port=port)
        try:
            self._plug_in()
            self._refresh()
            self.write_rig()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "StudioDevices":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the streams and the trigger box. The call may be repeated."""
        if self.box is not None:
            self.box.close()
        self.streams.close()

    @property
    def port_link(self) -> Path:
        """Returns the path of the trigger box's port in rig.toml."""
        return self.folder.resolve() / "trigger-box"

    def seat(self, present: bool) -> None:
        """Adds the subject to all cameras' pictures, or removes it. Returns when all pictures show the change."""
        with self._busy:
            self.present = present
            self._refresh()

    def inject(self, fault: DeviceFault) -> None:
        """Adds a fault that lasts until a call of ``clear``. Raises InputError for an unknown kind or camera."""
        faults = []
        if fault.kind not in KINDS:
            strange = compose("none-of", value=f"{fault.kind!r}", known=KINDS)
            faults.append(compose("located", where="kind", fault=strange))
        needs_camera = fault.kind not in ("late-trigger", "lights-off", "unplugged")
        if fault.camera not in (*self.names, None) or (fault.camera is None and needs_camera):
            strange = compose("none-of", value=f"{fault.camera!r}", known=self.names)
            faults.append(compose("located", where="camera", fault=strange))
        if faults:
            raise InputError("fault", faults)
        with self._busy:
            self.faults = (*self.faults, fault)
            self._apply()

    def clear(self) -> None:
        """Ends all faults."""
        with self._busy:
            self.faults = ()
            self._apply()

    def write_rig(self) -> Path:
        """Writes rig.toml for this studio and returns its path."""
        text = [
            'format = "eigenhead-rig/1"',
            f"name = {json.dumps(STUDIO)}",
            *([] if self._calibration is None else [f"calibration = {json.dumps(self._calibration)}"]),
            f"\n[trigger]\nport = {json.dumps(str(self.port_link))}",
            "\n[lights]\noutputs = [0, 1]\nsettle_s = 0.3",
            # frames of a loopback wait for a processor, not for hardware; a late output (150 ms) is still told
            f"\n[shot]\nplates = {self._takes}\nplates_over_s = 0\nskew_most_ms = 120",
        ]
        for channel, name in enumerate(self.names):
            identity = json.dumps(self.streams.url(name))
            text.append(
                f'\n[[cameras]]\nname = "{name}"\ndriver = "opencv"\nidentity = {identity}\nchannel = {channel}'
            )
        path = self.folder / "rig.toml"
        write_atomically(path, ("\n".join(text) + "\n").encode())
        return path

    def _plug_in(self) -> None:
        self.box = SimulatedTriggerBox(self.port_link, BoxLogic(self._on_release, self._on_lights, self.streams.arm))

    def _apply(self) -> None:
        """Applies all current faults to the devices."""
        kinds = {(fault.kind, fault.camera) for fault in self.faults}
        views = {name: name for name in self.names}
        for kind, camera in kinds:
            if kind == "swapped" and camera is not None:
                other = self.names[(self.names.index(camera) + 1) % len(self.names)]
                views[camera], views[other] = views[other], views[camera]
        self.streams.connect(views)
        for name in self.names:
            frozen, hung, dropped = ((kind, name) in kinds for kind in ("frozen", "hung", "dropped"))
            self.streams.disturb(name, frozen=frozen, hung=hung, drop_next=dropped)
        unplugged = any(kind == "unplugged" for kind, _ in kinds)
        if unplugged and self.box is not None:
            self.box.close()
            self.box = None
            self._lamps = 0  # the box has its power from the same cable, and the lamps are switched by it
        elif not unplugged and self.box is None:
            self._plug_in()
        self._refresh()

    def _on_release(self, release: Release) -> None:
        late_s = {name: self._strength("late-trigger", name) for name in self.names}
        channels = {channel: name for channel, name in enumerate(self.names)}
        self.streams.release(
            {
                channels[channel]: release.time_s + delay_s + late_s[channels[channel]]
                for channel, delay_s in release.delays_s.items()
                if channel in channels
            }
        )

    def _on_lights(self, mask: int) -> None:
        self._lamps = mask
        for name in self.names:
            film = self._films.get(self._look(name))
            if film is not None:  # else a refresh is under way, which shows it at its end
                self.streams.show(name, film)

    def _strength(self, kind: str, camera: str) -> float:
        return max((f.strength for f in self.faults if f.kind == kind and f.camera in (camera, None)), default=0.0)

    def _look(self, camera: str, lamps: int | None = None) -> _Look:
        lit = (self._lamps if lamps is None else lamps) != 0 and not any(f.kind == "lights-off" for f in self.faults)
        dark = any(f.kind == "dark" and f.camera == camera for f in self.faults)
        light = (1.0 if lit else AMBIENT) * (self._strength("dark", camera) if dark else 1.0)
        return _Look(camera, self.present, light, self._strength("bumped", camera))

    def _refresh(self) -> None:
        """Encodes the current pictures of all cameras in advance, with the lamps on and off."""
        with ThreadPoolExecutor(2) as pool:
            films = [film for films in pool.map(self._films_of, self.names) for film in films.items()]
        # The empty studio comes back with every subject that leaves: its films are kept, theirs are not.
        self._films = {lighting: film for lighting, film in self._films.items() if not lighting.seated} | dict(films)
        for name in self.names:
            self.streams.show(name, self._films[self._look(name)])

    def _films_of(self, camera: str) -> dict[_Look, Film]:
        """Returns the encoded pictures of one camera with the lamps off and on."""
        lightings = [self._look(camera, lamps) for lamps in (0, (1 << LIGHTS) - 1)]
        if all(lighting in self._films for lighting in lightings):
            return {lighting: self._films[lighting] for lighting in lightings}
        live = _TAKES_LEAST if self.present else self._takes  # clean plates are taken of the empty studio alone
        now_s = time.monotonic() - self._started_s
        takes = [self._sources[self.present](camera, now_s + i) for i in range(live + _TAKES_LEAST)]
        films: dict[_Look, Film] = {}
        for lighting in lightings:
            rng = np.random.default_rng(zlib.crc32(repr(lighting).encode()))
            jpegs = tuple(_develop(take, lighting, rng) for take in takes)
            films[lighting] = Film(jpegs[:live], jpegs[live:])
        return films

    def _answer(self, method: str, path: str, query: Mapping[str, str]) -> tuple[int, str]:
        """Answers HTTP requests to the studio: GET /, POST /subject?present=1, POST and DELETE /faults."""
        try:
            if (method, path) == ("GET", "/"):
                return 200, self._page()
            if (method, path) == ("POST", "/subject"):
                self.seat(query.get("present", "1") not in ("0", "no", "false"))
                return 200, self._state()
            if (method, path) == ("POST", "/faults"):
                amount = query.get("amount")
                self.inject(
                    DeviceFault(query.get("kind", ""), query.get("camera"), None if amount is None else float(amount))
                )
                return 200, self._state()
            if (method, path) == ("DELETE", "/faults"):
                self.clear()
                return 200, self._state()
        except (InputError, ValueError) as error:
            return 422, f"{error}\n"
        return 404, f"no {method} {path} here; GET / shows what there is\n"

    def _state(self) -> str:
        seat = "subject seated" if self.present else "empty"
        faults = ", ".join(" ".join(filter(None, (f.kind, f.camera))) for f in self.faults) or "none"
        return f"{seat}; lights {self._lamps:04b}; faults: {faults}\n"

    def _page(self) -> str:
        views = "".join(
            f'<figure><img src="/{n}.mjpeg" width="300"><figcaption>{n}</figcaption></figure>' for n in self.names
        )
        kinds = "".join(f"<li><b>{kind}</b>: {what}</li>" for kind, what in KINDS.items())
        style = "figure{display:inline-block;margin:4px}body{font-family:sans-serif}"
        return (
            f"<!doctype html><title>simulated studio</title><style>{style}</style><p>{self._state()}</p>{views}"
            "<p>POST /subject?present=1|0<br>POST /faults?kind=KIND&amp;camera=NAME&amp;amount=N<br>DELETE /faults</p>"
            f"<ul>{kinds}</ul>"
        )


def serve_scene(
    folder: Path, scene: Scene, *, fps: float = 4.0, host: str = "127.0.0.1", port: int = 0
) -> StudioDevices:
    """Starts the devices of a rendered scene without the subject. ``folder`` receives rig.toml and cameras.json."""
    folder.mkdir(parents=True, exist_ok=True)
    write_rig(scene.rig, folder / "cameras.json")
    empty, seated = SceneImages(scene, seated=False, seed=1), SceneImages(scene, seated=True, seed=2)
    return StudioDevices(
        folder, scene.rig.names, empty, seated, fps=fps, host=host, port=port, calibration="cameras.json"
    )


def _develop(image: ImageRgb, lighting: _Look, rng: np.random.Generator) -> bytes:
    """Encodes ``image`` as JPEG, with the light and the camera's displacement of ``lighting``."""
    if lighting.bump_px:
        image = _bumped(image, lighting.bump_px)
    if lighting.light < 1:
        # the read noise of the sensor, one value, does not go with the light
        dim = image * np.float32(lighting.light) + rng.standard_normal(image.shape, np.float32)
        image = np.clip(np.round(dim), 0, 255).astype(np.uint8)
    return encode_image(".jpg", image, _JPEG)


def _bumped(image: ImageRgb, amount_px: float) -> ImageRgb:
    """Simulates a displaced camera. Shifts the picture by ``amount_px`` along (0.8, 0.6), and rotates it by a third of
    ``amount_px`` at its edge."""
    height, width = image.shape[:2]
    turn_deg = float(np.degrees(2 * amount_px / (3 * width)))
    warp = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), turn_deg, 1.0)
    warp[:, 2] += (0.8 * amount_px, 0.6 * amount_px)
    moved = cv2.warpAffine(image, warp, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(moved, np.uint8)
