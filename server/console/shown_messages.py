"""Shortens the messages of refusals and failures for pages, on which nobody sends a document again."""

from typing import TypedDict

from rig.messages.message import Message, MessageDocument, documents_of, texts_of
from server.services.records import Failure


class ErrorDocument(TypedDict):
    """Holds why a job failed, as HTTP answers it: English texts, and the same as messages for translation."""

    type: str
    detail: str
    errors: list[str]
    detail_message: MessageDocument
    error_messages: list[MessageDocument]


def shown_detail(detail: Message) -> Message:
    """Returns the message of a refusal as a page shows it: without the advice to send a document again."""
    faults = detail.parameters.get("found")
    return faults if detail.code == "input-unusable" and isinstance(faults, Message) else detail


def shown_failure(failure: Failure | None) -> ErrorDocument | None:
    """Returns the document of a job's failure as a page shows it; None for None."""
    if failure is None:
        return None
    detail = shown_detail(failure.detail)
    return {
        "type": failure.type,
        "detail": detail.text,
        "errors": texts_of(failure.errors),
        "detail_message": detail.document(),
        "error_messages": documents_of(failure.errors),
    }
