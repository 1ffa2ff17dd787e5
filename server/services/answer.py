"""Declares the base classes of the service's documents, which services return, HTTP sends as JSON, and pages show."""

from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetPydanticSchema,
    PlainSerializer,
    WithJsonSchema,
    computed_field,
    model_validator,
)
from pydantic_core import core_schema

from rig.messages.message import Message
from server.storage.records import JsonObject

SETTINGS = {"type": "object", "title": "Settings"}  # placeholder of settings, until the description of HTTP replaces it
JobSettings = Annotated[JsonObject, WithJsonSchema(SETTINGS)]
Moment = Annotated[str, Field(json_schema_extra={"format": "date-time"})]
State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
Said = Annotated[
    Message,
    GetPydanticSchema(lambda _source, _handler: core_schema.is_instance_schema(Message)),
    PlainSerializer(str),
    WithJsonSchema({"type": "string"}),
]  # in JSON its English text


class MessageOut(BaseModel):
    """Holds a message of the service as data. A program can show the message in another language by its ``code`` and
    ``parameters``."""

    code: str = Field(description="stable; decides what parameters there are")
    message: str = Field(description="in English")
    parameters: JsonObject = Field(default_factory=dict, description="what stands in the message, by name")

    @model_validator(mode="before")
    @classmethod
    def _of_message(cls, value: Any) -> Any:
        return value.document() if isinstance(value, Message) else value


class Answer(BaseModel):
    """Is the base of all documents of the service; a document can also be read from a record with equal fields."""

    model_config = ConfigDict(frozen=True, from_attributes=True)


def as_data(field: str, form: Any = MessageOut) -> Any:
    """Returns a field of an ``Answer`` that holds the message of the text field ``field`` as data. ``form``: the
    field's type: ``MessageOut``, ``MessageOut | None`` or a list of ``MessageOut``."""

    def read(self: Answer) -> Any:
        said = getattr(self, field)
        if said is None or isinstance(said, Message):
            return said and MessageOut.model_validate(said)
        return [MessageOut.model_validate(one) for one in said]

    def drop_read_only(schema: JsonObject) -> None:
        del schema["readOnly"]

    return computed_field(return_type=form, json_schema_extra=drop_read_only)(property(read))
