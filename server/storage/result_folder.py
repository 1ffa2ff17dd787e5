"""Replaces the result in a folder that a user named, without ever leaving a partial result.

The new result is written beside the folder and moved in file by file when it is complete, report.json last, because the
folder itself may be a mount or a shell's working directory. All files of an earlier result are removed. Files that
belong to no result stay.
"""

import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

RESULT_FILE = re.compile(
    r"^((head|bust|neutral|posed|turntable|contact_sheet)[\w-]*\.\w+|report\.json|landmarks\.mrk\.json|batch\.json|overlays|texture)$"
)


@contextmanager
def fresh_folder(out: Path) -> Iterator[Path]:
    """Yields an empty folder whose content replaces the result in ``out`` when the block ends. After an error in the
    block, ``out`` stays as it was. Raises OSError at once if ``out`` cannot be written."""
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(20, "Not a directory", str(out))
    out.parent.mkdir(parents=True, exist_ok=True)
    made = out.resolve().parent / f".{out.resolve().name or 'result'}.{secrets.token_hex(6)}"
    made.mkdir()
    try:
        yield made
        _swap(made, out)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _swap(made: Path, out: Path) -> None:
    if not out.exists():
        made.rename(out)
        return
    for old in list(out.iterdir()):
        if RESULT_FILE.match(old.name):
            shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()
    for new in sorted(made.iterdir(), key=lambda path: path.name == "report.json"):
        target = out / new.name
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target)
        new.replace(target)
