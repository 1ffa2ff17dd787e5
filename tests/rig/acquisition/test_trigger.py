"""The line protocol and its client against a simulated box on a pty: noise, half lines, wrong devices, no cable."""

import os
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.acquisition.trigger import BoxClock, TriggerBox, TriggerRefused, TriggerSilent, TriggerUnplugged, WrongDevice
from rig.formats.trigger_lines import REPLY, REQUEST, LineReader, crc16, decode_payload, encode_line
from rig.studio.devices.trigger_box import BoxLogic, Release, SimulatedTriggerBox

BODIES = st.text(st.characters(min_codepoint=32, max_codepoint=126, exclude_characters="@#*"), min_size=1, max_size=60)


class Outputs:
    """What a box did."""

    def __init__(self) -> None:
        self.releases: list[Release] = []
        self.lights: list[int] = []
        self.armed: list[bool] = []

    def logic(self) -> BoxLogic:
        return BoxLogic(self.releases.append, self.lights.append, self.armed.append)


@pytest.fixture
def outputs() -> Outputs:
    return Outputs()


@pytest.fixture
def port(tmp_path: Path, outputs: Outputs) -> Iterator[Path]:
    with SimulatedTriggerBox(tmp_path / "box", outputs.logic()) as box:
        yield box.port


def test_checksum_is_the_published_one() -> None:
    # The check value of CRC-16/CCITT-FALSE in the RevEng catalogue of CRC algorithms.
    assert crc16(b"123456789") == 0x29B1


@given(st.integers(0, 255), BODIES)
def test_lines_survive_the_round_trip(sequence: int, body: str) -> None:
    line = encode_line(REQUEST, sequence, body)
    assert list(LineReader(REQUEST).feed(line)) == [(sequence, body)]
    assert list(LineReader(REPLY).feed(line)) == [], "an echo is no reply"


@given(st.integers(0, 255), BODIES, st.binary(max_size=200))
def test_noise_before_a_line_does_not_hide_it(sequence: int, body: str, noise: bytes) -> None:
    lines = list(LineReader(REQUEST).feed(noise + encode_line(REQUEST, sequence, body)))
    assert lines[-1] == (sequence, body)


@given(st.integers(0, 255), BODIES, st.integers(1, 255), st.data())
def test_one_damaged_byte_is_always_noticed(sequence: int, body: str, flip: int, data: st.DataObject) -> None:
    # A CRC of 16 bits finds every burst of up to 16 bits, and one byte is a burst of 8. Only a changed frame
    # character can cut the line differently, and then it is no line either.
    line = bytearray(encode_line(REQUEST, sequence, body))
    line[data.draw(st.integers(1, len(line) - 2))] ^= flip
    assert (sequence, body) not in list(LineReader(REQUEST).feed(bytes(line)))
    assert list(LineReader(REQUEST).feed(bytes(line))) == []


def test_random_lines_are_not_taken_for_commands() -> None:
    rng = np.random.default_rng(5)
    reader = LineReader(REQUEST)
    lines = list(reader.feed(rng.integers(0, 256, 400_000, dtype=np.uint8).tobytes()))
    assert lines == []
    assert reader.bad_lines > 1000


@pytest.mark.parametrize("line", [b"", b"*", b"07 OK*12", b"07 OK*29b1", b"7 OK*0000", b"*0000", b"\xff\xff \xff*0000"])
def test_malformed_lines_decode_to_nothing(line: bytes) -> None:
    assert decode_payload(line) is None


def test_client_drives_every_command(port: Path, outputs: Outputs) -> None:
    with closing(TriggerBox(str(port))) as box:
        box.set_lights(0b1010)
        box.set_delay(3, 2500)
        box.arm(5.0)
        assert box.status().state == "ARMED"
        fired = box.fire(0b1011, 1000)
        status = box.status()
    assert outputs.lights == [0b1010]
    assert [release.delays_s for release in outputs.releases] == [{0: 0.0, 1: 0.0, 3: 0.0025}]
    # The box reads its clock in microseconds, so rounding adds 0.5 us to the uncertainty of the comparison.
    assert abs(fired.time_s - outputs.releases[0].time_s) <= fired.uncertainty_s + 1e-6
    assert fired.uncertainty_s < 0.05
    assert (status.shots, status.lights) == (1, 0b1010)


def test_fire_needs_arming_and_arming_is_used_up(port: Path, outputs: Outputs) -> None:
    with closing(TriggerBox(str(port))) as box:
        with pytest.raises(TriggerRefused, match="NOT-ARMED"):
            box.fire(1, 1000)
        box.arm(5.0)
        box.fire(1, 1000)
        with pytest.raises(TriggerRefused, match="NOT-ARMED"):
            box.fire(1, 1000)
        box.arm(5.0)
        box._command("DISARM")
        with pytest.raises(TriggerRefused, match="NOT-ARMED"):
            box.fire(1, 1000)
        box.arm(0.05)
        time.sleep(0.15)
        assert box.status().state == "IDLE"
    assert len(outputs.releases) == 1


@pytest.mark.parametrize(
    "body",
    ["DELAY 12 0", "DELAY 0 500001", "DELAY 0", "ARM 60001", "ARM -1", "LIGHTS 10", "FIRE 1000 5", "FIRE 1 0", "ARM x"],
)
def test_arguments_out_of_range_and_unknown_commands_are_refused(port: Path, body: str) -> None:
    with closing(TriggerBox(str(port))) as box:
        with pytest.raises(TriggerRefused, match="ARGUMENT"):
            box._command(body)
        with pytest.raises(TriggerRefused, match="UNKNOWN"):
            box._command("EXPLODE 1")


def test_a_repeated_request_is_answered_without_acting_twice(outputs: Outputs) -> None:
    logic = outputs.logic()
    logic.handle(1, "ARM 5000", 0.0)
    first = logic.handle(2, "FIRE 1 1000", 0.01)
    assert logic.handle(2, "FIRE 1 1000", 0.02) == first
    assert logic.handle(3, "FIRE 1 1000", 0.03) == "ERR NOT-ARMED"
    assert len(outputs.releases) == 1


def test_clock_comparison_crosses_the_wrap_of_the_counter() -> None:
    clock = BoxClock(host_s=100.0, box_us=2**32 - 10, uncertainty_s=0.0)
    assert clock.host_from_box(990) == pytest.approx(100.001, abs=1e-9)
    assert clock.host_from_box(2**32 - 1010) == pytest.approx(99.999, abs=1e-9)


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


class Wire:
    """A noisy cable: a pty on which a function of the test answers."""

    def __init__(self, answer) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self._answer = answer
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        os.set_blocking(self.master, False)
        while not self._stop.wait(0.002):
            try:
                data = os.read(self.master, 4096)
            except BlockingIOError:
                data = b""
            reply = self._answer(data)
            if reply:
                os.write(self.master, reply)

    def __enter__(self) -> "Wire":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self.master)
        os.close(self.slave)


def test_client_gets_through_a_cable_that_loses_and_damages_lines(outputs: Outputs) -> None:
    # A third of the requests is damaged, a third of the replies lost, noise everywhere. A command then fails with
    # 1 - (2/3)^2 = 5/9 an attempt; 40 attempts leave (5/9)^40 = 6e-11 a command.
    rng = np.random.default_rng(8)
    logic, reader = outputs.logic(), LineReader(REQUEST)

    def answer(data: bytes) -> bytes:
        if data and rng.random() < 1 / 3:
            data = data[: len(data) // 2]
        replies = rng.integers(0, 256, 3, dtype=np.uint8).tobytes() if data else b""
        for sequence, body in reader.feed(data):
            reply = encode_line(REPLY, sequence, logic.handle(sequence, body, time.monotonic()))
            if rng.random() >= 1 / 3:
                replies += reply
        return replies

    with Wire(answer) as wire, closing(TriggerBox(wire.port, reply_timeout_s=0.1, attempts=40)) as box:
        for shot in range(1, 11):
            box.arm(60.0)
            assert box.fire(0x7FF, 1000).shot == shot
    assert len(outputs.releases) == 10


def answer_of_version_2(data: bytes) -> bytes:
    return b"".join(
        encode_line(REPLY, sequence, "OK eigenhead-trigger/2 FW=9 ID=1 CH=1 LI=0")
        for sequence, _ in LineReader(REQUEST).feed(data)
    )


@pytest.mark.parametrize(
    ("answer", "errors", "name"),
    [
        (lambda data: b"$GPGGA,092750.000,5321.6802,N*76\r\n", WrongDevice, "GPGGA"),
        (answer_of_version_2, WrongDevice, "eigenhead-trigger/2"),
        (lambda data: data, (TriggerSilent, WrongDevice), None),
        (lambda data: b"", TriggerSilent, "no answer"),
    ],
    ids=["another device", "another version", "echo", "silence"],
)
def test_what_is_no_box_is_named(answer, errors, name: str | None) -> None:
    with Wire(answer) as wire, pytest.raises(errors, match=name):
        TriggerBox(wire.port, boot_s=0.3, reply_timeout_s=0.1)


def test_a_port_that_is_not_there_or_that_another_program_has(tmp_path: Path, port: Path) -> None:
    with pytest.raises(TriggerUnplugged, match="unplugged"):
        TriggerBox(str(tmp_path / "no-such-port"))
    with closing(TriggerBox(str(port))), pytest.raises(TriggerUnplugged, match="cannot be opened"):
        TriggerBox(str(port))


def test_pulling_the_cable_is_an_error_at_once(tmp_path: Path, outputs: Outputs) -> None:
    plugged = SimulatedTriggerBox(tmp_path / "box", outputs.logic())
    with closing(TriggerBox(str(plugged.port))) as box:
        plugged.close()
        started_s = time.monotonic()
        with pytest.raises(TriggerUnplugged, match="unplugged"):
            box.status()
        assert time.monotonic() - started_s < 1.5
    assert not plugged.port.is_symlink()


def test_a_closed_box_leaves_no_thread_descriptor_or_file(tmp_path: Path, outputs: Outputs) -> None:
    threads, descriptors = threading.active_count(), open_descriptors()
    with (
        SimulatedTriggerBox(tmp_path / "box", outputs.logic()) as simulated,
        closing(TriggerBox(str(simulated.port))) as box,
    ):
        box.status()
    assert threading.active_count() == threads
    assert open_descriptors() == descriptors
    assert list(tmp_path.iterdir()) == []
