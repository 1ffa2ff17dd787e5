"""The firmware of the trigger box, compiled with avr-gcc and run in simavr on a pty, under the real client.

The simulator prints every change of an output with the AVR's cycle, so that what the box did is compared with what it
acknowledged. Skipped, visibly, where Debian's gcc-avr, avr-libc, simavr, libsimavr-dev and libelf-dev are absent.
"""

import contextlib
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial

from rig.acquisition.trigger import TriggerBox, TriggerRefused
from rig.formats.trigger_lines import REPLY, REQUEST, LineReader, encode_line

FIRMWARE = Path(__file__).resolve().parents[3] / "deploy" / "firmware"
CYCLES_PER_US = 16
PINS = {("D", pin + 2): pin for pin in range(6)} | {("B", pin): pin + 6 for pin in range(6)}
Edge = tuple[int, str, int, int]  # cycle, port, pin, level


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    missing = [tool for tool in ("avr-gcc", "avr-objcopy", "make", "cc") if shutil.which(tool) is None]
    if missing or not Path("/usr/include/simavr").is_dir() or not Path("/usr/lib/avr/include").is_dir():
        pytest.skip("needs gcc-avr avr-libc simavr libsimavr-dev libelf-dev make gcc: firmware not exercised")
    build = tmp_path_factory.mktemp("firmware")
    made = subprocess.run(
        ["make", "-C", str(FIRMWARE), f"BUILD={build}", "BOX_ID=7", "all", "simulator"], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr
    return build


class Simulator:
    """simavr with the firmware; ``edges()`` is what the outputs did so far."""

    def __init__(self, build: Path) -> None:
        self._process = subprocess.Popen(
            [build / "simulate", build / "trigger.elf"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        self._lines: list[str] = []
        self.port = ""
        for line in self._process.stdout:  # simavr itself reports the sections that it loads
            if line.startswith("pty "):
                self.port = line.split()[1]
                break
        assert self.port, "the simulator ended before it named its pty"
        self._collector = threading.Thread(target=self._collect, daemon=True)
        self._collector.start()

    def _collect(self) -> None:
        assert self._process.stdout is not None
        self._lines.extend(self._process.stdout)

    def close(self) -> list[Edge]:
        """Ends the simulator; every edge of its outputs."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        assert self._process.wait(10) == 0
        self._collector.join(5)
        assert self._process.stdout is not None
        self._process.stdout.close()
        split = [line.split() for line in self._lines if len(line.split()) == 4 and line[0].isdigit()]
        return [(int(cycle), port, int(pin), int(level)) for cycle, port, pin, level in split]


@pytest.fixture
def simulator(built: Path) -> Iterator[Simulator]:
    running = Simulator(built)
    yield running
    if running._process.poll() is None:
        running.close()


def rises(edges: list[Edge]) -> list[tuple[int, int]]:
    """(cycle, channel) of every rising camera output."""
    return [(cycle, PINS[port, pin]) for cycle, port, pin, level in edges if level and (port, pin) in PINS]


def test_firmware_speaks_the_protocol(simulator: Simulator) -> None:
    with TriggerBox(simulator.port) as box:
        box.set_lights(0b0101)
        with pytest.raises(TriggerRefused, match="NOT-ARMED"):
            box.fire(1, 100)
        for body in ("DELAY 12 0", "DELAY 0 500001", "DELAY 0", "ARM 60001", "ARM x", "LIGHTS 10", "FIRE 1000", "ARM"):
            with pytest.raises(TriggerRefused, match="ARGUMENT"):
                box._command(body)
        with pytest.raises(TriggerRefused, match="UNKNOWN"):
            box._command("ARMOUR 1")
        box.arm(0.5)
        assert box.status().state == "ARMED"
        box._command("DISARM")
        assert box.status().state == "IDLE"
        box.arm(0.05)
        first = box.synchronise()
        while box.synchronise().box_us - first.box_us < 60_000:
            pass
        assert box.status().state == "IDLE"
        status = box.status()
    assert (status.shots, status.lights, status.bad_lines) == (0, 0b0101, 0)
    edges = simulator.close()
    assert rises(edges) == []
    assert {(port, pin) for _, port, pin, level in edges if level} == {("C", 0), ("C", 2)}


def test_outputs_rise_after_their_delays_for_the_pulse(simulator: Simulator) -> None:
    delays_us = {0: 0, 3: 250, 6: 1000, 11: 20_000}
    with TriggerBox(simulator.port) as box:
        for channel, delay_us in delays_us.items():
            box.set_delay(channel, delay_us)
        box.arm(5.0)
        box.fire(sum(1 << channel for channel in delays_us), 500)
        while box.status().state == "FIRING":
            pass
        assert box.status().shots == 1
    edges = simulator.close()
    up = {channel: cycle for cycle, channel in rises(edges)}
    down = {PINS[port, pin]: cycle for cycle, port, pin, level in edges if not level and cycle > min(up.values())}
    assert len(rises(edges)) == len(delays_us)
    for channel, delay_us in delays_us.items():
        # A tick is 50 us; the interrupt that serves it waits at most for the UART's and its own loop over the
        # channels (about 30 us), and the edges of one tick come from two port writes.
        assert (up[channel] - up[0]) / CYCLES_PER_US == pytest.approx(delay_us, abs=50)
        assert (down[channel] - up[channel]) / CYCLES_PER_US == pytest.approx(500, abs=50)


def test_a_resent_request_fires_once(simulator: Simulator) -> None:
    # Written by hand, for the client sends again only what got lost.
    requests = [encode_line(REQUEST, 1, "ARM 5000")] + [encode_line(REQUEST, 2, "FIRE 1 100")] * 3
    requests.append(encode_line(REQUEST, 3, "STATUS"))
    replies: list[str] = []
    with serial.Serial(simulator.port, timeout=2.0) as wire:
        reader = LineReader(REPLY)
        for _ in range(10):  # what comes before the box has booted is lost
            wire.write(encode_line(REQUEST, 9, "STATUS"))
            if list(reader.feed(wire.read_until(b"\n"))):
                break
        for request in requests:
            wire.write(request)
            replies.extend(body for _, body in reader.feed(wire.read_until(b"\n")))
    assert replies[1] == replies[2] == replies[3]
    assert "SHOTS=1 " in replies[4]
    assert len(rises(simulator.close())) == 1


def drive_with_noise(box: TriggerBox, port: str, commands: int, seed: int) -> tuple[int, list[int], list[int]]:
    """Commands with 0 to 40 random bytes before each; the number of lights set, releases by mask, lights by mask."""
    rng = np.random.default_rng(seed)
    noise_port = os.open(port, os.O_WRONLY | os.O_NOCTTY)
    fired: list[int] = []
    lights: list[int] = []
    try:
        for _ in range(commands):
            os.write(noise_port, rng.integers(0, 256, rng.integers(0, 41), dtype=np.uint8).tobytes())
            kind = rng.integers(5)
            mask = int(rng.integers(1, 1 << 12))
            if kind == 0:
                box.set_delay(int(rng.integers(12)), int(rng.integers(0, 500)))
            elif kind == 1:
                lights.append(mask & 15)
                box.set_lights(mask & 15)
            elif kind == 2:
                box.arm(60.0)
            elif kind == 3:
                box.status()
            else:
                with contextlib.suppress(TriggerRefused):  # not armed: half of them are not
                    box.fire(mask, 100)
                    fired.append(mask)
    finally:
        os.close(noise_port)
    return commands, fired, lights


@pytest.mark.parametrize("commands", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_noise_between_commands_is_never_acted_on(simulator: Simulator, commands: int) -> None:
    with TriggerBox(simulator.port, attempts=8) as box:
        _, fired, lights = drive_with_noise(box, simulator.port, commands, seed=11)
        while box.status().state == "FIRING":
            pass
        status = box.status()
    assert status.shots == len(fired)
    edges = simulator.close()
    expected = sorted(channel for mask in fired for channel in range(12) if mask >> channel & 1)
    assert sorted(channel for _, channel in rises(edges)) == expected
    assert light_states(edges) == without_repeats(lights)
    assert status.bad_lines > 0


def light_states(edges: list[Edge]) -> list[int]:
    """The masks that the light outputs went through; edges of one port write share a cycle."""
    states: list[int] = []
    mask, at = 0, None
    for cycle, port, pin, level in edges:
        if port != "C" or pin > 3:
            continue
        if at is not None and cycle != at:
            states.append(mask)
        mask, at = (mask & ~(1 << pin)) | level << pin, cycle
    return without_repeats([*states, mask]) if at is not None else []


def without_repeats(masks: list[int]) -> list[int]:
    """Consecutive equal masks once, and no leading 0: the state at power-up."""
    kept: list[int] = []
    for mask in masks:
        if mask != (kept[-1] if kept else 0):
            kept.append(mask)
    return kept
