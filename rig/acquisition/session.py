"""Runs a session with a rig: opens its cameras, lamps and trigger box; takes pictures, shots and clean plates.

    with RigSession(config) as session:
        session.warm_up()
        shot = session.shoot()

Every wait has a deadline, and no camera delays another, because each camera has its own thread (rig.drivers.feed). A
failing device is a fault of the shot; an exception (ShotFailed, InputError) means that there is no shot at all.
"""

import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rig.acquisition.judgement import PlatesRefused, examine, find_occupied, judge, plate_faults, size_faults
from rig.acquisition.plates import Plates, keep_plates, read_plates, use_plates, write_plates
from rig.acquisition.shot import Fault, Shot, ShotFailed, Timing, certify
from rig.acquisition.trigger import RigTrigger
from rig.drivers.base import Driver, DriverError, Frame, driver_for
from rig.drivers.feed import CameraFeed, FeedState
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.rig_toml import CameraConfig, RigConfig
from rig.image import ImageRgb
from rig.messages.message import Message, compose
from rig.rig import Rig

MakeDriver = Callable[[CameraConfig, Path], Driver]

_LIVE_WAIT_PERIODS = 3.0  # frame periods that a free-running camera may take for its next frame
_CLOSE_S = 3.0
_SILENT_S = 10.0  # so long nobody waits for a camera that gave no live picture
_DIAGNOSIS_S = 1.0  # wait for pictures if the trigger failed: they may still show why


@dataclass(frozen=True, slots=True)
class _Release:
    time_s: float
    uncertainty_s: float
    fired: bool
    faults: tuple[Fault, ...] = ()


class RigSession:
    """Owns the devices of a rig while a block runs. ``close`` ends all threads except those that a driver blocks."""

    def __init__(self, config: RigConfig, make_driver: MakeDriver = driver_for) -> None:
        self.config = config
        self.rig: Rig | None = None if config.calibration_file is None else read_rig(config.calibration_file)
        self.plates: Plates = read_plates(config.plates_folder, config.names)
        self._feeds: dict[str, CameraFeed] = {}
        self._broken: dict[str, Message] = {}
        self._trigger = RigTrigger(config)
        self._last_seen: dict[str, Frame] = {}  # to recognise a frozen stream
        self._silent_until_s: dict[str, float] = {}
        self._busy = threading.Lock()
        for camera in config.cameras:
            try:
                self._feeds[camera.name] = CameraFeed(
                    camera, make_driver(camera, config.folder), config.shot.open_timeout_s
                )
            except DriverError as error:
                self._broken[camera.name] = error.message

    def __enter__(self) -> "RigSession":
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Opens the cameras and the trigger box at once. A camera that cannot be opened is a fault of each shot."""
        for feed in self._feeds.values():
            feed.start()
        self._trigger.open()
        deadline_s = time.monotonic() + self.config.shot.open_timeout_s
        for feed in self._feeds.values():
            feed.wait_opened(deadline_s)

    def close(self) -> tuple[str, ...]:
        """Switches the lamps off and closes all devices. Returns the cameras whose driver hangs. Safe to call twice."""
        self._trigger.close()
        deadline_s = time.monotonic() + _CLOSE_S
        for feed in self._feeds.values():
            feed.stop()
        hanging = tuple(name for name, feed in self._feeds.items() if not feed.close(deadline_s))
        self._feeds = {}
        return hanging

    def states(self) -> Mapping[str, FeedState]:
        """Returns the current state of each camera that has a driver, by name."""
        return {name: feed.state() for name, feed in self._feeds.items()}

    def trigger_error(self) -> Message | None:
        """Returns why the trigger box cannot be used; None if it can be used, or if rig.toml names no trigger box."""
        return None if self._trigger.error is None else self._trigger.error.message

    def _trigger_faults(self) -> tuple[Fault, ...]:
        error = self.trigger_error()
        return () if error is None else (Fault("trigger", None, error),)

    def warm_up(self) -> None:
        """Switches the lamps on and lets every camera's first frames pass, while exposure and lamps settle."""
        with self._busy:
            self._trigger.switch_lamps_on()
            deadline_s = time.monotonic() + self.config.shot.timeout_s
            for feed in self._feeds.values():
                # a camera that waits for triggers sends nothing by itself, so it is not waited for
                feed.wait_frames(self.config.shot.warm_up_frames, deadline_s)
            self._next_frames(deadline_s + self.config.shot.timeout_s)

    def look(self, only: Collection[str] | None = None) -> Mapping[str, ImageRgb]:
        """Returns a current picture of each camera that delivers one, without synchronisation. ``only`` names the
        cameras to take pictures with; None means all cameras."""
        with self._busy:
            self._trigger.switch_lamps_on()
            frames = self._next_frames(time.monotonic() + 2 * self.config.shot.timeout_s, only)
            return {name: frame.image for name, frame in frames.items()}

    def shoot(self) -> Shot:
        """Takes one synchronised shot. A failing device raises no exception: the shot's faults say what is wrong."""
        with self._busy:
            self._trigger.switch_lamps_on()
            self._glance()
            release = self._release()
            frames = self._collect(release)
            shot = self._judge(release, frames)
            self._last_seen |= {name: frame for name, frame in frames.items() if frame is not None}
            return shot

    def take_plates(self) -> Plates:
        """Takes clean plates of the empty studio and starts to use them. Raises ShotFailed, or PlatesRefused if the new
        plates show a person whom the old plates do not show; the old plates then stay in use."""
        with self._busy:
            self._trigger.switch_lamps_on()
            self._silent_until_s.clear()
            taken: dict[str, list[ImageRgb]] = {name: [] for name in self.config.names}
            pause_s = self.config.shot.plates_over_s / max(self.config.shot.plates - 1, 1)
            for number in range(self.config.shot.plates):
                time.sleep(pause_s if number else 0.0)
                frames = self._next_frames(time.monotonic() + 2 * self.config.shot.timeout_s)
                for name, frame in frames.items():
                    taken[name].append(frame.image)
            faults = [*self._trigger_faults(), *self._plate_faults(taken)]
            if faults:
                raise ShotFailed(faults)
            images = {name: tuple(images) for name, images in taken.items()}
            if somebody := find_occupied(images, self.plates):
                version = keep_plates(self.config.plates_folder, images, tuple(fault.measured() for fault in somebody))
                raise PlatesRefused(somebody, version)
            self.plates = write_plates(self.config.plates_folder, images)
            return self.plates

    def use_plates(self, version: str) -> Plates:
        """Starts to use a stored version of the clean plates. Raises InputError for an unknown version."""
        with self._busy:
            self.plates = use_plates(self.config.plates_folder, version, self.config.names)
            return self.plates

    def _glance(self) -> None:
        """Stores each camera's picture before the release; if the shot shows the same picture, the stream is frozen."""
        now_s = time.monotonic()
        running = {name: s.period_s for name, feed in self._feeds.items() if (s := feed.state()).period_s is not None}
        for name in running:
            self._feeds[name].want(now_s)
            self._feeds[name].due(now_s)
        for name, period_s in running.items():
            assert period_s is not None
            limit_s = min(_LIVE_WAIT_PERIODS * period_s, self.config.shot.timeout_s)
            frame = self._feeds[name].collect(now_s, now_s + limit_s)
            if frame is not None:
                self._last_seen[name] = frame

    def _next_frames(self, deadline_s: float, only: Collection[str] | None = None) -> dict[str, Frame]:
        """Returns the next frame of every camera. Cameras that wait for a trigger and have no live view get a trigger.

        After a camera has sent no frame, the method does not wait for this camera for ``_SILENT_S`` seconds, but uses a
        frame that arrives."""
        now_s = time.monotonic()
        feeds = {name: feed for name, feed in self._feeds.items() if only is None or name in only}
        for feed in feeds.values():
            feed.want(now_s)
            feed.due(now_s)
            feed.trigger()
        awaited = [name for name in feeds if self._silent_until_s.get(name, 0.0) <= now_s]
        early_s = now_s + (deadline_s - now_s) / 4
        missing = [n for n in awaited if feeds[n].collect(now_s, early_s) is None and feeds[n].state().opened]
        if any(feeds[name].camera.trigger == "external" for name in missing) and self._trigger.fire() is not None:
            for name in missing:
                feeds[name].collect(now_s, deadline_s)
        frames = {name: feed.collect(now_s, 0.0) for name, feed in feeds.items()}
        for feed in feeds.values():
            feed.unwant()
        received = {name: frame for name, frame in frames.items() if frame is not None}
        silent = {name: time.monotonic() + _SILENT_S for name in awaited if name not in received}
        self._silent_until_s = {n: s for n, s in self._silent_until_s.items() if n not in received} | silent
        self._last_seen |= received
        return received

    def _release(self) -> _Release:
        """Releases the cameras and returns when: the trigger box's time or, without a box, the time of the command."""
        now_s = time.monotonic()
        for feed in self._feeds.values():
            feed.want(now_s)
        if self.config.trigger is not None:
            fired = self._trigger.fire()
            if fired is None:
                return _Release(time.monotonic(), 0.0, False, self._trigger_faults())
            for feed in self._feeds.values():
                if feed.camera.trigger == "software":
                    feed.trigger()
            late_s = fired.time_s - fired.asked_s - fired.uncertainty_s
            faults: tuple[Fault, ...] = ()
            if late_s > self.config.shot.skew_most_ms / 1000:
                faults = (Fault("late-trigger", None, compose("box-late", late_ms=late_s * 1000)),)
            return _Release(fired.time_s, fired.uncertainty_s, True, faults)
        for feed in self._feeds.values():
            feed.trigger()
        return _Release(now_s, 0.0, True)

    def _due_s(self, camera: CameraConfig, release: _Release) -> float:
        delay_s = camera.delay_us * 1e-6 if camera.trigger == "external" else 0.0
        return release.time_s + delay_s + camera.latency_ms / 1000

    def _collect(self, release: _Release) -> dict[str, Frame | None]:
        timeout_s = self.config.shot.timeout_s if release.fired else min(_DIAGNOSIS_S, self.config.shot.timeout_s)
        due_s = {name: self._due_s(feed.camera, release) for name, feed in self._feeds.items()}
        for name, feed in self._feeds.items():
            feed.due(due_s[name] - release.uncertainty_s)
        # A broken camera has nothing to wait for; those that are open share one deadline.
        deadline_s = max(due_s.values(), default=release.time_s) + timeout_s
        frames = {
            name: feed.collect(due_s[name] - release.uncertainty_s, deadline_s if feed.state().opened else 0.0)
            for name, feed in self._feeds.items()
        }
        for feed in self._feeds.values():
            feed.unwant()
        return frames

    def _judge(self, release: _Release, frames: Mapping[str, Frame | None]) -> Shot:
        timings = {
            name: Timing(
                self._due_s(feed.camera, release),
                feed.state().period_s,
                feed.camera.trigger == "external",
                not feed.live,
            )
            for name, feed in self._feeds.items()
        }
        certificate, late = certify(
            frames,
            timings,
            trigger_s=release.time_s if release.fired else None,
            trigger_utc=datetime.fromtimestamp(time.time() + release.time_s - time.monotonic(), UTC).isoformat(
                timespec="milliseconds"
            ),
            uncertainty_s=release.uncertainty_s,
            skew_most_s=self.config.shot.skew_most_ms / 1000,
        )
        images = {name: frame.image for name, frame in frames.items() if frame is not None}
        checks = examine(images, self.plates)
        faults = [
            *release.faults,
            *self._missing(frames, release.fired),
            *late,
            *self._still(images),
            *(() if self.rig is None else size_faults(images, self.rig)),
            *judge(images, checks, self.plates, self.config.shot),
            *self._notes(images),
        ]
        return Shot(images, certificate, checks, _without_consequences(faults))

    def _missing(self, frames: Mapping[str, Frame | None], fired: bool) -> list[Fault]:
        faults = [Fault("missing", name, why) for name, why in self._broken.items()]
        for name, frame in frames.items():
            state = self._feeds[name].state()
            waits = self._feeds[name].camera.trigger == "external" and state.period_s is None
            if frame is not None or (not fired and state.opened and waits):
                continue  # no fault of a camera whose trigger never came
            timeout_s = self.config.shot.timeout_s if fired else min(_DIAGNOSIS_S, self.config.shot.timeout_s)
            faults.append(Fault("missing", name, state.error or compose("frame-missing", seconds=timeout_s)))
        return faults

    def _still(self, images: Mapping[str, ImageRgb]) -> list[Fault]:
        return [
            Fault("frozen", name, compose("picture-repeated"))
            for name, image in images.items()
            if self._feeds[name].live and name in self._last_seen and np.array_equal(self._last_seen[name].image, image)
        ]

    def _notes(self, images: Mapping[str, ImageRgb]) -> list[Fault]:
        unmet = {name: feed.state().unmet for name, feed in self._feeds.items()}
        notes = [Fault("setting", name, line) for name, lines in unmet.items() for line in lines]
        missing = [name for name in images if name not in self.plates]
        return notes + [Fault("plates", name, compose("camera-without-plates")) for name in missing]

    def _plate_faults(self, taken: Mapping[str, list[ImageRgb]]) -> list[Fault]:
        wanted, faults = self.config.shot.plates, []
        for name, images in taken.items():
            if len(images) < wanted:
                why = self._broken.get(name) or self._feeds[name].state().error
                why = why or compose("plates-incomplete", came=len(images), wanted=wanted)
                faults.append(Fault("missing", name, why))
        complete = {name: images for name, images in taken.items() if len(images) >= wanted}
        live = [name for name in complete if self._feeds[name].live]
        return faults + plate_faults(complete, live, self.config.shot)


def _without_consequences(faults: list[Fault]) -> tuple[Fault, ...]:
    """Removes faults that follow from others: a dark picture is not also reported as unsharp or displaced."""
    dark = {fault.camera for fault in faults if fault.code == "dark"}
    return tuple(fault for fault in faults if not (fault.camera in dark and fault.code in ("blurred", "view")))
