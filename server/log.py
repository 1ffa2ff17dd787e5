"""Writes log lines to standard error, for people or as JSON. Each log line carries the id of its request or job.

Log lines of libraries have the same form. A job that failed or was cancelled gets one log line, without the job
engine's traceback.
"""

import logging
import sys
from contextlib import suppress
from pathlib import Path

import structlog
from structlog.typing import EventDict

from rig.errors import EigenheadError

NOT_FOR_CALLERS = ("timestamp", "level", "event", "job", "trace", "exc_info")


def log_file(jobs: Path, job_id: str) -> Path:
    """Returns the path of a job's log, which lies beside its result."""
    return jobs / job_id / "log.txt"


class JobLog:
    """Writes, as a structlog processor, each line about a job also to the job's file, for all who may read the job.

    The job's file has no tracebacks, because these reveal internals of the service. A job whose folder was removed has
    no log.
    """

    def __init__(self, jobs: Path) -> None:
        self._jobs = jobs

    def __call__(self, logger: object, method: str, event: EventDict) -> EventDict:
        """Writes a log line that is about a job to the job's file, and returns every line unchanged."""
        if "job" in event and log_file(self._jobs, str(event["job"])).parent.is_dir():
            public = {key: value for key, value in event.items() if key not in NOT_FOR_CALLERS}
            words = " ".join(f"{key}={value}" for key, value in public.items())
            with suppress(OSError), log_file(self._jobs, str(event["job"])).open("a", encoding="utf-8") as stream:
                stream.write(" ".join(filter(None, [event["timestamp"], event["level"], event["event"], words])) + "\n")
        return event


class _OnStandardError(structlog.PrintLogger):
    """Ignores errors of writing a line, as the standard library's handlers do: the disk may be full, or the reader may
    have ended."""

    def msg(self, message: str) -> None:
        with suppress(OSError):
            super().msg(message)

    log = debug = info = warn = warning = msg
    fatal = failure = err = error = critical = exception = msg


def set_up(as_json: bool, level: str = "info", jobs: Path | None = None) -> None:
    """Configures the logging of this process. ``jobs``: the folder of all jobs, if each is to get a log file."""
    shared = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    renderer = (
        structlog.processors.JSONRenderer() if as_json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[*shared, *([] if jobs is None else [JobLog(jobs)]), structlog.processors.format_exc_info, renderer],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=lambda *_: _OnStandardError(sys.stderr),  # the one of this moment: it may be replaced
        cache_logger_on_first_use=False,
    )
    of_libraries = logging.StreamHandler(sys.stderr)
    of_libraries.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[*shared, structlog.stdlib.add_logger_name, structlog.processors.format_exc_info],
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, renderer],
        )
    )
    of_libraries.addFilter(is_no_known_failure)
    engine = logging.getLogger("dbos")
    engine.propagate = False
    for logger in (logging.getLogger(), engine):  # the job engine gives its logger a handler where it finds none
        logger.handlers[:] = [of_libraries]
        logger.setLevel(logging.WARNING)


def is_no_known_failure(record: logging.LogRecord) -> bool:
    """Returns False for a log record with the traceback of a job that failed for a known reason or was cancelled, or of
    a webhook that did not answer, because such failures have their own log lines."""
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return True
    import httpx  # 2 s for both, and a process that logs such a line has them
    from dbos import error as dbos_error

    cancelled = (dbos_error.DBOSWorkflowCancelledError, dbos_error.DBOSAwaitedWorkflowCancelledError)
    return not isinstance(error, (EigenheadError, httpx.HTTPError, *cancelled))
