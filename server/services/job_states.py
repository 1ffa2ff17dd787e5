"""What the job engine calls the service's work, and its statuses in the words of the service."""

from dataclasses import replace

from server.storage.job_index import JobQuery

APPLICATION = "eigenhead"
APPLICATION_VERSION = "eigenhead-jobs-1"  # pinned: a job outlives an upgrade; changes only with the steps themselves
WORKFLOW = "reconstruct"
DELIVERY = "deliver"
STATES = {
    "DELAYED": "queued",
    "ENQUEUED": "queued",
    "PENDING": "running",
    "SUCCESS": "succeeded",
    "ERROR": "failed",
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": "failed",
    "CANCELLED": "cancelled",
}
STATUSES = {state: [s for s, t in STATES.items() if t == state] for state in set(STATES.values())}
FINISHED = ("succeeded", "failed", "cancelled")


def select_by_state(query: JobQuery) -> JobQuery:
    """Returns a query whose words that name a state ("failed") select jobs in that state instead of being searched for.
    Other words, and the query's statuses, stay in force."""
    words = query.sought.split()
    states = [word.casefold() for word in words if word.casefold() in STATUSES]
    if not states:
        return query
    statuses = [status for state in states for status in STATUSES[state]]
    both = statuses if query.statuses is None else [status for status in statuses if status in query.statuses]
    rest = " ".join(word for word in words if word.casefold() not in STATUSES)
    return replace(query, sought=rest, statuses=both)
