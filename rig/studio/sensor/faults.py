"""Describes the deliberate faults of a simulated shot."""

from dataclasses import dataclass

from rig.errors import InputError
from rig.messages.message import compose

KINDS = {
    "frozen": "the camera's stream stands still: its picture is the last one before the subject came",
    "dark": "the camera's picture is all but black (amount: what is left of the light)",
    "lights-off": "the lamps did not fire: every picture is all but black",
    "bumped": "the camera was knocked after calibration (amount: degrees)",
    "swapped": "two cameras' cables are swapped (the camera and the one after it)",
    "exposure": "exposure changed between clean plate and shot (amount: share; no camera: all of them)",
    "camouflage": "hair and clothes have the backdrop's colour",
    "shadow": "the subject throws a soft shadow on the backdrop (amount: how dark)",
    "chair": "a chair behind the subject was moved between clean plate and shot, in one view",
    "wrong-mask": "an operator's mask that belongs elsewhere, in one view",
    "blurred": "the camera is out of focus (amount: standard deviation, pixels)",
}
DEFAULT_AMOUNT = {"dark": 0.02, "lights-off": 0.02, "bumped": 0.6, "exposure": 0.1, "shadow": 0.3, "blurred": 4.0}


@dataclass(frozen=True, slots=True)
class Fault:
    """Holds a simulated fault of one of ``KINDS``. If ``camera`` is None, the fault concerns the whole rig, or a random
    camera if only single cameras can have this kind."""

    kind: str
    camera: str | None = None
    amount: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError("fault", [compose("none-of", value=f"{self.kind!r}", known=sorted(KINDS))])

    @property
    def strength(self) -> float:
        """Returns the fault's amount, or the usual amount of its kind if ``amount`` is None."""
        return DEFAULT_AMOUNT.get(self.kind, 1.0) if self.amount is None else self.amount


def fault_from_text(text: str) -> Fault:
    """Reads a fault from ``kind[:camera][=amount]``, as on the command line: ``exposure=0.2``, ``dark:cam03``. Raises
    InputError."""
    return Fault(*fault_parts(text))


def fault_parts(text: str) -> tuple[str, str | None, float | None]:
    """Splits ``kind[:camera][=amount]`` into kind, camera and amount. Raises InputError unless the amount is a
    number."""
    head, _, amount = text.partition("=")
    kind, _, camera = head.partition(":")
    try:
        return kind, camera or None, float(amount) if amount else None
    except ValueError as error:
        raise InputError("fault", [compose("fault-amount", text=f"{text!r}", amount=f"{amount!r}")]) from error
