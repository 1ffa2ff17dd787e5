"""Declares the routes that show what the data folder holds and what retention removes from it, and their documents."""

from typing import Annotated

from fastapi import APIRouter, Depends
from pydantic import Field

from server.http.auth import ServiceOf, require
from server.services.answer import Answer
from server.services.keys import Caller
from server.services.retention import UpcomingOut, upcoming
from server.services.storage_use import StorageOut
from server.wire.problems import documented

router = APIRouter(prefix="/v1", tags=["operations"])
Reader = Annotated[Caller, Depends(require("read"))]


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


@router.get("/storage", responses=documented())
def get_storage(service: ServiceOf, caller: Reader) -> StorageOut:
    """Returns the bytes of each kind of data, as they were last measured. If that is older than five minutes, a new
    measurement starts, but the answer does not wait for it."""
    return service.storage.use()


@router.get("/retention", responses=documented())
def get_retention(service: ServiceOf, caller: Reader) -> RetentionOut:
    """Returns how long captures and finished jobs are kept (set by the variables ``EIGENHEAD_KEEP_...``), and what is
    removed next."""
    settings = {name: getattr(service.settings, name) for name in RetentionOut.model_fields if name != "upcoming"}
    return RetentionOut(**settings, upcoming=upcoming(service))
