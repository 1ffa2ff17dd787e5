"""Defines the JSON documents about the service itself: health, limits, models, API keys and webhooks."""

from typing import Literal

from pydantic import ConfigDict, Field

from server.http.message_schemas import MessageOut, TextOf
from server.http.schemas import Answer, JobSettings, Received
from server.services.texts import PLAIN


class NewWebhook(Received):
    """Adds an address to which the service announces the end of every job and batch."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"url": "https://lab.example/hooks/heads"}]})

    url: str = Field(pattern="^https?://[^\\x00-\\x1f\\x7f]*$", max_length=2000)


class NewKey(Received):
    """Requests an API key with scopes. ``admin`` includes the other scopes."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"name": "console", "scopes": ["read", "capture", "submit"]}]}
    )

    name: str = Field(min_length=1, max_length=200, pattern=PLAIN)
    scopes: list[Literal["read", "capture", "submit", "erase", "admin"]] = Field(min_length=1, max_length=5)


class ModelOut(Answer):
    """Describes a head model that a job may name; ``bytes`` is the size of its file."""

    id: str
    name: str
    bytes: int
    default: bool


class ModelList(Answer):
    """Holds the head models that a job may name."""

    models: list[ModelOut]


class WebhookOut(Answer):
    """Describes a webhook without its secret."""

    id: str
    url: str


class NewWebhookOut(WebhookOut):
    """Describes a webhook that was just added, with its secret."""

    secret: str = Field(description="shown this once; signs the messages (standardwebhooks.com)")


class WebhookList(Answer):
    """Holds all webhooks, oldest first."""

    webhooks: list[WebhookOut]


class KeyOut(Answer):
    """Describes an API key without its secret."""

    id: str
    name: str
    scopes: list[str]


class KeyList(Answer):
    """Holds all API keys, oldest first."""

    keys: list[KeyOut]


class NewKeyOut(Answer):
    """Holds an API key that was just made, with its secret."""

    id: str
    key: str = Field(description="shown this once")


class Health(Answer):
    """States that the process runs, and its version."""

    status: Literal["ok"]
    version: str


class InfoOut(Answer):
    """Describes the service: version, load, limits, and the default settings of a job."""

    version: str
    cores: int = Field(description="that this service may use; its workers may run elsewhere")
    queued: int = Field(description="jobs")
    running: int = Field(description="jobs")
    cameras_least: int = Field(description="of a capture")
    cameras_most: int = Field(description="of a capture")
    body_bytes_most: int = Field(description="of an upload")
    image_pixels_most: int = Field(description="of one image")
    jobs_per_key_most: int = Field(description="queued and running")
    settings: JobSettings = Field(description="what a job has where it gives none; its schema says what it may give")


class CheckOut(Answer):
    """Holds one check of the service: whether it passed and, if not, what to do. ``starting``: it will pass soon by
    itself."""

    ok: bool
    detail: TextOf
    starting: bool
    detail_message: MessageOut = Field(validation_alias="detail")


class Ready(Answer):
    """States whether the service can take work: every check, and whether all passed."""

    ready: bool
    checks: dict[str, CheckOut]
