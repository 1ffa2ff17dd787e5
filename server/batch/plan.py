"""Plans a batch: each capture with its settings and model, all checked before any work begins."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version

from pipeline.applications.templates.header import check_template
from pipeline.head_model.model_names import model_path, model_sha256
from pipeline.settings import document_from_settings, settings_from_document
from rig.errors import EigenheadError, InputError
from rig.files import document_sha256
from rig.messages.message import Message, compose
from server.batch.captures import BatchCapture
from server.tasks.settings_file import merged_settings
from server.tasks.stage_durations import StageDurations, megapixels_of


@dataclass(frozen=True, slots=True)
class BatchTask:
    """Holds one capture of a batch with everything that its result depends on, except the content of its files.
    ``expected_s``: expected seconds of each stage."""

    capture: BatchCapture
    settings: Mapping[str, object]
    settings_sha256: str
    model: str | None
    model_sha256: str
    version: str
    expected_s: Mapping[str, float]


def plan_batch(
    captures: Iterable[BatchCapture], settings: Mapping[str, object], model: str | None
) -> tuple[BatchTask, ...]:
    """Makes one task for each capture, and checks settings, model and template of each. ``settings`` apply to all
    captures; a capture's own settings override them.

    Raises UnknownModel, BadTemplate or UnknownTemplate for what all captures share, and InputError naming the captures
    with wrong settings.
    """
    path = model_path(model or "default")
    check_template(settings_from_document(settings).outputs.template, model or "default")
    digest, durations, faults = model_sha256(path), StageDurations(), list[Message]()
    tasks = []
    for capture in captures:
        try:
            chosen = settings_from_document(merged_settings(settings, capture.settings))
            check_template(chosen.outputs.template, model or "default")
        except InputError as error:
            faults += [compose("located", where=capture.name, fault=fault) for fault in error.faults]
            continue
        except EigenheadError as error:
            faults.append(compose("located", where=capture.name, fault=error.message))
            continue
        document, expected_s = document_from_settings(chosen), durations.of(chosen, megapixels_of(capture.path))
        wanted = (document, document_sha256(document), model, digest)
        tasks.append(BatchTask(capture, *wanted, version("eigenhead"), expected_s))
    if faults:
        raise InputError("settings", faults)
    return tuple(tasks)
