"""Finds the captures of a batch below a folder, or reads them from a list with subject, session and settings.

A capture's name is the path of its result below ``OUT``. A list is a text file with one capture in each line (``#``
begins a comment), or a CSV file whose first row names its columns; relative paths start at the list's folder. A hash of
each capture's name assigns it to one of several machines, which need not communicate. The SHA-256 of a capture tells a
later run whether its result is up to date."""

import csv
import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from rig.errors import InputError
from rig.files import sha256_of
from rig.formats.cameras.cameras_file import find_rig_file
from rig.formats.captures.shot_files import ASIDE, listed_pictures
from rig.formats.pictures.picture_names import entry, is_junk
from rig.messages.message import Message, compose
from rig.text import suggest
from server.tasks.settings_file import read_settings_file, reason_of, settings_of_text

ARCHIVES = (".tar.gz", ".tgz", ".tar", ".zip")
COLUMNS = ("capture", "name", "subject", "session", "settings")
MIN_PICTURES = 3  # in a folder of photographs without cameras: fewer are no capture
TAKEN_NAMES = ("heads.csv", "heads.parquet", "sheet.html", "sheet.pdf")  # files of OUT, which no capture may be called
MORE = "more"  # key of a row: how many cells it has beyond the columns
NO_SETTINGS: Mapping[str, object] = MappingProxyType({})
SHARDS_MOST = 100_000


@dataclass(frozen=True, slots=True)
class BatchCapture:
    """Holds one capture of a batch. ``name``: name of the result's folder, relative to ``OUT``; ``settings``: settings
    of this capture, which override the batch's."""

    name: str
    path: Path
    subject: str = ""
    session: str = ""
    settings: Mapping[str, object] = field(default_factory=lambda: NO_SETTINGS)


def find_captures(folder: Path, out: Path) -> tuple[BatchCapture, ...]:
    """Finds all captures below a folder, sorted by name. Skips ``out`` and folders of results.

    Raises InputError if there is none, if the folder itself is a capture, and if the results of several captures would
    have one folder (the error names all of them).
    """
    if is_capture(folder) and (find_rig_file(folder) is not None or entry(folder, "images").is_dir()):
        raise InputError(folder.name, [compose("batch-folder-is-capture")])
    captures = [BatchCapture(_name(path, folder), path) for path in _walk(folder, Path(os.path.realpath(out)))]
    if not captures:
        raise InputError(folder.name, [compose("batch-folder-empty")])
    faults = _name_faults(captures, [capture.path.relative_to(folder).as_posix() for capture in captures])
    if faults:
        raise InputError(folder.name, faults)
    return tuple(sorted(captures, key=lambda capture: capture.name))


def is_capture(path: Path) -> bool:
    """Returns whether a path is a capture: an archive, or a folder with cameras or at least ``MIN_PICTURES``
    photographs."""
    if path.is_file():
        return is_archive(path)
    if find_rig_file(path) is not None or entry(path, "images").is_dir():
        return True
    return len(listed_pictures(path)) >= MIN_PICTURES


def is_archive(path: Path) -> bool:
    """Returns whether a file's name ends like that of an archive."""
    return path.name.lower().endswith(ARCHIVES)


def read_list(path: Path) -> tuple[BatchCapture, ...]:
    """Reads a list of captures and returns them in the list's order. Raises InputError naming every fault with its
    line."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(path.name, [compose("batch-list-unreadable", reason=reason_of(error))]) from error
    faults: list[Message] = []
    rows = list(_csv_rows(text, faults) if _is_csv(path, text) else _text_rows(text))
    chosen: dict[int, BatchCapture] = {}
    for line, row in rows:
        wrong: list[Message] = []
        if MORE in row:
            wrong.append(compose("batch-cells-many", cells=len(row) - 1 + int(row[MORE]), columns=len(row) - 1))
        else:
            chosen[line] = _capture_of(row, path.parent, wrong)
        faults += [compose("batch-line", line=line, fault=fault) for fault in wrong]
    if not rows and not faults:
        faults.append(compose("batch-list-empty"))
    named = {line: capture for line, capture in chosen.items() if capture.name}
    places = [compose("batch-line-number", line=line).text for line in named]
    faults += _name_faults(list(named.values()), places)
    if faults:
        raise InputError(path.name, faults)
    return tuple(chosen.values())


def _walk(folder: Path, out: Path) -> Iterator[Path]:
    for path in sorted(folder.iterdir()):
        aside = is_junk(path.name) or path.name.endswith(".truth") or path.name.lower() in ASIDE
        if aside or not path.exists() or path.resolve() == out:
            continue
        if is_capture(path):
            yield path
        elif path.is_dir() and not path.is_symlink() and not (path / "report.json").is_file():
            yield from _walk(path, out)


def _name(path: Path, folder: Path) -> str:
    """Returns a capture's name: its path below ``folder``, or the path's last part if the capture lies elsewhere,
    without an archive's suffix."""
    below = path.relative_to(folder) if path.is_relative_to(folder) else Path(path.resolve().name)
    name = below.as_posix()
    if path.is_dir():
        return name
    ending = next((ending for ending in ARCHIVES if name.lower().endswith(ending)), "")
    return name[: len(name) - len(ending)]


def _is_csv(path: Path, text: str) -> bool:
    first = text.lstrip().partition("\n")[0]
    return path.suffix.lower() == ".csv" or "capture" in (cell.strip() for cell in first.split(","))


def _text_rows(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    for number, line in enumerate(text.splitlines(), 1):
        capture = line.strip()
        if capture and not capture.startswith("#"):
            yield number, {"capture": capture}


def _csv_rows(text: str, faults: list[Message]) -> Iterator[tuple[int, dict[str, str]]]:
    if not text.strip():
        return
    reader = csv.reader(text.splitlines(keepends=True), skipinitialspace=True)
    header = [cell.strip() for cell in next(reader, [])]
    faults += _header_faults(header)
    if "capture" not in header:
        return
    for cells in reader:
        if not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#"):
            continue
        row = {name: cell.strip() for name, cell in zip(header, cells, strict=False)}
        more = len(cells) - len(header)
        yield reader.line_num, row | ({MORE: str(more)} if more > 0 else {})


def _header_faults(header: list[str]) -> list[Message]:
    faults = []
    if "capture" not in header:
        faults.append(compose("batch-column-missing", columns=header or ["-"]))
    for name in header:
        if name not in COLUMNS:
            near = suggest(name, COLUMNS)
            faults.append(
                compose("batch-column-unknown-near", column=f"{name!r}", near=near[0])
                if near
                else compose("batch-column-unknown", column=f"{name!r}", known=COLUMNS)
            )
    faults += [compose("batch-column-twice", column=name) for name, count in Counter(header).items() if count > 1]
    return faults


def _capture_of(row: Mapping[str, str], folder: Path, faults: list[Message]) -> BatchCapture:
    settings: dict[str, object] = {}
    if row.get("settings"):
        try:
            settings = _settings_of(row["settings"], folder)
        except InputError as error:
            faults += error.located()
    if not row.get("capture"):
        faults.append(compose("batch-capture-unnamed"))
        return BatchCapture("", folder)
    path = folder / Path(row["capture"]).expanduser()
    if not path.exists():
        faults.append(compose("batch-capture-missing", path=str(path)))
    elif not path.is_dir() and not is_capture(path):
        faults.append(compose("batch-capture-strange", path=str(path)))
    name = row.get("name") or _name(path, folder)
    return BatchCapture(name, path, row.get("subject", ""), row.get("session", ""), MappingProxyType(settings))


def _settings_of(text: str, folder: Path) -> dict[str, object]:
    """Reads the settings in a cell: a JSON object, or the path of a JSON or TOML file."""
    return settings_of_text(text) if text.startswith("{") else read_settings_file(folder / text)


def _name_faults(captures: list[BatchCapture], places: list[str]) -> list[Message]:
    """Returns faults of names: a name that cannot be a folder below OUT, two equal names, and a folder inside another
    capture's folder."""
    faults: list[Message] = []
    folded: dict[str, list[str]] = {}
    for capture, position in zip(captures, places, strict=True):
        folded.setdefault(capture.name.casefold(), []).append(position)
        parts = capture.name.split("/")
        if any(not part or part.startswith(".") or "\0" in part or "\\" in part for part in parts) or (
            parts[0].casefold() in TAKEN_NAMES
        ):
            faults.append(compose("batch-name-wrong", name=f"{capture.name!r}", where=position))
    for name, where in folded.items():
        if len(where) > 1:
            faults.append(compose("batch-name-twice", name=name, where=where))
        parts = name.split("/")
        parents = [outer for count in range(1, len(parts)) if (outer := "/".join(parts[:count])) in folded]
        faults += [compose("batch-name-within", name=name, outer=parent) for parent in parents]
    return faults


@dataclass(frozen=True, slots=True)
class Shard:
    """Describes the part of a batch that one machine makes: part ``number`` (from 1) of ``count``."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def takes(self, name: str) -> bool:
        """Returns whether the capture with this name belongs to this part; each capture belongs to exactly one."""
        digest = hashlib.sha256(name.encode()).digest()
        return int.from_bytes(digest[:8], "big") % self.count == self.number - 1


WHOLE = Shard(1, 1)


def read_shard(text: str) -> Shard:
    """Reads a part of a batch from the text K/N, where K is from 1 to N. Raises InputError."""
    parts = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text.strip())
    number, count = (int(parts[1]), int(parts[2])) if parts else (0, 0)
    if not 1 <= number <= count <= SHARDS_MOST:
        raise InputError("shard", [compose("batch-shard-wrong", text=f"{text!r:.40}", most=SHARDS_MOST)])
    return Shard(number, count)


def capture_sha256(path: Path) -> str:
    """Computes the SHA-256 of a capture: of an archive's bytes, or of the names and bytes of all files in a folder.
    Raises OSError."""
    if not path.is_dir():
        return sha256_of(path)
    return files_sha256({name: sha256_of(file) for name, file in _files(path, "", frozenset())})


def files_sha256(files: Mapping[str, str]) -> str:
    """Computes one SHA-256 of a whole folder from the SHA-256 of each of its files, by name."""
    digest = hashlib.sha256()
    for name, file_digest in sorted(files.items()):
        digest.update(f"{name}\0{file_digest}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _files(folder: Path, prefix: str, within: frozenset[tuple[int, int]]) -> Iterator[tuple[str, Path]]:
    """Yields the files below a capture with their paths, following links. ``within`` identifies the enclosing folders,
    so that circular links end."""
    state = folder.stat()
    if (here := (state.st_dev, state.st_ino)) in within:
        return
    for path in folder.iterdir():
        if is_junk(path.name):
            continue
        if path.is_dir():
            yield from _files(path, f"{prefix}{path.name}/", within | {here})
        elif path.is_file():  # not of a link to itself
            yield f"{prefix}{path.name}", path
