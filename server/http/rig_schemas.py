"""Documents on the wire of what the rig's pictures are worth."""

from pydantic import Field

from server.http.schemas import Answer


class SubjectOut(Answer):
    share: float = Field(description="of the picture's area")
    cut_off: list[str] = Field(description="edges of the picture that cut the head: top, left, right")
    outline: list[list[float]] = Field(description="corners, in pixels of the picture")


class ViewChecksOut(Answer):
    """What was measured of one camera's picture."""

    mean: float | None = Field(None, description="mean value, 0 to 255")
    clipped_share: float | None = Field(None, description="of pixels at 255 in every channel")
    blur_px: float | None = Field(None, description="standard deviation of the edge spread")
    background_found: float | None = Field(None, description="share of the clean plate's patches that were found")
    background_moved_px: float | None = None
    subject: SubjectOut | None = None


class CaptureChecks(Answer):
    cameras: dict[str, ViewChecksOut]
