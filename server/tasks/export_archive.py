"""Implements the task of an export over HTTP: a finished head in another format, as one archive."""

import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

from rig.progress import Progress
from server.tasks.child import WorkerContext


def export_archive(
    context: WorkerContext, report: Progress, *, result: str, archive: str, outputs: Mapping[str, object]
) -> None:
    """Writes the files that ``outputs`` names from the result in the folder ``result`` to a .zip. Raises InputError,
    and what the writers raise."""
    from pipeline.settings import settings_from_document
    from server.tasks.export_result import export_result

    wanted = settings_from_document({"outputs": outputs}).outputs
    with tempfile.TemporaryDirectory(dir=Path(archive).parent) as scratch, zipfile.ZipFile(archive, "w") as packed:
        for name in export_result(Path(result), Path(scratch), wanted):
            packed.write(Path(scratch) / name, name)
