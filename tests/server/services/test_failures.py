"""How a job failed survives the job engine's pickle, as data; what earlier versions stored is read as text."""

import pickle
from types import SimpleNamespace
from typing import cast

import pytest
from dbos import WorkflowStatus
from dbos._serialization import DBOSDefaultSerializer

from rig.messages.message import compose, verbatim
from server.services.failures import JobFailed, failure

FAULTS = [compose("located", where="cam03", fault=compose("rim-uncovered", cameras=["cam03"])), "said by a library"]


def row(error: Exception | None, status: str = "ERROR") -> WorkflowStatus:
    return cast(WorkflowStatus, SimpleNamespace(error=error, status=status, workflow_id="j"))


def test_a_failure_keeps_code_and_parameters_through_the_engine() -> None:
    error = pickle.loads(pickle.dumps(JobFailed("no-hull", compose("worker-died"), FAULTS)))
    found = failure(row(error))
    assert found.type == "urn:eigenhead:problem:no-hull"
    assert found.detail == compose("worker-died")
    assert found.errors == (FAULTS[0], verbatim("said by a library"))
    assert str(error) == found.detail.text


def test_only_plain_values_are_pickled() -> None:
    assert b"rig.messages" not in pickle.dumps(JobFailed("no-hull", compose("worker-died"), FAULTS))


def test_the_texts_of_earlier_versions_are_read() -> None:
    """A row of 0.1.0: ``JobFailed`` was a class of ``server.services.jobs``, of texts, with attributes beside."""
    stored = (
        "gASVfgAAAAAAAACMFHNlcnZlci5zZXJ2aWNlcy5qb2JzlIwJSm9iRmFpbGVklJOUjAduby1odWxslIwSTm8gaHVsbCB3YXMgZm91bmQulIwM"
        "Y2FtMDA6IGVtcHR5lIWUh5RSlH2UKIwEa2luZJRoA4wGZGV0YWlslGgEjAZlcnJvcnOUaAZ1Yi4="
    )
    found = failure(row(DBOSDefaultSerializer.deserialize(stored)))
    assert found.detail == verbatim("No hull was found.")
    assert found.errors == (verbatim("cam00: empty"),)


@pytest.mark.parametrize(
    ("status", "kind"), [("MAX_RECOVERY_ATTEMPTS_EXCEEDED", "worker-died"), ("ERROR", "internal-error")]
)
def test_what_nobody_foresaw_is_told_without_its_inside(status: str, kind: str) -> None:
    found = failure(row(ValueError("secret"), status))
    assert found.type.endswith(kind)
    assert "secret" not in found.detail.text
