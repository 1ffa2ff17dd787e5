"""Every fault of the studio's devices, alone and in pairs, is named by the shot, and nothing is left behind."""

import dataclasses
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig.acquisition.session import RigSession
from rig.acquisition.shot import Fault, Shot
from rig.formats.rig_toml import RigConfig, read_rig_config
from rig.studio.devices.serve import DeviceFault, StudioDevices
from tests.support.textured_studio import NAMES, FlatStudio

# What goes wrong (each on cameras of its own), and how the shot names it: code and camera.
TABLE: dict[str, tuple[DeviceFault, set[tuple[str, str | None]]]] = {
    "dropped": (DeviceFault("dropped", "cam00"), {("dropped", "cam00")}),
    "late-trigger": (DeviceFault("late-trigger"), {("late-trigger", None)}),
    "late-output": (DeviceFault("late-trigger", "cam10"), {("late", "cam10")}),
    "frozen": (DeviceFault("frozen", "cam01"), {("frozen", "cam01")}),
    "hung": (DeviceFault("hung", "cam02"), {("missing", "cam02")}),
    "swapped": (DeviceFault("swapped", "cam03"), {("swapped", "cam03"), ("swapped", "cam04")}),
    "bumped": (DeviceFault("bumped", "cam05"), {("moved", "cam05")}),
    "lights-off": (DeviceFault("lights-off"), {("lights-off", None)}),
    "dark": (DeviceFault("dark", "cam06"), {("dark", "cam06")}),
    "unplugged": (DeviceFault("unplugged"), {("trigger", None)}),
}
# Nothing is released with the box out, so what goes wrong at a release does not happen. Both of the late triggers
# are one fault of every output.
CANNOT_SHOW = {("unplugged", kind) for kind in ("dropped", "late-trigger", "late-output")} | {
    ("late-trigger", "late-output")
}
NEIGHBOURS = {*itertools.pairwise(TABLE), ("dropped", "unplugged")}  # each fault twice; all 45 pairs each night
TIMEOUT_S = 2.0


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StudioDevices]:
    folder = tmp_path_factory.mktemp("studio")
    threads, opened = threading.active_count(), descriptors()
    with StudioDevices(folder, NAMES, FlatStudio(False), FlatStudio(True)) as devices:
        yield devices
    assert threading.active_count() <= threads  # fewer where something of an earlier test ended meanwhile
    assert descriptors() <= opened
    assert {path.name for path in folder.iterdir()} <= {"rig.toml", "plates"}


@pytest.fixture(scope="module")
def config(studio: StudioDevices) -> RigConfig:
    config = read_rig_config(studio.folder / "rig.toml")
    config = dataclasses.replace(config, shot=dataclasses.replace(config.shot, timeout_s=TIMEOUT_S))
    with RigSession(config) as session:
        session.warm_up()
        session.take_plates()
    studio.seat(True)
    return config


@pytest.fixture(scope="module")
def session(config: RigConfig, limit_s: float) -> Iterator[RigSession]:
    with RigSession(config) as session:
        session.warm_up()
        yield session


def shoot_with(studio: StudioDevices, config: RigConfig, faults: list[DeviceFault]) -> tuple[Shot, float]:
    """A shot of a session that was warm before anything went wrong; nothing of it is left."""
    studio.clear()
    threads, opened = threading.active_count(), descriptors()
    with RigSession(config) as session:
        session.warm_up()
        for fault in faults:
            studio.inject(fault)
        started_s = time.monotonic()
        shot = session.shoot()
        took_s = time.monotonic() - started_s
    assert threading.active_count() <= threads  # fewer where the box was unplugged
    for _ in range(100):  # the studio's side of a closed connection goes when its loop comes by
        if descriptors() <= opened:
            break
        time.sleep(0.02)
    assert descriptors() <= opened
    return shot, took_s


@pytest.fixture(scope="module")
def limit_s(studio: StudioDevices, config: RigConfig) -> float:
    """A shot ends after its timeout, one look at the live view before it, and the checks, which take as long here as
    they take where nothing is wrong. Measured before another session holds the box."""
    return 3.0 * (shoot_with(studio, config, [])[1] + TIMEOUT_S)


def named(faults: tuple[Fault, ...]) -> set[tuple[str, str | None]]:
    return {(fault.code, fault.camera) for fault in faults}


def test_a_rig_that_is_well_has_no_fault(studio: StudioDevices, config: RigConfig) -> None:
    shot, _ = shoot_with(studio, config, [])
    assert shot.faults == ()
    assert set(shot.images) == set(NAMES)
    assert all(line.status == "in sync" and line.skew_s is not None for line in shot.certificate.cameras)


@pytest.mark.parametrize("kind", TABLE)
def test_a_fault_alone_is_named_alone(studio: StudioDevices, session: RigSession, limit_s: float, kind: str) -> None:
    fault, expected = TABLE[kind]
    studio.clear()
    session.warm_up()
    studio.inject(fault)
    started_s = time.monotonic()
    shot = session.shoot()
    took_s = time.monotonic() - started_s
    # The lamps have their power from the box.
    assert named(shot.faults) == expected | ({("lights-off", None)} if kind == "unplugged" else set())
    assert shot.complete == (kind == "bumped")
    assert took_s < limit_s


@pytest.mark.slow
@pytest.mark.parametrize(
    ("one", "other"),
    [
        pytest.param(*pair, marks=[] if pair in NEIGHBOURS else pytest.mark.nightly)
        for pair in itertools.combinations(TABLE, 2)
    ],
)
def test_two_faults_are_named(studio: StudioDevices, config: RigConfig, limit_s: float, one: str, other: str) -> None:
    expected = TABLE[one][1] | TABLE[other][1]
    for pair in ((one, other), (other, one)):
        if pair in CANNOT_SHOW:
            expected = TABLE[pair[0]][1]
    shot, took_s = shoot_with(studio, config, [TABLE[one][0], TABLE[other][0]])
    assert expected <= named(shot.faults) <= expected | {("lights-off", None)}
    assert took_s < limit_s


def test_a_session_recovers_when_the_box_is_plugged_in_again(studio: StudioDevices, session: RigSession) -> None:
    studio.clear()
    studio.inject(DeviceFault("unplugged"))
    assert ("trigger", None) in named(session.shoot().faults)
    studio.clear()
    assert session.shoot().faults == ()
