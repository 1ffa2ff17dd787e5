"""What a job is asked for."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.settings import settings_from_document
from rig.errors import InputError
from server.storage.records import JobWebhook


@dataclass(frozen=True, slots=True)
class Work:
    """What a job is asked for: a model's name and settings of the pipeline, the default ones where they are None; what
    people call it, and who is told of its end beside the service's webhooks."""

    model: str | None = None
    settings: Mapping[str, object] | None = None
    name: str = ""
    webhook: JobWebhook | None = None

    def check(self) -> None:
        """Raises InputError naming an unknown model or template and every wrong setting, before a job fails by it hours
        later."""
        from pipeline.eigenheads.model_names import list_models

        known, settings_fault = list_models(), None
        try:
            _check_template(settings_from_document(self.settings or {}).outputs.template)
        except InputError as error:
            settings_fault = error
        if self.model is not None and self.model != "default" and self.model not in known:
            fault = f"{self.model!r:.80} is not at hand; there are: {', '.join(['default', *known])}"
            if settings_fault is None:
                raise InputError("model", [fault])
            raise InputError("request", [f"model: {fault}", *(f"settings: {f}" for f in settings_fault.faults)])
        if settings_fault is not None:
            raise settings_fault


def _check_template(name: str | None) -> None:
    from pipeline.templates.names import UnknownTemplate, list_templates

    if name is not None and name not in list_templates():
        raise InputError("settings", [f"outputs.template: {UnknownTemplate(name)}"])
