"""Controls the trigger box, which releases all cameras at once, by a serial protocol of text lines (docs/rig.md).

A request is ``@SS BODY*CCCC\\n`` and its reply ``#SS BODY*CCCC\\n``. SS is a sequence number (two hex digits) and CCCC
the CRC-16/CCITT-FALSE of ``SS BODY``. A receiver starts a new line at each start character, so noise between lines has
no effect. The box ignores a damaged request, and the host sends the request again with the same sequence number. If the
box has already executed a request with the same sequence number, it only repeats its reply. Requests and replies start
with different characters, so that an echo is not mistaken for a reply.
"""

import string
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import serial

from rig.errors import EigenheadError
from rig.formats.rig_toml import RigConfig
from rig.formats.trigger_lines import BAUD, CLOCK_PERIOD_US, PROTOCOL, REPLY, REQUEST, LineReader, encode_line
from rig.messages.message import Message, compose

ARM_TO_FIRE_S = 0.02  # pause in which the live view's present frame ends
BUSY_S = 1.5  # longest release: delay and pulse take up to 0.5 s each, and the lines between them some time


class TriggerError(EigenheadError):
    """Reports that the trigger box did not execute a request, and is the base class of this module's errors."""


class TriggerUnplugged(TriggerError):
    """Reports that the serial port does not exist or was unplugged."""

    def __init__(self, port: str, why: str) -> None:
        super().__init__(compose("trigger-unplugged", port=port, reason=why))


class TriggerSilent(TriggerError):
    """Reports that the serial port exists but no device answers."""

    def __init__(self, port: str, body: str, waited_s: float) -> None:
        super().__init__(compose("trigger-silent", port=port, command=body.split()[0], waited_s=waited_s))


class WrongDevice(TriggerError):
    """Reports that the device on the serial port is not a trigger box."""

    def __init__(self, port: str, said: str) -> None:
        super().__init__(compose("trigger-other-device", port=port, protocol=PROTOCOL, said=f"{said!r}"))


class TriggerRefused(TriggerError):
    """Reports that the trigger box understood a request and refused it. ``code`` is one of UNKNOWN, ARGUMENT,
    NOT-ARMED, BUSY."""

    def __init__(self, body: str, code: Message | str) -> None:
        self.code = code
        super().__init__(compose("trigger-refused", command=f"{body!r}", reason=code))


@dataclass(frozen=True, slots=True)
class BoxStatus:
    """Holds the trigger box's answer to STATUS. ``bad_lines`` is the number of damaged lines that the box ignored."""

    state: str
    shots: int
    lights: int
    bad_lines: int


@dataclass(frozen=True, slots=True)
class BoxClock:
    """Compares two clocks: holds the host's time (time.monotonic, s) at the trigger box's time ``box_us``, and its
    uncertainty (s)."""

    host_s: float
    box_us: int
    uncertainty_s: float

    def host_from_box(self, box_us: int) -> float:
        """Converts a time of the trigger box (us), within 35 minutes of ``box_us``, to the host's time (time.monotonic,
        s). Between the two times the box's 32-bit counter may overflow."""
        difference = (box_us - self.box_us + CLOCK_PERIOD_US // 2) % CLOCK_PERIOD_US - CLOCK_PERIOD_US // 2
        return self.host_s + difference * 1e-6


@dataclass(frozen=True, slots=True)
class Fired:
    """Holds one release of the cameras: the times (time.monotonic, s) at which the trigger box raised its outputs and
    the host requested this, the uncertainty (s), and the box's count of shots."""

    time_s: float
    uncertainty_s: float
    asked_s: float
    shot: int


class TriggerBox:
    """Controls one trigger box. Each method returns after the box has acknowledged a request, or raises TriggerError.

    ``port`` is a serial port or the pseudo-terminal of a simulated box. A path in /dev/serial/by-id does not change at
    a reboot. The constructor waits up to ``boot_s``, because many boards restart when their port is opened.
    """

    def __init__(
        self, port: str, *, baud: int = BAUD, reply_timeout_s: float = 0.25, attempts: int = 4, boot_s: float = 3.0
    ) -> None:
        self.port = port
        self._reply_timeout_s = reply_timeout_s
        self._attempts = attempts
        self._lock = threading.Lock()
        self._reader = LineReader(REPLY)
        self._sequence = time.monotonic_ns() & 0xFF
        self._clock: BoxClock | None = None
        try:
            # exclusive: of two programs that fire the same box each would take the shot for its own
            self._serial = serial.Serial(port, baud, timeout=0.05, write_timeout=1.0, exclusive=True)
        except (serial.SerialException, OSError, ValueError) as error:
            raise TriggerUnplugged(port, _first_line(error)) from error
        try:
            self._identify(boot_s)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "TriggerBox":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the serial port. The method may be called repeatedly, and after the cable was unplugged."""
        # pyserial's close restores nothing that could fail, but an unplugged descriptor may still raise
        try:
            self._serial.close()
        except (serial.SerialException, OSError):
            return

    def set_delay(self, channel: int, delay_us: int) -> None:
        """Sets the delay (0 to 500,000 us) from the release to the rise of an output."""
        self._command(f"DELAY {channel} {delay_us}")

    def set_lights(self, mask: int) -> None:
        """Switches the lights on or off: bit n of ``mask`` is the state of light n."""
        self._command(f"LIGHTS {mask:X}")

    def arm(self, window_s: float) -> None:
        """Allows one call of ``fire`` within ``window_s`` seconds, after which the trigger box disarms itself."""
        self._command(f"ARM {round(window_s * 1000)}")

    def fire(self, mask: int, pulse_us: int) -> Fired:
        """Raises the outputs whose bits are set in ``mask``, each after its delay, for ``pulse_us`` microseconds. Needs
        an armed box."""
        clock = self._clock or self.synchronise()
        asked_s = time.monotonic()
        words = self._command(f"FIRE {mask:X} {pulse_us}")
        box_us, shot = _integers("FIRE", words, 2)
        return Fired(clock.host_from_box(box_us), clock.uncertainty_s, asked_s, shot)

    def status(self) -> BoxStatus:
        """Returns the box's state (IDLE, ARMED or FIRING), shots since power-up, lights, and count of damaged lines."""
        fields = _fields(self._command("STATUS"))
        try:
            return BoxStatus(fields["STATE"], int(fields["SHOTS"]), int(fields["LIGHTS"], 16), int(fields["BAD"]))
        except (KeyError, ValueError) as error:
            raise WrongDevice(self.port, f"STATUS {fields}") from error

    def synchronise(self, rounds: int = 5) -> BoxClock:
        """Compares the box's clock with time.monotonic ``rounds`` times, and returns the most precise comparison.

        By Cristian's method (Distributed Computing 3, 1989), the box reads its clock at some time during the round trip
        of a request. The shortest round trip gives the narrowest bound; half its duration is the uncertainty.
        """
        best: BoxClock | None = None
        for _ in range(rounds):
            sent_s = time.monotonic()
            (box_us,) = _integers("CLOCK", self._command("CLOCK"), 1)
            half_s = (time.monotonic() - sent_s) / 2
            if best is None or half_s < best.uncertainty_s:
                best = BoxClock(sent_s + half_s, box_us, half_s)
        assert best is not None, "rounds is at least 1"
        self._clock = best
        return best

    def _identify(self, boot_s: float) -> None:
        attempts = max(1, round(boot_s / self._reply_timeout_s))
        words = self._command("IDENTIFY", attempts=attempts)
        if words[:1] != [PROTOCOL] or not _fields(words).keys() >= {"FW", "ID", "CH", "LI"}:
            raise WrongDevice(self.port, " ".join(words))

    def _command(self, body: str, attempts: int | None = None) -> list[str]:
        """Repeats the request ``body`` until the trigger box answers, even if busy. Returns the words after OK."""
        until_s = time.monotonic() + BUSY_S
        while True:
            with self._lock:
                self._sequence = (self._sequence + 1) & 0xFF
                answer = self._exchange(self._sequence, body, attempts or self._attempts)
            words = answer.split()
            if words[:2] != ["ERR", "BUSY"] or time.monotonic() > until_s:
                break
            time.sleep(0.005)
        if words and words[0] == "OK":
            return words[1:]
        if len(words) >= 2 and words[0] == "ERR":
            raise TriggerRefused(body, words[1])
        raise WrongDevice(self.port, answer)

    def _exchange(self, sequence: int, body: str, attempts: int) -> str:
        line = encode_line(REQUEST, sequence, body)
        try:
            for _ in range(attempts):
                self._serial.write(line)
                answer = self._await_reply(sequence)
                if answer is not None:
                    return answer
        except (serial.SerialException, OSError, TypeError) as error:
            # pyserial raises TypeError where another thread closed the port under a read
            raise TriggerUnplugged(self.port, _first_line(error)) from error
        said = bytes(self._reader.stray).decode("ascii", "replace").strip()
        if said and sum(character in string.printable for character in said) > len(said) // 2:
            raise WrongDevice(self.port, said[-60:])
        raise TriggerSilent(self.port, body, attempts * self._reply_timeout_s)

    def _await_reply(self, sequence: int) -> str | None:
        deadline_s = time.monotonic() + self._reply_timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            self._serial.timeout = min(left_s, 0.05)
            data = self._serial.read(max(1, self._serial.in_waiting))
            for answered, body in self._reader.feed(data):
                if answered == sequence:
                    return body
        return None


class RigTrigger:
    """Holds the trigger box that rig.toml names. An error closes the trigger box, and its next use opens it.

    ``error``: why it cannot be used; None if it can, or if rig.toml names none."""

    def __init__(self, config: RigConfig) -> None:
        self.error: TriggerError | None = None
        self._config = config
        self._box: TriggerBox | None = None

    @contextmanager
    def _attempt(self) -> Iterator[None]:
        try:
            yield
        except TriggerError as error:
            self.error = error
            self._drop()

    def _drop(self) -> None:
        if self._box is not None:
            self._box.close()
        self._box = None

    def open(self) -> None:
        """Opens the trigger box and sets the delays of the cameras, unless the box is open."""
        trigger = self._config.trigger
        if trigger is None or self._box is not None:
            return
        with self._attempt():
            self._box = TriggerBox(trigger.port, baud=trigger.baud)
            for camera in self._config.cameras:
                if camera.channel is not None:
                    self._box.set_delay(camera.channel, camera.delay_us)
            self.error = None

    def close(self) -> None:
        """Switches the lamps off, unless rig.toml keeps them on, and closes the trigger box. Safe to call twice."""
        with self._attempt():
            if self._box is not None and not self._config.lights.keep_on:
                self._box.set_lights(0)
        self._drop()

    def switch_lamps_on(self) -> None:
        """Opens the trigger box, switches the lamps of rig.toml on and waits until they are steady."""
        self.open()
        lights = self._config.lights
        mask = sum(1 << output for output in lights.outputs)
        with self._attempt():
            if mask and self._box is not None and self._box.status().lights != mask:
                self._box.set_lights(mask)
                time.sleep(lights.settle_s)

    def fire(self) -> Fired | None:
        """Releases the cameras that wait for the trigger box. Returns None if the rig has no box or the box fails."""
        trigger, cameras = self._config.trigger, self._config.cameras
        mask = sum(1 << c.channel for c in cameras if c.trigger == "external" and c.channel is not None)
        with self._attempt():
            if trigger is not None and self._box is not None:
                self._box.synchronise()
                self._box.arm(trigger.window_s)
                time.sleep(ARM_TO_FIRE_S)
                return self._box.fire(mask, trigger.pulse_us)
        return None


def _integers(command: str, words: list[str], count: int) -> list[int]:
    try:
        numbers = [int(word) for word in words[:count]]
    except ValueError:
        numbers = []
    if len(numbers) < count:
        raise TriggerRefused(command, compose("trigger-answer-unknown", answer=f"{' '.join(words)!r}"))
    return numbers


def _fields(words: list[str]) -> dict[str, str]:
    return dict(word.split("=", 1) for word in words if "=" in word)


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
