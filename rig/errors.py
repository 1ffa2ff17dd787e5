"""Defines the base classes of all exceptions. Every message says what is wrong and what to do."""

from collections.abc import Iterable

from rig.messages.message import Message, compose, message_of


class EigenheadError(Exception):
    """Is the base class of all errors that this project raises. ``message`` can be shown to an operator."""

    def __init__(self, message: Message | str) -> None:
        self.message = message_of(message)
        super().__init__(self.message)


class Cancelled(EigenheadError):
    """Ends work that its owner has cancelled. The function that receives progress raises it."""

    def __init__(self) -> None:
        super().__init__(compose("cancelled"))


class InputError(EigenheadError):
    """Refuses input that cannot be used. ``subject`` names the input; ``faults`` lists every fault found, not only the
    first."""

    def __init__(self, subject: str, faults: Iterable[Message | str]) -> None:
        self.subject = subject
        self.faults = tuple(message_of(fault) for fault in faults)
        super().__init__(compose("input-refused", subject=subject, faults=self.faults))

    def located(self, where: str | None = None) -> list[Message]:
        """Returns the faults, each preceded by ``where`` or, without it, by the error's subject."""
        return [compose("located", where=where or self.subject, fault=fault) for fault in self.faults]


class WrongVariable(InputError):
    """Refuses an environment variable that cannot be used. It is a fault of the machine, not of any capture."""


def how_to_install(extra: str) -> Message:
    """Returns the command that installs an optional part of the project, for a checkout or an installed wheel."""
    return compose("install-extra", extra=extra)
