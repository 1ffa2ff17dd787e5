"""How a job failed survives the job engine's JSON, as data; pickled rows are read, and run nothing."""

import base64
import pickle
from collections import OrderedDict
from types import SimpleNamespace
from typing import cast

import pytest
from dbos import WorkflowStatus
from dbos._serialization import DBOSDefaultSerializer, deserialize_exception, serialize_exception

from rig.messages.message import compose, verbatim
from server.services.failures import SERIALIZER, JobFailed, failure

FAULTS = [compose("located", where="cam03", fault=compose("rim-uncovered", cameras=["cam03"])), "said by a library"]


def row(error: Exception | None, status: str = "ERROR") -> WorkflowStatus:
    return cast(WorkflowStatus, SimpleNamespace(error=error, status=status, workflow_id="j"))


def test_a_failure_keeps_code_and_parameters_through_the_engine() -> None:
    text, kind = serialize_exception(JobFailed("no-subject", compose("worker-died"), FAULTS), None, SERIALIZER)
    found = failure(row(deserialize_exception(text, kind, SERIALIZER)))
    assert (kind, found.type) == ("portable_json", "urn:eigenhead:problem:no-subject")
    assert found.detail == compose("worker-died")
    assert found.errors == (FAULTS[0], verbatim("said by a library"))


def test_the_texts_of_earlier_versions_are_read() -> None:
    """A row of 0.1.0: ``JobFailed`` was a class of ``server.services.jobs``, of texts, with attributes beside."""
    stored = (
        "gASVfgAAAAAAAACMFHNlcnZlci5zZXJ2aWNlcy5qb2JzlIwJSm9iRmFpbGVklJOUjAduby1odWxslIwSTm8gaHVsbCB3YXMgZm91bmQulIwM"
        "Y2FtMDA6IGVtcHR5lIWUh5RSlH2UKIwEa2luZJRoA4wGZGV0YWlslGgEjAZlcnJvcnOUaAZ1Yi4="
    )
    found = failure(row(DBOSDefaultSerializer.deserialize(stored)))
    assert found.detail == verbatim("No hull was found.")
    assert found.errors == (verbatim("cam00: empty"),)


def test_a_pickled_row_runs_no_code() -> None:
    plain = {"args": ({"capture_id": "c", "settings": {"front": 1.5}},), "kwargs": {}}
    assert DBOSDefaultSerializer.deserialize(base64.b64encode(pickle.dumps(plain)).decode()) == plain
    with pytest.raises(pickle.UnpicklingError, match="OrderedDict"):
        DBOSDefaultSerializer.deserialize(base64.b64encode(pickle.dumps(OrderedDict())).decode())


@pytest.mark.parametrize(
    ("status", "kind"), [("MAX_RECOVERY_ATTEMPTS_EXCEEDED", "worker-died"), ("ERROR", "internal-error")]
)
def test_what_nobody_foresaw_is_told_without_its_inside(status: str, kind: str) -> None:
    found = failure(row(ValueError("secret"), status))
    assert found.type.endswith(kind)
    assert "secret" not in found.detail.text
