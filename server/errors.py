"""What the service refuses, however it was asked: by HTTP, from a page, on the command line, in a worker.

``kind`` is a stable name, ``detail`` says what is wrong and what to do, ``errors`` lists every fault found.
``server.wire.problems`` gives each class its HTTP status.
"""

from collections.abc import Iterable

from rig.errors import EigenheadError, InputError

URN = "urn:eigenhead:problem:"


class Refused(EigenheadError):
    """The root of what the service refuses."""

    def __init__(self, kind: str, detail: str, errors: Iterable[str] = (), *, retry_after_s: int | None = None) -> None:
        super().__init__(detail)
        self.kind, self.detail, self.errors, self.retry_after_s = kind, detail, list(errors), retry_after_s


class Unknown(Refused):
    """A key that is needed and was not given, or is nobody's."""


class Forbidden(Refused):
    """What this caller may not do."""


class NotFound(Refused):
    """What is not there."""

    def __init__(self, what: str, identity: str, where: str = "GET the list to see what there is") -> None:
        super().__init__("not-found", f"There is no {what} {identity!r:.80}; {where}.")


class Conflict(Refused):
    """What the state of a thing forbids."""


class Gone(Refused):
    """What was there."""


class TooLarge(Refused):
    """More bytes than the service takes."""


class Unusable(Refused):
    """An input that is understood and cannot be used."""


class TooMany(Refused):
    """More at once than the caller may have."""


class Unavailable(Refused):
    """What cannot be done now, and may go well another time: a rig, a worker."""


class DiskFull(Refused):
    def __init__(self) -> None:
        detail = "The disk of the service is full. Delete captures or jobs, then send it again."
        super().__init__("disk-full", detail)


SEND_AGAIN = "Mend what 'errors' lists and send it again."


def unusable_input(error: InputError) -> Unusable:
    """An InputError as a refusal: its subject becomes part of the kind."""
    kind = "invalid-" + ("".join(c for c in error.subject.split(".")[0] if c.isalnum() or c == "-").lower() or "input")
    count = len(error.faults)
    faults = "1 fault" if count == 1 else f"{count} faults"
    detail = " ".join([f"{error.subject}: {faults} found.", SEND_AGAIN])
    return Unusable(kind, detail, error.faults)
