"""Declares the routes of health, readiness, metrics, models, templates, keys and webhooks, and the page that shows the
API; and their documents."""

from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Response
from fastapi.responses import FileResponse
from pydantic import ConfigDict, Field

from rig.messages.message import compose
from server.http.auth import ServiceOf, require
from server.http.schemas import Answer, JobSettings, MessageOut, Received, TextOf
from server.metrics import MEDIA_TYPE
from server.services.health import about, exposition, readiness
from server.services.keys import Caller
from server.services.templates import templates_at_hand
from server.services.texts import PLAIN
from server.wire.problems import Problem, documented

router = APIRouter()
Reader = Annotated[Caller, Depends(require("read"))]
Admin = Annotated[Caller, Depends(require("admin"))]
DOCS = Path(__file__).parents[1] / "static" / "docs.html"


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


class RegistrationOut(Answer):
    """Describes how well a template was fitted to its model. Distances are in mm: the median, and the value that 95 %
    of vertices stay below (``p95``)."""

    skin_share: float = Field(ge=0, le=1, description="of its vertices, on the model's skin; the others follow it")
    face_covered_share: float = Field(ge=0, le=1, description="of the model's face, that it shows")
    unlike_median_mm: float = Field(description="between the mesh as it came and the nearest head of the model")
    unlike_p95_mm: float
    off_median_mm: float = Field(description="between the mesh drawn onto that head and the head")
    off_p95_mm: float


class TemplateOut(Answer):
    """Describes a template: a mesh in whose vertex order a job writes its head if ``settings.outputs.template`` names
    it."""

    id: str = Field(description="what a job calls it")
    name: str
    source: str | None = Field(description="file of the mesh")
    sha256: str | None = Field(description="of that file")
    model: str | None = Field(description="that it was registered to; a job with another one is refused")
    models: list[str] = Field(description="names of that model at /v1/models; none where it is not at hand")
    vertices: int | None
    registration: RegistrationOut | None
    fault: str | None = Field(description="why it cannot be used, and nothing else is known of it; null: it can")


class TemplateList(Answer):
    """Holds the templates at hand, sorted by name."""

    templates: list[TemplateOut]


@router.get("/docs", include_in_schema=False)
def docs() -> FileResponse:
    """Returns a page that shows the API. The browser builds it from openapi.json and loads nothing from other
    servers."""
    return FileResponse(DOCS, media_type="text/html")


@router.get("/healthz", tags=["operations"])
async def healthz() -> Health:
    """Answers as long as the process runs. It checks nothing else; ``/readyz`` does."""
    return Health(status="ok", version=version("eigenhead"))


@router.get("/readyz", tags=["operations"], responses={503: {"model": Ready, "description": "Not ready"}})
def readyz(service: ServiceOf, response: Response) -> Ready:
    """Returns whether the service can take work: OpenGL, disk, database, a worker, the rig. If not, the status is 503,
    with the same document."""
    checks = readiness(service)
    ready = all(check.ok for check in checks.values())
    response.status_code = 200 if ready else 503
    return Ready(ready=ready, checks={name: CheckOut.model_validate(check) for name, check in checks.items()})


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
    return InfoOut.model_validate(about(service))


@router.get("/v1/models", tags=["models"], responses=documented())
def list_models_at_hand(service: ServiceOf, caller: Reader) -> ModelList:
    """Lists the head models that a job may name."""
    from pipeline.head_model.model_names import list_models, model_path

    default = model_path("default").resolve()
    models = [
        {"id": name, "name": name, "bytes": path.stat().st_size, "default": path.resolve() == default}
        for name, path in list_models().items()
    ]
    return ModelList.model_validate({"models": models})


@router.get("/v1/templates", tags=["models"], responses=documented())
def list_templates(service: ServiceOf, caller: Reader) -> TemplateList:
    """Lists the meshes in whose vertex order a job may write its head (``settings.outputs.template``)."""
    templates = [TemplateOut.model_validate(template) for template in templates_at_hand()]
    return TemplateList(templates=templates)


@router.post("/v1/keys", status_code=201, tags=["access"], responses=documented(400, 413, 415, 507))
def add_key(service: ServiceOf, caller: Admin, wanted: NewKey) -> NewKeyOut:
    """Makes an API key. The answer is the only time that it is shown. The first key is made by ``eigenhead keys add``;
    without any, this is 403."""
    key = service.keys.add_for(caller, wanted.name, tuple(wanted.scopes))
    return NewKeyOut(id=key.split("_")[1], key=key)


@router.get("/v1/keys", tags=["access"], responses=documented())
def list_keys(service: ServiceOf, caller: Admin) -> KeyList:
    """Lists the API keys, without their secrets."""
    return KeyList(keys=[KeyOut(id=key.id, name=key.name, scopes=list(key.scopes)) for key in service.keys.all()])


@router.delete("/v1/keys/{key_id}", status_code=204, tags=["access"], responses=documented(404, 409))
def remove_key(service: ServiceOf, caller: Admin, key_id: str) -> None:
    """Removes an API key. A key cannot remove itself, so that removing the last one by accident does not leave the
    service without keys."""
    if key_id == caller.key:
        raise Problem(409, "own-key", compose("own-key"))
    service.keys.remove(key_id)


@router.post("/v1/webhooks", status_code=201, tags=["webhooks"], responses=documented(400, 413, 415, 507))
def add_webhook(service: ServiceOf, caller: Admin, wanted: NewWebhook) -> NewWebhookOut:
    """Registers an address that gets a signed message whenever a job or a batch ends (standardwebhooks.com)."""
    return NewWebhookOut.model_validate(service.webhooks.add(wanted.url))


@router.get("/v1/webhooks", tags=["webhooks"], responses=documented())
def list_webhooks(service: ServiceOf, caller: Admin) -> WebhookList:
    """Lists the addresses that get a message whenever a job or a batch ends, oldest first."""
    return WebhookList(webhooks=[WebhookOut.model_validate(hook) for hook in service.webhooks.all()])


@router.delete("/v1/webhooks/{webhook_id}", status_code=204, tags=["webhooks"], responses=documented(404))
def remove_webhook(service: ServiceOf, caller: Admin, webhook_id: str) -> None:
    """Removes an address, which gets no further messages."""
    service.webhooks.remove(webhook_id)
