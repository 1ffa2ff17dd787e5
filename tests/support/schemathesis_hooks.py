"""What schemathesis cannot know of the service by itself."""

from typing import Any

import schemathesis

SHOTS = 3  # the studio draws each for ten seconds and more
NOBODY = "0" * 28  # a session: a shot for it is refused before it is taken
_taken: list[str] = []


@schemathesis.serializer("application/offset+octet-stream")
def offset_octet_stream(context: Any, value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


@schemathesis.hook
def before_call(context: Any, case: Any, kwargs: dict[str, Any]) -> None:
    if len(_taken) >= SHOTS and _asks_for_shot(case) and case.body.get("session") is None:
        case.body["session"] = NOBODY


@schemathesis.hook
def after_call(context: Any, case: Any, response: Any) -> None:
    if response.status_code == 201 and _asks_for_shot(case):
        _taken.append(response.text)


def _asks_for_shot(case: Any) -> bool:
    return case.operation.label == "POST /v1/captures" and isinstance(case.body, dict)
