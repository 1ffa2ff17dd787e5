"""Declares the routes of storage, retention, health, readiness, metrics, models, templates, keys and webhooks, with the
routes' JSON documents, and the page that shows the API."""

from importlib.metadata import version
from pathlib import Path
from typing import Literal

from fastapi import APIRouter, Response
from fastapi.responses import FileResponse
from pydantic import Field

from pipeline.head_model.model_names import list_models, model_path
from rig.messages.message import compose
from server.http.auth import Admin, Reader, ServiceOf
from server.http.schemas import Received, example
from server.metrics import MEDIA_TYPE
from server.services.answer import Answer
from server.services.health import InfoOut, about, exposition, readiness
from server.services.records import NewWebhookOut, WebhookOut
from server.services.retention import UpcomingOut, upcoming
from server.services.service import CheckOut
from server.services.storage_use import StorageOut
from server.services.templates import TemplateOut, templates_at_hand
from server.services.texts import PLAIN
from server.wire.problems import Problem, documented

router = APIRouter()
DOCS = Path(__file__).parents[1] / "static" / "docs.html"


class RetentionOut(Answer):
    """Describes how long captures, results and caches are kept, and what is removed next."""

    keep_captures_days: float | None = Field(description="null: for ever")
    keep_results_days: float | None = Field(description="null: for ever")
    keep_jobs: int | None = Field(description="finished jobs; null: all")
    make_room: bool = Field(description="whether the oldest results go when the disk is full")
    free_bytes: int
    cache_bytes: int
    upload_hours: float
    upcoming: list[UpcomingOut] = Field(description="what goes next if nothing comes, jobs first")


class NewWebhook(Received):
    """Adds an address to which the service announces the end of every job and batch."""

    model_config = example({"url": "https://lab.example/hooks/heads"})

    url: str = Field(pattern="^https?://[^\\x00-\\x1f\\x7f]*$", max_length=2000)


class NewKey(Received):
    """Requests an API key with scopes. ``admin`` includes the other scopes."""

    model_config = example({"name": "console", "scopes": ["read", "capture", "submit"]})

    name: str = Field(min_length=1, max_length=200, pattern=PLAIN)
    scopes: list[Literal["read", "capture", "submit", "erase", "admin"]] = Field(min_length=1, max_length=5)


class ModelOut(Answer):
    """Describes a head model that a job may name; ``bytes`` is the size of the model's file."""

    id: str
    name: str
    bytes: int
    default: bool


class ModelList(Answer):
    """Holds the head models that a job may name."""

    models: list[ModelOut]


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


class Ready(Answer):
    """States whether the service can take work: the result of every check, and whether all checks passed."""

    ready: bool
    checks: dict[str, CheckOut]


class TemplateList(Answer):
    """Holds the templates at hand, sorted by name."""

    templates: list[TemplateOut]


@router.get("/v1/storage", tags=["operations"], responses=documented())
def get_storage(service: ServiceOf, caller: Reader) -> StorageOut:
    """Returns the bytes of each kind of data, as last measured. If the measurement is older than five minutes, a new
    measurement starts, but the answer does not wait for it."""
    return service.storage.use()


@router.get("/v1/retention", tags=["operations"], responses=documented())
def get_retention(service: ServiceOf, caller: Reader) -> RetentionOut:
    """Returns how long captures and finished jobs are kept (set by the variables ``EIGENHEAD_KEEP_...``), and what is
    removed next."""
    settings = {name: getattr(service.settings, name) for name in RetentionOut.model_fields if name != "upcoming"}
    return RetentionOut(**settings, upcoming=upcoming(service))


@router.get("/docs", include_in_schema=False)
def docs() -> FileResponse:
    """Returns a page that shows the API. The browser builds the page from openapi.json and loads nothing from other
    servers."""
    return FileResponse(DOCS, media_type="text/html")


@router.get("/healthz", tags=["operations"])
async def healthz() -> Health:
    """Answers as long as the service's process runs, without the checks of ``/readyz``."""
    return Health(status="ok", version=version("eigenhead"))


@router.get("/readyz", tags=["operations"], responses={503: {"model": Ready, "description": "Not ready"}})
def readyz(service: ServiceOf, response: Response) -> Ready:
    """Returns whether the service can take work: OpenGL, disk, database, a worker, the rig. If the service cannot take
    work, the answer has the status 503 and the same document."""
    checks = readiness(service)
    ready = all(check.ok for check in checks.values())
    response.status_code = 200 if ready else 503
    return Ready(ready=ready, checks=checks)


@router.get(
    "/metrics",
    tags=["operations"],
    response_class=Response,
    responses={200: {"content": {MEDIA_TYPE: {"schema": {"type": "string"}}}}, **documented()},
)
def metrics(service: ServiceOf, caller: Reader) -> Response:
    """Returns the metrics in Prometheus' text format."""
    return Response(exposition(service), media_type=MEDIA_TYPE)


@router.get("/v1/info", tags=["operations"], responses=documented())
def info(service: ServiceOf, caller: Reader) -> InfoOut:
    """Returns version, limits, the number of waiting jobs, and the default settings of a job."""
    return about(service)


@router.get("/v1/models", tags=["models"], responses=documented())
def list_models_at_hand(service: ServiceOf, caller: Reader) -> ModelList:
    """Lists the head models that a job may name."""
    default = model_path("default").resolve()
    models = [
        {"id": name, "name": name, "bytes": path.stat().st_size, "default": path.resolve() == default}
        for name, path in list_models().items()
    ]
    return ModelList.model_validate({"models": models})


@router.get("/v1/templates", tags=["models"], responses=documented())
def list_templates(service: ServiceOf, caller: Reader) -> TemplateList:
    """Lists the meshes in whose vertex order a job may write its head (``settings.outputs.template``)."""
    return TemplateList(templates=templates_at_hand())


@router.post("/v1/keys", status_code=201, tags=["access"], responses=documented(400, 413, 415, 507))
def add_key(service: ServiceOf, caller: Admin, wanted: NewKey) -> NewKeyOut:
    """Makes an API key. The key's secret is shown only in this answer. If there is no key yet, the answer is 403;
    ``eigenhead keys add`` makes the first key."""
    key = service.keys.add_for(caller, wanted.name, tuple(wanted.scopes))
    return NewKeyOut(id=key.split("_")[1], key=key)


@router.get("/v1/keys", tags=["access"], responses=documented())
def list_keys(service: ServiceOf, caller: Admin) -> KeyList:
    """Lists the API keys, without their secrets."""
    return KeyList(keys=[KeyOut(id=key.id, name=key.name, scopes=list(key.scopes)) for key in service.keys.all()])


@router.delete("/v1/keys/{key_id}", status_code=204, tags=["access"], responses=documented(404, 409))
def remove_key(service: ServiceOf, caller: Admin, key_id: str) -> None:
    """Removes an API key. A key cannot remove itself, so that nobody removes the last key by accident."""
    if key_id == caller.key:
        raise Problem(409, "own-key", compose("own-key"))
    service.keys.remove(key_id)


@router.post("/v1/webhooks", status_code=201, tags=["webhooks"], responses=documented(400, 413, 415, 507))
def add_webhook(service: ServiceOf, caller: Admin, wanted: NewWebhook) -> NewWebhookOut:
    """Registers an address that gets a signed message whenever a job or a batch ends (standardwebhooks.com)."""
    return service.webhooks.add(wanted.url)


@router.get("/v1/webhooks", tags=["webhooks"], responses=documented())
def list_webhooks(service: ServiceOf, caller: Admin) -> WebhookList:
    """Lists the addresses that get a message whenever a job or a batch ends, oldest first."""
    return WebhookList(webhooks=service.webhooks.all())


@router.delete("/v1/webhooks/{webhook_id}", status_code=204, tags=["webhooks"], responses=documented(404))
def remove_webhook(service: ServiceOf, caller: Admin, webhook_id: str) -> None:
    """Removes an address, which then gets no further messages about jobs and batches."""
    service.webhooks.remove(webhook_id)
