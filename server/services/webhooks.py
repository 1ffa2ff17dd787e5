"""Webhooks announce to other programs how a job or a batch ended.

Messages and signatures follow https://www.standardwebhooks.com: ``webhook-id``, ``webhook-timestamp`` and
``webhook-signature: v1,<base64 HMAC-SHA256 of "id.timestamp.body">``. The delivery of a message is a workflow of the
job engine, so it survives a restart; it is tried nine times in about eight minutes.
"""

import base64
import hashlib
import hmac
import json
import secrets
import time
from collections.abc import Callable, Collection
from typing import Any

import httpx
import sqlalchemy as sa
import structlog

from rig.messages.message import compose
from server.errors import NotFound
from server.origins import parsed, target
from server.services.job_rows import DELIVERY, enqueue_options
from server.services.records import NewWebhookOut, WebhookOut
from server.storage.database import now_sql, webhooks
from server.storage.records import JobWebhook, WebhookMessage

log = structlog.get_logger()

WEBHOOKS_QUEUE = "webhooks"
OWN = "own"  # in the place of an id: the job's own webhook
TIMEOUT_S = 10.0


class Webhooks:
    """Manages the webhooks of the service and delivers messages to them. Methods block."""

    def __init__(self, engine: sa.Engine, origins: Collection[str] = ()) -> None:
        """``origins``: allowed origins of a job's own webhook."""
        self._engine, self._origins = engine, origins

    def add(self, url: str) -> NewWebhookOut:
        """Adds a webhook and returns it with its secret, which is not shown again. Raises InvalidInput for a text that
        is no web address."""
        parsed(url)
        secret = "whsec_" + base64.b64encode(secrets.token_bytes(24)).decode()
        made = NewWebhookOut(id=secrets.token_hex(14), url=url, secret=secret)
        with self._engine.begin() as connection:
            connection.execute(sa.insert(webhooks).values(**made.model_dump(), created=now_sql(connection)))
        return made

    def all(self) -> list[WebhookOut]:
        """Returns all webhooks without their secrets, oldest first."""
        with self._engine.connect() as connection:
            rows = connection.execute(sa.select(webhooks.c.id, webhooks.c.url).order_by(webhooks.c.created))
            return [WebhookOut(id=row.id, url=row.url) for row in rows]

    def remove(self, identity: str) -> None:
        """Removes a webhook, which gets no further messages. Raises NotFound."""
        with self._engine.begin() as connection:
            if not connection.execute(sa.delete(webhooks).where(webhooks.c.id == identity)).rowcount:
                raise NotFound(compose("thing-webhook"), identity)

    def announce(
        self,
        job_id: str,
        state: str,
        enqueue: Callable[..., Any],
        job_webhook: JobWebhook | None = None,
        delivered_to: str | None = None,
    ) -> None:
        """Queues one message for each webhook about the state of a job, and one for the job's own webhook if it has
        one. Each message has an id made of webhook, job and state, so a repeated call changes nothing. ``enqueue`` is
        the job engine's function to queue a workflow; ``delivered_to`` is a delivered result's place."""
        for hook_id in [*(hook.id for hook in self.all()), *([] if job_webhook is None else [OWN])]:
            identity = f"{messages_of(job_id)}{hook_id}-{state}"
            message: WebhookMessage = {"webhook": hook_id, "type": f"job.{state}", "job_id": job_id, "id": identity}
            if delivered_to is not None:
                message["delivered_to"] = delivered_to
            if job_webhook is not None and hook_id == OWN:
                message["own"] = job_webhook
            enqueue(enqueue_options(DELIVERY, WEBHOOKS_QUEUE, identity), message)

    def announce_batch(self, batch_id: str, round_number: int, enqueue: Callable[..., Any]) -> None:
        """Queues a message for each webhook that a batch has finished. A retry of failed jobs begins the batch's next
        round; a webhook gets one message for each round, even if the call is repeated."""
        for hook in self.all():
            identity = f"hook-{hook.id}-{batch_id}-{round_number}"
            what: WebhookMessage = {"webhook": hook.id, "type": "batch.finished", "batch_id": batch_id, "id": identity}
            enqueue(enqueue_options(DELIVERY, WEBHOOKS_QUEUE, identity), what)

    def post(self, message: WebhookMessage) -> int:
        """Tries once to deliver a message and returns the HTTP status of the answer. Returns 0 without sending if the
        webhook was removed.

        Raises httpx.HTTPError if the receiver cannot be reached or does not accept the message, and InvalidInput if the
        settings no longer allow the address of a job's own webhook.
        """
        try:
            return self._send(message)
        except httpx.HTTPError as error:
            refusal = error.response.status_code if isinstance(error, httpx.HTTPStatusError) else None
            # Without the address, which may hold a secret.
            log.warning(
                "webhook not reached", webhook=message["webhook"], of=message["id"], reason=refusal or str(error)
            )
            raise

    def _send(self, message: WebhookMessage) -> int:
        if "own" in message:
            return self._post_own(message, message["own"])
        with self._engine.connect() as connection:
            hook = connection.execute(sa.select(webhooks).where(webhooks.c.id == message["webhook"])).one_or_none()
        if hook is None:
            return 0
        body, headers = _signed(message, hook.secret)
        return httpx.post(hook.url, content=body, headers=headers, timeout=TIMEOUT_S).raise_for_status().status_code

    def _post_own(self, message: WebhookMessage, hook: JobWebhook) -> int:
        """Posts to an address that a caller named, after checking anew whether the address is allowed."""
        aim = target(hook["url"], self._origins)
        body, headers = _signed(message, hook["secret"])
        with httpx.Client(trust_env=False, timeout=TIMEOUT_S) as client:
            answer = client.post(aim.url, content=body, headers=headers | aim.headers, extensions=aim.extensions)
        return answer.raise_for_status().status_code


def messages_of(job_id: str) -> str:
    """Returns the common beginning of the ids of all messages about a job."""
    return f"hook-{job_id}-"


def _signed(message: WebhookMessage, secret: str | None) -> tuple[bytes, dict[str, str]]:
    """Returns the body and headers of a message; without a secret it is not signed."""
    data = {name: value for name, value in message.items() if name in ("job_id", "batch_id", "delivered_to")}
    body = json.dumps({"type": message["type"], "data": data}).encode()
    signed = {} if secret is None else signed_headers(message["id"], int(time.time()), body, secret)
    return body, signed | {"content-type": "application/json"}


def signed_headers(identity: str, timestamp: int, body: bytes, secret: str) -> dict[str, str]:
    """Returns the headers that identify and sign a message, after standardwebhooks.com. ``timestamp`` is in seconds
    since 1970, ``secret`` begins with "whsec_"."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    digest = hmac.new(key, f"{identity}.{timestamp}.".encode() + body, hashlib.sha256).digest()
    signature = "v1," + base64.b64encode(digest).decode()
    return {"webhook-id": identity, "webhook-timestamp": str(timestamp), "webhook-signature": signature}
