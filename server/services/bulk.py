"""Does one action on many things, each of which succeeds or is refused by itself."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from rig.errors import EigenheadError, InputError
from rig.messages.message import Message, compose
from server.errors import Refused, unusable_input
from server.problem_types import URN


@dataclass(frozen=True, slots=True)
class RefusedOne:
    """Holds why an action was refused for one thing. ``type`` and ``detail`` are those of the problem document (RFC
    9457) that a request for this thing alone would have been answered with."""

    id: str
    type: str
    detail: Message


@dataclass(frozen=True, slots=True)
class Bulk:
    """Holds the outcome of one action on many things: the ids for which it was done, and the refusals."""

    done: tuple[str, ...]
    refused: tuple[RefusedOne, ...]


def each(ids: Iterable[str], action: Callable[[str], object]) -> Bulk:
    """Calls ``action`` once for every different id and collects the outcomes. A refusal for one id does not stop the
    others. Exceptions that are no EigenheadError pass through."""
    done, refused = [], []
    for identity in dict.fromkeys(ids):
        try:
            action(identity)
            done.append(identity)
        except EigenheadError as error:
            problem = unusable_input(error) if isinstance(error, InputError) else error
            kind = problem.kind if isinstance(problem, Refused) else "internal-error"
            detail = compose("several", messages=error.faults) if isinstance(error, InputError) else problem.message
            refused.append(RefusedOne(identity, URN + kind, detail))
    return Bulk(tuple(done), tuple(refused))
