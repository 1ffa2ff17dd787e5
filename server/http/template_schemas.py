"""Defines the JSON documents about templates: meshes in whose vertex order heads are written."""

from pydantic import Field

from server.http.schemas import Answer


class RegistrationOut(Answer):
    """Describes how well a template was fitted to its model. Distances are in mm: the median, and the value that 95 %
    of vertices stay below (``p95``)."""

    skin_share: float = Field(ge=0, le=1, description="of its vertices, on the model's skin; the others follow it")
    face_covered_share: float = Field(ge=0, le=1, description="of the model's face, that it shows")
    unlike_median_mm: float = Field(description="between the mesh as it came and the nearest head of the model")
    unlike_p95_mm: float
    off_median_mm: float = Field(description="between the mesh drawn onto that head and the head")
    off_p95_mm: float


class TemplateOut(Answer):
    """Describes a template: a mesh in whose vertex order a job writes its head if ``settings.outputs.template`` names
    it."""

    id: str = Field(description="what a job calls it")
    name: str
    source: str | None = Field(description="file of the mesh")
    sha256: str | None = Field(description="of that file")
    model: str | None = Field(description="that it was registered to; a job with another one is refused")
    models: list[str] = Field(description="names of that model at /v1/models; none where it is not at hand")
    vertices: int | None
    registration: RegistrationOut | None
    fault: str | None = Field(description="why it cannot be used, and nothing else is known of it; null: it can")


class TemplateList(Answer):
    """Holds the templates at hand, sorted by name."""

    templates: list[TemplateOut]
