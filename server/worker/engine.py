"""What the worker needs of the job engine's inside.

The public ``resume_workflow`` takes a job from whoever has it by now, revives a cancelled one, and forgets how many
workers the job took down with it. ``DBOS._recover_pending_workflows`` is what the engine itself does at its start: it
changes only rows that still belong to the named executors. A test holds its shape.
"""

from collections.abc import Sequence

from dbos import DBOS


def take_over(executors: Sequence[str]) -> list[str]:
    """Puts the pending workflows of these executors back into their queues; returns the ids of the workflows."""
    return [handle.get_workflow_id() for handle in DBOS._recover_pending_workflows([*executors])]
