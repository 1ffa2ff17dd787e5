"""Defines the JSON documents of lists that come in pages, and of actions on many things at once."""

from typing import Annotated, Literal

from fastapi import Query
from pydantic import ConfigDict, Field

from server.http.message_schemas import MessageOut, TextOf
from server.http.schemas import (
    DELIVER_TO,
    EXAMPLE_ID,
    Answer,
    CaptureOut,
    DeliverTo,
    Id,
    JobOut,
    JobSettings,
    Moment,
    Received,
    SessionOut,
    Tags,
)
from server.services.texts import PLAIN

Limit = Annotated[int, Query(ge=1, le=1000)]
Cursor = Annotated[str | None, Query(max_length=2000, description="``next`` of the page before, in the same order")]
Key = Annotated[str | None, Query(max_length=64, pattern=PLAIN)]
WithTag = Annotated[
    str | None, Query(max_length=200, pattern=PLAIN, description="only what bears this tag, in whatever case")
]
Sought = Annotated[str, Query(max_length=200, pattern=PLAIN, description="words that must all be found")]


class Listed(Answer):
    """Holds one page of a list."""

    next: str | None = Field(None, description="cursor of the page after this one; null on the last")
    total: int = Field(ge=0, description="how many all pages hold")


class CaptureList(Listed):
    """Holds one page of captures."""

    captures: list[CaptureOut]


class SessionList(Listed):
    """Holds one page of sessions."""

    sessions: list[SessionOut]


class PersonOut(Answer):
    """Describes a person whose sessions have the same name. ``captures`` counts captures, ``heads`` jobs that made a
    head."""

    id: str = Field(description="of the newest session")
    label: str
    created: Moment
    sessions: list[str]
    captures: int
    heads: int
    running: int = Field(description="jobs that are queued or running")
    head: str | None = Field(description="newest job with a result")
    capture: str | None = Field(description="newest capture")
    consent: bool = Field(description="whether every session has a note of it")
    tags: list[str] = Field(description="of their captures")


class SubjectList(Listed):
    """Holds one page of people."""

    subjects: list[PersonOut]


class JobList(Listed):
    """Holds one page of jobs."""

    jobs: list[JobOut]


class JobBatch(Answer):
    """Holds the jobs that one request has queued, one for each capture."""

    jobs: list[JobOut]


class RefusedOne(Answer):
    """Describes why an action was refused for one of the ids in a request."""

    id: str
    type: str = Field(description="as of a problem document")
    detail: TextOf
    detail_message: MessageOut = Field(validation_alias="detail")


class BulkOut(Answer):
    """Holds the result of an action on many things. Each id is in one of the two lists."""

    done: list[str]
    refused: list[RefusedOne]


Ids = Annotated[list[Id], Field(min_length=1, max_length=1000)]


class CaptureBulk(Received):
    """Requests one action on many captures. Each of them succeeds or is refused by itself."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"action": "remove", "ids": [EXAMPLE_ID]}]})

    action: Literal["remove", "erase", "reconstruct", "move", "tag", "untag"] = Field(
        description="remove: pictures go, heads stay; erase: nothing stays; reconstruct: a job each; move: to a "
        "session; tag, untag: adds or takes away tags"
    )
    ids: Ids
    session: Id | None = Field(None, description="of move; null: out of any")
    tags: Tags = Field(default_factory=list, description="of tag and untag")
    model: str | None = Field(None, max_length=200, description="of reconstruct")
    settings: JobSettings | None = Field(None, description="of reconstruct")


class JobBulk(Received):
    """Requests one action on many jobs. Each of them succeeds or is refused by itself."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"action": "cancel", "ids": [EXAMPLE_ID]}]})

    action: Literal["cancel", "restart", "remove"]
    ids: Ids


class NewExport(Received):
    """Requests a job's head in another format."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"as": "obj"}]})

    form: Literal["glb", "ply", "obj", "usdz", "stl", "3mf"] = Field(alias="as")
    template: str | None = Field(None, description="also head-NAME.obj, in this template's vertex order", max_length=40)
    morphs: bool = Field(False, description="also posed.glb, with shapes, eyes and teeth")
    albedo: bool = Field(False, description="also texture/albedo.png")

    def outputs(self) -> dict[str, object]:
        """Returns the settings of the pipeline's outputs that say the same."""
        albedo = "file" if self.albedo else "none"
        return {"formats": [self.form], "template": self.template, "morphs": self.morphs, "albedo": albedo}


class NewDelivery(Received):
    """Requests that a job's result is delivered to an object store."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"to": "s3://studio/heads/"}]})

    to: DeliverTo | None = Field(None, description=f"{DELIVER_TO}; left out, the one that the job was submitted with")
