"""Configures the job engine (DBOS) for the worker, and takes jobs of dead workers back.

DBOS's public resume_workflow is not used for that: it takes a job from whoever has it by now, revives a cancelled one,
and forgets how many workers the job took down. ``DBOS._recover_pending_workflows``, which DBOS itself calls when it
starts, changes only rows that still belong to the named workers ("executors" in DBOS). A test checks that this private
function still exists in this form.
"""

from collections.abc import Sequence

from dbos import DBOS, DBOSConfig

from server.services.job_rows import APPLICATION, APPLICATION_VERSION
from server.settings import ServiceSettings


def engine_config(settings: ServiceSettings, executor_id: str) -> DBOSConfig:
    """Returns the job engine's configuration for the worker ``executor_id``."""
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
    """Puts the running workflows of the named workers back into their queues. Workflows that another worker has taken
    meanwhile are left alone. Returns the ids of those put back."""
    return [handle.get_workflow_id() for handle in DBOS._recover_pending_workflows([*executors])]
