"""Declares the request for a job, and checks whether the job is possible."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.settings import TEMPLATE_NAME, settings_from_document
from rig.errors import EigenheadError, InputError
from rig.messages.message import Message, compose
from server.errors import Conflict
from server.services.texts import check_texts
from server.storage.records import CaptureRecord, JobWebhook
from server.tasks.film import film_setting_faults


@dataclass(frozen=True, slots=True)
class ReconstructionRequest:
    """Holds the request for a job: the model's name and the settings of the pipeline (None: the defaults), the job's
    name, a webhook that is called at its end besides those of the service, and a place in an object store to which its
    result is delivered."""

    model: str | None = None
    settings: Mapping[str, object] | None = None
    name: str = ""
    webhook: JobWebhook | None = None
    deliver_to: str | None = None

    def check(self, *, film: bool = False) -> None:
        """Raises InputError naming an invalid job name, an unknown model, every wrong setting (of a ``film`` or a shot)
        and a template that the model does not have, so that no job fails hours later because of such faults."""
        check_texts({"name": self.name}, "request")
        settings = film_setting_faults(self.settings or {}) if film else self._settings_faults()
        model = self._model_faults()
        if model and settings:
            named = (("model", model), ("settings", settings))
            faults = [compose("located", where=name, fault=fault) for name, found in named for fault in found]
            raise InputError("request", faults)
        if model or settings:
            raise InputError("model" if model else "settings", model or settings)

    def _model_faults(self) -> list[Message]:
        from pipeline.head_model.model_names import list_models

        known = ["default", *list_models()]
        if self.model is None or self.model in known:
            return []
        return [compose("model-not-at-hand", model=f"{self.model!r:.80}", known=known)]

    def _settings_faults(self) -> list[Message]:
        document, faults = self.settings or {}, list[Message]()
        try:
            settings_from_document(document)
        except InputError as error:
            faults += error.faults
        outputs = document.get("outputs")
        name = outputs.get("template") if isinstance(outputs, Mapping) else None
        if isinstance(name, str) and TEMPLATE_NAME.fullmatch(name):
            faults += _template_faults(name, self.model or "default")
        return faults


def _template_faults(name: str, model: str) -> list[Message]:
    from pipeline.applications.templates.header import check_template, template_path
    from pipeline.head_model.model_names import UnknownModel

    try:
        template_path(name)
        check_template(name, model)
    except UnknownModel:
        return []  # told beside it
    except EigenheadError as error:
        return [compose("located", where="outputs.template", fault=error.message)]
    return []


def check_kind(record: CaptureRecord, *, film: bool = False) -> None:
    """Raises Conflict for a capture of the calibration board and, without ``film``, for a film."""
    if record.board:
        raise Conflict("board-shot", compose("board-shot"))
    if record.frames and not film:
        raise Conflict("film-capture", compose("film-capture"))
