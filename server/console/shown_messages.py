"""Shortens the messages of refusals and failures for pages, on which nobody sends a document again."""

from rig.messages.message import Message
from server.services.documents import ErrorDocument, failure_document
from server.services.records import Failure


def shown_detail(detail: Message) -> Message:
    """Returns the message of a refusal as a page shows it: without the advice to send a document again."""
    faults = detail.parameters.get("found")
    return faults if detail.code == "input-unusable" and isinstance(faults, Message) else detail


def shown_failure(failure: Failure | None) -> ErrorDocument | None:
    """Returns the document of a job's failure as a page shows it; None for None."""
    if failure is None:
        return None
    return failure_document(Failure(failure.type, shown_detail(failure.detail), failure.errors))
