"""The one exception tree. Every message says what is wrong and what to do; nothing raises a bare Exception."""

from collections.abc import Iterable

from rig.messages.message import Message, compose, message_of


class EigenheadError(Exception):
    """Is the root of every error that this project raises on purpose; its ``message`` is fit for an operator."""

    def __init__(self, message: Message | str) -> None:
        self.message = message_of(message)
        super().__init__(self.message)


class Cancelled(EigenheadError):
    """Ends work that its owner stopped; a progress report raises it."""

    def __init__(self) -> None:
        super().__init__(compose("cancelled"))


class InputError(EigenheadError):
    """Refuses input that cannot be used. ``faults`` names every fault found, not only the first."""

    def __init__(self, subject: str, faults: Iterable[Message | str]) -> None:
        self.subject = subject
        self.faults = tuple(message_of(fault) for fault in faults)
        super().__init__(compose("input-refused", subject=subject, faults=self.faults))

    def located(self, where: str | None = None) -> list[Message]:
        """Returns the faults with the place where they are, the error's subject if no other is named."""
        return [compose("located", where=where or self.subject, fault=fault) for fault in self.faults]


class WrongVariable(InputError):
    """Refuses a variable of the environment that cannot be used: a fault of nobody's capture."""


def how_to_install(extra: str) -> Message:
    """Returns what to type for an optional part of the project, in a checkout and beside a wheel."""
    return compose("install-extra", extra=extra)
