"""What the worker needs of the job engine: its configuration, and one thing of its inside.

DBOS's public resume_workflow takes a job from whoever has it by now, revives a cancelled one, and forgets how many
workers the job took down with it. ``DBOS._recover_pending_workflows`` is what the engine itself does at its start: it
changes only rows that still belong to the named executors. A test holds its shape.
"""

from collections.abc import Sequence

from dbos import DBOS, DBOSConfig

from server.services.job_rows import APPLICATION, APPLICATION_VERSION
from server.settings import ServiceSettings


def engine_config(settings: ServiceSettings, executor_id: str) -> DBOSConfig:
    return {
        "name": APPLICATION,
        "system_database_url": settings.url,
        "application_version": APPLICATION_VERSION,
        "executor_id": executor_id,
        "enable_otlp": False,
        "log_level": "WARNING",
        "notification_listener_polling_interval_sec": 1.0,
    }


def take_over(executors: Sequence[str]) -> list[str]:
    """Puts the pending workflows of the named executors back into their queues. Returns the workflows' ids."""
    return [handle.get_workflow_id() for handle in DBOS._recover_pending_workflows([*executors])]
