"""Declares the routes that show what the data folder holds and what retention removes from it."""

from typing import Annotated

from fastapi import APIRouter, Depends

from server.http.auth import ServiceOf, require
from server.http.storage_schemas import RetentionOut, StorageOut, UpcomingOut
from server.services.keys import Caller
from server.services.retention import upcoming
from server.wire.problems import documented

router = APIRouter(prefix="/v1", tags=["operations"])
Reader = Annotated[Caller, Depends(require("read"))]


@router.get("/storage", responses=documented())
def get_storage(service: ServiceOf, caller: Reader) -> StorageOut:
    """Returns the bytes of each kind of data, as they were last measured. If that is older than five minutes, a new
    measurement starts, but the answer does not wait for it."""
    return StorageOut.model_validate(service.storage.use())


@router.get("/retention", responses=documented())
def get_retention(service: ServiceOf, caller: Reader) -> RetentionOut:
    """Returns how long captures and finished jobs are kept (set by the variables ``EIGENHEAD_KEEP_...``), and what is
    removed next."""
    settings = {name: getattr(service.settings, name) for name in RetentionOut.model_fields if name != "upcoming"}
    return RetentionOut(**settings, upcoming=[UpcomingOut.model_validate(one) for one in upcoming(service)])
