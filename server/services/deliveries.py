"""Delivers results to object stores: checks the destination, and reads the job engine's record of a delivery.

A delivery is a workflow of the job engine: it survives restarts, and waits while a store does not answer. A result lies
in a folder named by its job's id; the manifest, ``delivery.json``, is written last.
"""

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

from dbos import DBOSClient

from rig.messages.message import compose
from server.errors import Forbidden
from server.services.answer import State
from server.services.failures import failure
from server.services.job_rows import STATES, enqueue_options
from server.services.records import DeliveryOut
from server.settings import ServiceSettings
from server.storage.object_places import locate
from server.storage.records import DeliveryRequest, JobRequest, JobWebhook

DELIVERIES_QUEUE = "deliveries"
DELIVER = "deliver-result"
MANIFEST = "delivery.json"
MANIFEST_FORMAT = "eigenhead-delivery/1"
HOUR_S = 3600.0
STATE_OF: Mapping[State, Literal["waiting", "delivering", "delivered", "failed", "cancelled"]] = {
    "queued": "waiting",
    "running": "delivering",
    "succeeded": "delivered",
    "failed": "failed",
    "cancelled": "cancelled",
}
UNDER_WAY = ("waiting", "delivering")


def destination(url: str, settings: ServiceSettings) -> str:
    """Returns a destination named by a caller, with a slash at its end. Raises Forbidden if the service allows no
    deliveries, and InvalidInput ("url-refused") for a forbidden destination."""
    if not settings.deliver_prefixes:
        raise Forbidden("deliveries-off", compose("deliveries-off"))
    place = url if url.endswith("/") else f"{url}/"
    locate(place, settings.deliver_prefixes)
    return place


def enqueue_delivery(
    enqueue: Callable[..., Any], job_id: str, to: str, settings: ServiceSettings, webhook: JobWebhook | None
) -> None:
    """Queues the delivery of a job's result. A second call for the same job changes nothing."""
    wanted: DeliveryRequest = {"job_id": job_id, "to": to, "until": time.time() + settings.deliver_hours * HOUR_S}
    if webhook is not None:
        wanted["webhook"] = webhook
    enqueue(enqueue_options(DELIVER, DELIVERIES_QUEUE, delivery_id(job_id)), wanted)


def delivery_id(job_id: str) -> str:
    """Returns the id of the workflow that delivers a job's result."""
    return f"deliver-{job_id}"


def place_of(wanted: DeliveryRequest) -> str:
    """Returns the location of a job's delivered result."""
    return f"{wanted['to']}{wanted['job_id']}/"


@dataclass(frozen=True, slots=True)
class Deliveries:
    """Reads and removes the job engine's records of deliveries. Methods block on the database."""

    client: DBOSClient

    def of(self, jobs: Collection[str]) -> dict[str, DeliveryOut]:
        """Returns the deliveries that were begun, by job."""
        ids = [delivery_id(job_id) for job_id in jobs]
        rows = self.client.list_workflows(name=DELIVER, workflow_ids=ids, load_output=True) if ids else []
        found = [(cast(DeliveryRequest, row.input["args"][0]), row) for row in rows if row.input]
        return {
            wanted["job_id"]: DeliveryOut(
                to=place_of(wanted),
                state=STATE_OF[STATES[row.status]],
                error=failure(row) if STATES[row.status] == "failed" else None,
            )
            for wanted, row in found
        }

    def forget(self, job_id: str) -> None:
        """Ends the delivery of a job, if any, and removes the delivery's row; delivered files stay."""
        self.client.cancel_workflow(delivery_id(job_id))
        self.client.delete_workflow(delivery_id(job_id))


def delivery_of(
    job_id: str, state: str, request: JobRequest | None, begun: Mapping[str, DeliveryOut]
) -> DeliveryOut | None:
    """Returns the delivery of a job in this state: the one that was begun, otherwise the one that the job requests."""
    if job_id in begun or request is None or "deliver_to" not in request:
        return begun.get(job_id)
    place = f"{request['deliver_to']}{job_id}/"
    ended = state in ("failed", "cancelled")
    return DeliveryOut(to=place, state="cancelled" if ended else "waiting", error=None)
