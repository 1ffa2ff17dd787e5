"""Erases captures permanently: pictures, heads, caches and rows of the job database; and lists beforehand what a
removal would delete."""

import time
from collections.abc import Collection

from pydantic import Field

from rig.messages.message import compose
from server.errors import Unavailable
from server.services.answer import Answer
from server.services.job_rows import FINISHED
from server.services.jobs import Jobs
from server.storage.store import Store

CANCEL_S = 5.0  # a cancelled job lets go of its files within one second


class HoldingsOut(Answer):
    """Lists the stored data of a capture. A removal of the capture deletes its pictures, an erasure all its data."""

    pictures: int
    bytes: int = Field(description="of images, clean plates and caches")
    heads: list[str] = Field(description="jobs whose results stay after a removal, photographs in their overlays too")
    head_bytes: int
    jobs: list[str] = Field(description="the other jobs")
    active: list[str] = Field(description="jobs that are queued or running: a removal is refused, an erasure ends them")


def erase_captures(store: Store, jobs: Jobs, captures: Collection[str], others: Collection[str] = ()) -> None:
    """Cancels the jobs of the captures, and the jobs ``others``, then removes their results, pictures, caches and rows
    of the job database, messages to webhooks and labels of batches included.

    An interrupted erasure is completed by a second call. Raises Unavailable if a worker still writes ``CANCEL_S``
    seconds after its job was cancelled.
    """
    of_captures = {job.id for capture in captures for job in jobs.find(capture=capture, limit=100_000)} | {*others}
    active = [job for job in of_captures if jobs.state(job) not in FINISHED]
    for job in of_captures:
        jobs.cancel(job)
    _await_workers(store, active)
    for job in of_captures:
        jobs.delete(job)
        if store.folder("jobs", job).exists():
            raise Unavailable("still-writing", compose("still-writing"))
    jobs.forget_messages(of_captures)
    jobs.batches.forget_captures(captures)
    for capture in captures:
        store.remove_capture(capture)


def _await_workers(store: Store, jobs: Collection[str]) -> None:
    """Waits until no job has a folder ``attempt-*``, which exists while a worker writes, or until ``CANCEL_S`` seconds
    have passed: a killed worker leaves its folder. Without the wait a worker could restore erased files."""
    deadline = time.monotonic() + CANCEL_S
    folders = [store.folder("jobs", job) for job in jobs]
    while any([*folder.glob("attempt-*")] for folder in folders) and time.monotonic() < deadline:
        time.sleep(0.05)
