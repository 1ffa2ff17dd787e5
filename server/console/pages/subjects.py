"""Implements the page Subjects: cards of people with a picture of the newest head and links to shots and heads."""

from collections.abc import Mapping
from typing import cast, get_args

from server.console.page import Action, Page, serve_page, shared
from server.console.pages.captures import new_session
from server.services.service import Service
from server.storage.library import SubjectOrder
from server.storage.records import JsonObject

SHOWN = 48
ASKED = ("find", "tag", "sort", "after")


class SubjectsPage(Page, component="subjects.js"):
    """Shows the people of the library, each with a picture of the newest head."""

    def look(self) -> JsonObject:
        """Returns one page of the list of subjects."""
        requested = {name: self.choice.get(name) or None for name in ASKED}
        return shared.get(("subjects", *requested.values()), 1.0, lambda: subjects_state(self.service, requested))


def subjects_state(service: Service, requested: Mapping[str, str | None]) -> JsonObject:
    """Returns one page of the subjects that match a search and a tag, in the requested order, and the tags of all
    captures, to choose from."""
    order = cast(SubjectOrder, requested["sort"] if requested["sort"] in get_args(SubjectOrder) else "-created")
    subjects = service.sessions.subjects(
        requested["find"] or "", order, SHOWN, requested["after"], tag=requested["tag"]
    )
    return {
        "subjects": [subject.model_dump() for subject in subjects.items],
        "tags": shared.get("tags", 1.0, service.captures.tags),
        "next": subjects.next,
        "total": subjects.total,
    }


SubjectsPage.actions = {"new_session": Action("capture", new_session)}


serve_page("subjects", SubjectsPage, choices=("find", "tag", "sort"), paths=("/subjects",))
