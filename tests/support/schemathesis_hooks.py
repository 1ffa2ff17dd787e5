"""What schemathesis cannot know of the service by itself."""

from typing import Any

import schemathesis


@schemathesis.serializer("application/offset+octet-stream")
def offset_octet_stream(context: Any, value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()
