"""Every refusal has its HTTP status."""

from rig.messages.message import texts_of
from server.errors import Refused
from server.wire.problems import STATUS_OF, problem_from


def test_every_refusal_has_its_status() -> None:
    assert set(STATUS_OF) == {Refused, *Refused.__subclasses__()}
    for kind, status in STATUS_OF.items():
        error = kind.__new__(kind)
        Refused.__init__(error, "kind", "what to do", ["one", "two"], retry_after_s=7)
        problem = problem_from(error)
        assert (problem.status, problem.kind, texts_of(problem.errors)) == (status, "kind", ["one", "two"])
        assert problem.headers == {"Retry-After": "7"}
