"""The job engine's inside that the worker leans on is as it was."""

import inspect

import pytest
from dbos import DBOS

from server.worker import engine


def test_the_engine_recovers_the_workflows_of_named_executors() -> None:
    signature = inspect.signature(DBOS._recover_pending_workflows)
    assert [*signature.parameters] == ["executor_ids"]
    assert "WorkflowHandle" in str(signature.return_annotation)


def test_workers_that_died_are_named_to_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    class Handle:
        def get_workflow_id(self) -> str:
            return "job"

    recovered: list[str] = []

    def recover(executors: list[str]) -> list[Handle]:
        recovered.extend(executors)
        return [Handle()]

    monkeypatch.setattr(DBOS, "_recover_pending_workflows", recover)
    assert engine.take_over(("one", "two")) == ["job"]
    assert recovered == ["one", "two"]
