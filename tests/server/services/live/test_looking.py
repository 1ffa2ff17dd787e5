"""Pictures of a camera that delivers rubbish."""

import numpy as np

from server.services.live.looking import look
from server.tasks.child import WorkerContext


def test_a_file_that_cannot_be_decoded_is_no_picture_and_the_others_are_looked_at() -> None:
    grey = np.full((120, 160, 3), 128, np.uint8)
    seen = look(WorkerContext(), {"cam0": b"no picture", "cam1": b"", "cam2": grey}, None, None, None)
    assert [*seen.cameras] == ["cam2"]
