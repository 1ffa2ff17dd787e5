"""Defines the errors by which the service refuses a request, whether over HTTP, on a page, on the command line or by a
worker.

``kind`` is a stable name, ``detail`` describes the fault and the remedy, ``errors`` lists every fault found.
``server.wire.problems`` gives each class its HTTP status.
"""

import errno
from collections.abc import Iterable

from rig.errors import EigenheadError, InputError
from rig.messages.message import Message, compose, message_of
from server.problem_types import type_of_input

UNWRITABLE = (errno.EROFS, errno.EACCES, errno.EPERM)


class Refused(EigenheadError):
    """Refuses a request; all refusals are subclasses. After ``retry_after_s`` seconds the caller may try again."""

    def __init__(
        self,
        kind: str,
        detail: Message | str,
        errors: Iterable[Message | str] = (),
        *,
        retry_after_s: int | None = None,
    ) -> None:
        super().__init__(detail)
        self.kind, self.detail, self.retry_after_s = kind, self.message, retry_after_s
        self.errors = tuple(message_of(error) for error in errors)


class Unauthenticated(Refused):
    """Refuses a caller whose API key is missing or unknown."""


class Forbidden(Refused):
    """Refuses an action for which the caller lacks the scope."""


class NotFound(Refused):
    """Refuses a request for an object that does not exist."""

    def __init__(self, what: Message, identity: str, hint: Message | None = None) -> None:
        """Words the refusal. ``what``: the kind of object, a message of the catalogue; ``hint``: how to find existing
        objects."""
        where = hint or compose("hint-list")
        super().__init__("not-found", compose("not-found", what=what, identity=f"{identity!r:.80}", where=where))


class Conflict(Refused):
    """Refuses an action that the current state of an object does not allow."""


class Gone(Refused):
    """Refuses a request for an object that was removed."""


class TooLarge(Refused):
    """Refuses more bytes than the settings allow."""


class InvalidInput(Refused):
    """Refuses an input that can be read but not used."""


class UrlRefused(InvalidInput):
    """Refuses an address that a caller names, on the web or in an object store."""

    def __init__(self, why: Message) -> None:
        super().__init__("url-refused", compose("url-refused", why=why), [compose("field-url-refused", why=why)])


class TooMany(Refused):
    """Refuses a caller who has as many jobs or batches at once as the settings allow."""


class Unavailable(Refused):
    """Refuses an action that cannot be done now and may succeed later, for example without a rig or worker."""


class DiskFull(Refused):
    """Refuses an action that would leave less free disk space than the settings demand."""

    def __init__(self) -> None:
        super().__init__("disk-full", compose("service-disk-full"))


class DataUnwritable(Unavailable):
    """Refuses an action that must write while the data folder cannot be written, for example because the disk was
    mounted read-only after an error."""

    def __init__(self) -> None:
        super().__init__("data-unwritable", compose("service-data-unwritable"))


def unusable_input(error: InputError) -> InvalidInput:
    """Converts an InputError to a refusal whose ``kind`` follows from the error's subject."""
    kind = type_of_input(error.subject)
    title = compose("faults-found", subject=error.subject, count=len(error.faults))
    detail = compose("input-unusable", found=title)
    return InvalidInput(kind, detail, error.faults)
