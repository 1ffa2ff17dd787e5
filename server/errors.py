"""What the service refuses, however it was asked: by HTTP, from a page, on the command line, in a worker.

``kind`` is a stable name, ``detail`` says what is wrong and what to do, ``errors`` lists every fault found.
``server.wire.problems`` gives each class its HTTP status.
"""

from collections.abc import Iterable

from rig.errors import EigenheadError, InputError
from rig.messages.message import Message, compose, message_of
from server.problem_types import type_of_input


class Refused(EigenheadError):
    """The root of what the service refuses."""

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
    """Refuses a caller whose key is missing or belongs to nobody."""


class Forbidden(Refused):
    """Refuses what this caller may not do."""


class NotFound(Refused):
    """Refuses what does not exist."""

    def __init__(self, what: Message, identity: str, hint: Message | None = None) -> None:
        """``what``: a thing of the catalogue; ``hint``: where to look for what there is."""
        where = hint or compose("hint-list")
        super().__init__("not-found", compose("not-found", what=what, identity=f"{identity!r:.80}", where=where))


class Conflict(Refused):
    """Refuses what the state of a thing forbids."""


class Gone(Refused):
    """Refuses what existed and was removed."""


class TooLarge(Refused):
    """Refuses more bytes than the service takes."""


class InvalidInput(Refused):
    """Refuses an input that is understood and cannot be used."""


class TooMany(Refused):
    """Refuses more at once than the caller may have."""


class Unavailable(Refused):
    """Refuses what cannot be done now and may succeed later: a rig, a worker."""


class DiskFull(Refused):
    def __init__(self) -> None:
        super().__init__("disk-full", compose("service-disk-full"))


def unusable_input(error: InputError) -> InvalidInput:
    """Converts an InputError to a refusal; its kind follows from its subject."""
    kind = type_of_input(error.subject)
    found = compose("faults-found", subject=error.subject, count=len(error.faults))
    detail = compose("input-unusable", found=found)
    return InvalidInput(kind, detail, error.faults)
