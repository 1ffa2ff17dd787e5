"""Simulates the trigger box, which releases all cameras, with the protocol of ``rig.acquisition.trigger`` on a
pseudo-terminal.

``BoxLogic`` is the state machine, without clock or files. ``SimulatedTriggerBox`` runs the state machine in a thread,
and reports changes of the box's outputs to the studio.
"""

import os
import select
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from rig.formats.trigger_lines import (
    CLOCK_PERIOD_US,
    DELAY_MOST_US,
    PROTOCOL,
    PULSE_MOST_US,
    REPLY,
    REQUEST,
    WINDOW_MOST_MS,
    LineReader,
    encode_line,
)

CHANNELS = 12
LIGHTS = 4


@dataclass(frozen=True, slots=True)
class Release:
    """Holds the delay (s) after ``time_s`` (time.monotonic) at which one FIRE request raises each output channel."""

    time_s: float
    delays_s: dict[int, float]


@dataclass(slots=True)
class BoxLogic:
    """Holds the state of one trigger box. ``handle`` returns the reply to a request. The callbacks ``on_release``,
    ``on_lights`` and ``on_armed`` report changes of outputs."""

    on_release: Callable[[Release], None]
    on_lights: Callable[[int], None]
    on_armed: Callable[[bool], None]
    serial: str = "simulated"
    delays_us: list[int] = field(default_factory=lambda: [0] * CHANNELS)
    lights: int = 0
    shots: int = 0
    bad_lines: int = 0
    armed_until_s: float | None = None
    firing_until_s: float = 0.0
    _last: tuple[int, str] | None = None
    _last_reply: str = ""

    def handle(self, sequence: int, body: str, now_s: float) -> str:
        """Returns the reply to a request. A repeated request with the same sequence number gets the same reply and has
        no effect."""
        if self._last == (sequence, body):
            return self._last_reply
        self.expire(now_s)
        words = body.split(" ")
        command = _COMMANDS.get(words[0])
        try:
            reply = command(self, words[1:], now_s) if command else "ERR UNKNOWN"
        except (ValueError, IndexError):
            reply = "ERR ARGUMENT"
        self._last, self._last_reply = (sequence, body), reply
        return reply

    def expire(self, now_s: float) -> None:
        """Disarms the box if the time limit for FIRE has passed."""
        if self.armed_until_s is not None and now_s > self.armed_until_s:
            self._disarm()

    def _disarm(self) -> None:
        self.armed_until_s = None
        self.on_armed(False)

    def _identify(self, words: list[str], now_s: float) -> str:
        _expect(words, 0)
        return f"OK {PROTOCOL} FW=1.0.0 ID={self.serial} CH={CHANNELS} LI={LIGHTS}"

    def _clock(self, words: list[str], now_s: float) -> str:
        _expect(words, 0)
        return f"OK {_box_us(now_s)}"

    def _delay(self, words: list[str], now_s: float) -> str:
        _expect(words, 2)
        channel, delay_us = _decimal(words[0], CHANNELS - 1), _decimal(words[1], DELAY_MOST_US)
        if now_s < self.firing_until_s:
            return "ERR BUSY"
        self.delays_us[channel] = delay_us
        return "OK"

    def _arm(self, words: list[str], now_s: float) -> str:
        _expect(words, 1)
        window_ms = _decimal(words[0], WINDOW_MOST_MS)
        if now_s < self.firing_until_s:
            return "ERR BUSY"
        self.armed_until_s = now_s + window_ms / 1000
        self.on_armed(True)
        return "OK"

    def _disarm_command(self, words: list[str], now_s: float) -> str:
        _expect(words, 0)
        self._disarm()
        return "OK"

    def _fire(self, words: list[str], now_s: float) -> str:
        _expect(words, 2)
        mask, pulse_us = _hexadecimal(words[0], (1 << CHANNELS) - 1), _decimal(words[1], PULSE_MOST_US)
        if pulse_us == 0:
            raise ValueError("a pulse of no length")
        if self.armed_until_s is None:
            return "ERR NOT-ARMED"
        self.armed_until_s = None
        self.shots += 1
        delays_s = {channel: self.delays_us[channel] * 1e-6 for channel in range(CHANNELS) if mask >> channel & 1}
        self.firing_until_s = now_s + max(delays_s.values(), default=0.0) + pulse_us * 1e-6
        self.on_release(Release(now_s, delays_s))
        return f"OK {_box_us(now_s)} {self.shots}"

    def _lights(self, words: list[str], now_s: float) -> str:
        _expect(words, 1)
        self.lights = _hexadecimal(words[0], (1 << LIGHTS) - 1)
        self.on_lights(self.lights)
        return "OK"

    def _status(self, words: list[str], now_s: float) -> str:
        _expect(words, 0)
        state = "FIRING" if now_s < self.firing_until_s else "IDLE" if self.armed_until_s is None else "ARMED"
        return f"OK STATE={state} SHOTS={self.shots} LIGHTS={self.lights:X} BAD={self.bad_lines}"


_COMMANDS: dict[str, Callable[[BoxLogic, list[str], float], str]] = {
    "IDENTIFY": BoxLogic._identify,
    "CLOCK": BoxLogic._clock,
    "DELAY": BoxLogic._delay,
    "ARM": BoxLogic._arm,
    "DISARM": BoxLogic._disarm_command,
    "FIRE": BoxLogic._fire,
    "LIGHTS": BoxLogic._lights,
    "STATUS": BoxLogic._status,
}


class SimulatedTriggerBox:
    """Runs a simulated trigger box on a pseudo-terminal. ``port`` is the path of a link to the pseudo-terminal, which
    ``close`` removes."""

    def __init__(self, port: Path, logic: BoxLogic) -> None:
        self.port = port
        self.logic = logic
        self._master, slave = os.openpty()
        tty.setraw(slave)
        port.unlink(missing_ok=True)
        port.symlink_to(os.ttyname(slave))
        # Our own descriptor of the slave stays open: without one a pty master reads EIO until a client comes.
        self._slave = slave
        self._wake_read, self._wake_write = os.pipe()
        self._stopped = False
        self._thread = threading.Thread(target=self._serve, name="trigger box", daemon=True)
        self._thread.start()

    def __enter__(self) -> "SimulatedTriggerBox":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the box's thread and removes its port, so that a client's next read or write fails. The call may be
        repeated."""
        if self._stopped:
            return
        self._stopped = True
        os.write(self._wake_write, b"x")
        self._thread.join()
        self.port.unlink(missing_ok=True)
        for descriptor in (self._master, self._slave, self._wake_read, self._wake_write):
            os.close(descriptor)

    def _serve(self) -> None:
        reader = LineReader(REQUEST)
        while True:
            ready, _, _ = select.select([self._master, self._wake_read], [], [], 0.05)
            now_s = time.monotonic()
            if self._wake_read in ready:
                return
            self.logic.expire(now_s)
            if self._master not in ready:
                continue
            for sequence, body in reader.feed(os.read(self._master, 4096)):
                self.logic.bad_lines = reader.bad_lines
                reply = self.logic.handle(sequence, body, time.monotonic())
                os.write(self._master, encode_line(REPLY, sequence, reply))


def _box_us(now_s: float) -> int:
    return round(now_s * 1e6) % CLOCK_PERIOD_US


def _expect(words: list[str], count: int) -> None:
    if len(words) != count:
        raise ValueError(f"{count} arguments expected")


def _decimal(word: str, most: int) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 6):
        raise ValueError(f"{word!r} is no number")
    return _at_most(int(word), most)


def _hexadecimal(word: str, most: int) -> int:
    if not word or len(word) > 4 or any(digit not in "0123456789ABCDEF" for digit in word):
        raise ValueError(f"{word!r} is no mask")
    return _at_most(int(word, 16), most)


def _at_most(number: int, most: int) -> int:
    if number > most:
        raise ValueError(f"{number} is more than {most}")
    return number
