"""Applies one action to many objects, each of which succeeds or is refused independently."""

from collections.abc import Callable, Iterable

from pydantic import Field

from rig.errors import EigenheadError, InputError
from rig.messages.message import compose
from server.errors import Refused, unusable_input
from server.problem_types import URN
from server.services.answer import Answer, Said, as_data


class RefusedOne(Answer):
    """Describes why an action was refused for one of the ids in a request."""

    id: str
    type: str = Field(description="as of a problem document")
    detail: Said
    detail_message = as_data("detail")


class BulkOut(Answer):
    """Holds the result of an action on many objects. Each id is in one of the lists ``done`` and ``refused``."""

    done: list[str]
    refused: list[RefusedOne]


def apply_each(ids: Iterable[str], action: Callable[[str], object]) -> BulkOut:
    """Calls ``action`` once for every different id and collects the results. A refusal for one id does not stop the
    others. Exceptions other than EigenheadError pass through."""
    done, refused = [], []
    for identity in dict.fromkeys(ids):
        try:
            action(identity)
            done.append(identity)
        except EigenheadError as error:
            problem = unusable_input(error) if isinstance(error, InputError) else error
            kind = problem.kind if isinstance(problem, Refused) else "internal-error"
            detail = compose("several", messages=error.faults) if isinstance(error, InputError) else problem.message
            refused.append(RefusedOne(id=identity, type=URN + kind, detail=detail))
    return BulkOut(done=done, refused=refused)
