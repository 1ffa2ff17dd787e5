"""Log lines on standard error: for people, or JSON for machines. Each carries the request's or job's id.

Lines of libraries take the same way. How a job failed or was cancelled is said in a line of ours; the job engine's own
traceback of it is left out.
"""

import logging
import sys

import structlog

from rig.errors import EigenheadError


def set_up(as_json: bool, level: str = "info") -> None:
    """Configures this process's logging."""
    shared = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    renderer = (
        structlog.processors.JSONRenderer() if as_json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[*shared, structlog.processors.format_exc_info, renderer],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),  # the one of this moment: it may be replaced
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
    """False for the traceback of a job that failed for a known reason, or was cancelled."""
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return True
    from dbos import error as dbos_error  # 2 s, and a process that logs such a line has it

    return not isinstance(error, EigenheadError | dbos_error.DBOSWorkflowCancelledError)
