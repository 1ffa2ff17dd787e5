"""Defines how messages appear in JSON documents: as English text, and beside it as code and parameters."""

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, Field, model_validator

from rig.messages.message import Message
from server.storage.records import JsonObject

TextOf = Annotated[str, BeforeValidator(lambda shown: shown.text if isinstance(shown, Message) else shown)]
Texts = list[TextOf]


class MessageOut(BaseModel):
    """Holds a message of the service as data. A program can show it in another language by its ``code`` and
    ``parameters``."""

    code: str = Field(description="stable; decides what parameters there are")
    message: str = Field(description="in English")
    parameters: JsonObject = Field(default_factory=dict, description="what stands in the message, by name")

    @model_validator(mode="before")
    @classmethod
    def _of_message(cls, value: Any) -> Any:
        return value.document() if isinstance(value, Message) else value


class WarningOut(MessageOut):
    """Holds a warning with its code and parameters, as report.json has it."""

    code: str = Field(description="as in docs/operator.md, among them scale-assumed, view-left-out, views-many")
