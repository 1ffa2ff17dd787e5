"""The one exception tree. Every message says what is wrong and what to do; nothing raises a bare Exception."""

from collections.abc import Iterable


class EigenheadError(Exception):
    """Root of every error this project raises on purpose; its text is fit for an operator."""


class Cancelled(EigenheadError):
    """The owner of the work asked it to stop; raised by a progress report."""

    def __init__(self) -> None:
        super().__init__("cancelled on request")


class InputError(EigenheadError):
    """Input that cannot be used. ``faults`` names every fault found, not only the first."""

    def __init__(self, subject: str, faults: Iterable[str]) -> None:
        self.subject = subject
        self.faults = tuple(faults)
        super().__init__(f"{subject}: " + "; ".join(self.faults))


class WrongVariable(InputError):
    """A variable of the environment that cannot be used: a fault of nobody's capture."""


def how_to_install(extra: str) -> str:
    """What to type for an optional part of the project, in a checkout and beside a wheel."""
    return f"run `deploy/setup.sh --extra {extra}`, or install eigenhead[{extra}] where a wheel was installed"
