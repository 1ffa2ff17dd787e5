"""Defines the base classes of all exceptions. Every exception's message states the fault and a remedy."""

import errno
from collections.abc import Iterable

from rig.messages.message import Message, compose, message_of

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


class EigenheadError(Exception):
    """Is the base class of all errors that the program raises. ``message`` can be shown to an operator."""

    def __init__(self, message: Message | str) -> None:
        self.message = message_of(message)
        super().__init__(self.message)


class Cancelled(EigenheadError):
    """Ends a computation that a user has cancelled. The callback that receives its progress raises the exception."""

    def __init__(self) -> None:
        super().__init__(compose("cancelled"))


class InputError(EigenheadError):
    """Reports unusable input. ``subject`` names the input, and ``faults`` lists all its faults."""

    def __init__(self, subject: str, faults: Iterable[Message | str]) -> None:
        self.subject = subject
        self.faults = tuple(message_of(fault) for fault in faults)
        super().__init__(compose("input-refused", subject=subject, faults=self.faults))

    def located(self, where: str | None = None) -> list[Message]:
        """Returns the faults, each preceded by ``where`` or, if that is None, by the error's subject."""
        return [compose("located", where=where or self.subject, fault=fault) for fault in self.faults]


class WrongVariable(InputError):
    """Reports an unusable environment variable. The machine's set-up is wrong, not the user's input."""


def how_to_install(extra: str) -> Message:
    """Returns the command that installs an optional part of the program, in a checkout or beside an installed wheel."""
    return compose("install-extra", extra=extra)
