"""Pages of reference that are made of the program itself: ``make reference`` writes them, a test holds them true.

Commands from the command line's own help, variables and settings from the fields that are read, with the comment or
description beside each.
"""

import ast
import dataclasses
import io
import json
import re
import tokenize
import typing
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import typer
import typer.main
from pydantic_core import PydanticUndefined
from typer.core import TyperGroup

from pipeline import settings
from pipeline.settings import Settings
from rig.files import write_atomically
from rig.formats import rig_toml
from server.cli.main import ROOMS, app
from server.settings import PREFIX, ServiceSettings

DOCS = Path(__file__).resolve().parents[2] / "docs"
MADE = "<!-- Made of the program by `make reference`; changes belong there. -->\n"
WIDTH = 100
OF_ALL = re.compile(r"\n  (?:--json|--threads N|--quiet|-h, --help) [^\n]*(?:\n {6,}[^\n]*)*")
COMMANDS = f"""# Commands

{MADE}
`eigenhead COMMAND --help` says the same as these pages. Exit status: 0 done,
1 failed, with one line on standard error that says why and what to do, 2 wrong usage.

All take `--threads N` (of compiled loops; all processors by default), `--quiet` (no progress and no warnings,
errors alone) and `--help`; most take `--json` (one JSON object on stdout and nothing else).

| command | does |
|---|---|"""
VARIABLES = f"""# Environment variables

{MADE}
A variable that is set to nothing counts as not set. One that begins
with `EIGENHEAD_` and that nobody reads is named by `eigenhead doctor`. Lists are JSON:
`{PREFIX}CORS_ORIGINS='["https://lab.example"]'`.
"""
SETTINGS = f"""# Settings of a reconstruction

{MADE}
A settings document is TOML or JSON: a file for `eigenhead
reconstruct --settings`, or a job's `settings` over HTTP:
`{{"detail": "photo", "outputs": {{"formats": ["glb"]}}}}`. Unknown fields and wrong values are refused,
all at once, with what was meant. The default stands behind each name."""
RIG_TOML = f"""# rig.toml

{MADE}
The real rig: cameras, trigger box, lamps, and what a shot must be like. `eigenhead rig
check --rig rig.toml` names every fault of the file at once; `deploy/rig.example.toml` is one to begin
with. Relative paths start at the file. What each driver needs: [the rig](rig.md#cameras-by-driver)."""
OF_EVERY_COMMAND = {
    "CACHE": (
        "$XDG_CACHE_HOME/eigenhead, else ~/.cache/eigenhead",
        "what can be made again: compiled loops, seconds of stages",
    ),
    "MODELS": ("models in the data folder", "where head models lie"),
    "THREADS": ("the processors that the process may use", "threads of a job's compiled loops"),
    "DEBUG": ("", "1: commands end with their traceback"),
}
OF_OTHERS = {
    "COMPLETE": ("", "set by shells while they complete a command"),
    "WHEEL_LOOPS": ("", "1, while a wheel is built: it carries the loops compiled"),
    "DOMAIN": ("", "`deploy/Caddyfile`: the name that the proxy answers to"),
    "UPSTREAM": ("", "`deploy/Caddyfile`: where the service is"),
    "CHROMIUM": ("", "the tests: another Chromium than Debian's"),
    "SCREENSHOTS": ("out/screenshots", "the tests: where pictures of the pages go"),
}


def pages() -> dict[str, str]:
    """Returns every page that is made, by its path below docs/."""
    commands = typer.main.get_command(app)
    assert isinstance(commands, TyperGroup)
    made = {f"commands/{name}.md": _command_page(commands, *room) for name, room in ROOMS.items()}
    made |= {"commands.md": _command_list(commands), "environment.md": _variables()}
    return made | {"settings.md": _settings(), "rig-toml.md": _rig_toml()}


def _command_list(commands: TyperGroup) -> str:
    lines = [COMMANDS]
    for page, (_, names) in ROOMS.items():
        for path, command in (entry for name in names for entry in _leaves((name,), commands.commands[name])):
            words = " ".join(path)
            anchor = f"eigenhead-{'-'.join(path)}"
            first = (command.help or "").strip().partition("\n")[0]
            lines.append(f"| [`{words}`](commands/{page}.md#{anchor}) | {first} |")
    lines += ["", "`eigenhead --install-completion` teaches the shell commands, options and their values."]
    return "\n".join(lines) + "\n"


def _command_page(commands: TyperGroup, title: str, names: tuple[str, ...]) -> str:
    parts = [f"# Commands: {title.lower()}\n\n", MADE]
    for name in names:
        for path, command in _leaves((name,), commands.commands[name]):
            context = _context(("eigenhead", *path), command)
            parts.append(
                f"\n## eigenhead {' '.join(path)}\n\n```text\n{without_common(command.get_help(context))}\n```\n"
            )
    return "".join(parts)


def without_common(help_text: str) -> str:
    """Returns the help of a command without the options of all commands, which the list of commands names."""
    return OF_ALL.sub("", help_text).replace("Options:\n\n", "").rstrip()


def _leaves(path: tuple[str, ...], command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(command, TyperGroup):
        for name, inner in command.commands.items():
            yield from _leaves((*path, name), inner)
    elif not command.hidden:
        yield path, command


def _context(path: tuple[str, ...], command: Any) -> typer.Context:
    options = {"help_option_names": ["-h", "--help"], "terminal_width": WIDTH, "max_content_width": WIDTH}
    parent = None
    for name in path[:-1]:
        parent = typer.Context(TyperGroup(name=name), info_name=name, parent=parent, **options)
    return typer.Context(command, info_name=path[-1], parent=parent, **options)


def _variables() -> str:
    lines = [VARIABLES, "## Of every command", ""]
    lines += _variable_rows(OF_EVERY_COMMAND)
    lines += ["", "Without these the data folder is `$XDG_DATA_HOME/eigenhead`, else `~/.local/share/eigenhead`."]
    lines += ["", "## Of the service and its workers", ""]
    fields = {
        name.upper(): (_default_text(field.get_default(call_default_factory=False)), field.description or "")
        for name, field in ServiceSettings.model_fields.items()
    }
    fields["DATA"] = ("as above", fields["DATA"][1])
    lines += _variable_rows(fields)
    lines += ["", "## Of builds, proxies and tests", "", *_variable_rows(OF_OTHERS)]
    return "\n".join(lines) + "\n"


def _variable_rows(rows: dict[str, tuple[str, str]]) -> list[str]:
    return ["| variable | default | what |", "|---|---|---|"] + [
        f"| `{PREFIX}{name}` | {default} | {what} |" for name, (default, what) in rows.items()
    ]


def _default_text(value: object) -> str:
    if value is None or value is PydanticUndefined:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int) and value >= 1 << 20:
        for size, unit in ((1 << 30, "GiB"), (1 << 20, "MiB")):
            if value % size == 0:
                return f"{value // size} {unit}"
        return f"{value:,}"
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return f"`{value}`" if isinstance(value, str) else str(value)


def _settings() -> str:
    """Every field of ``pipeline.settings.Settings`` with its default and the comment beside it."""
    tables = {f"`{path}`" if path else "At the top": kind for path, kind in _tables("", Settings)}
    return "\n".join([SETTINGS, *_described(settings, tables)]) + "\n"


def _rig_toml() -> str:
    """Every key of a rig.toml."""
    tables = {"At the top": rig_toml.RigConfig, "`[[cameras]]`": rig_toml.CameraConfig}
    tables |= {
        "`[trigger]`": rig_toml.TriggerConfig,
        "`[lights]`": rig_toml.LightsConfig,
        "`[shot]`": rig_toml.ShotConfig,
    }
    return "\n".join([RIG_TOML, *_described(rig_toml, tables)]) + "\n"


def _described(module: ModuleType, tables: dict[str, type]) -> list[str]:
    """Returns a section for each table: what its class says, and every field with default, choices and comment."""
    source = Path(module.__file__ or "").read_text(encoding="utf-8")
    classes = {node.name: node for node in ast.parse(source).body if isinstance(node, ast.ClassDef)}
    comments = _comments(source)
    lines: list[str] = []
    for title, kind in tables.items():
        node, types = classes[kind.__name__], typing.get_type_hints(kind)
        lines += ["", f"## {title}", "", *(ast.get_docstring(node) or "").replace("``", "`").splitlines(), ""]
        statements = [each for each in node.body if isinstance(each, ast.AnnAssign)]
        by_name = {each.target.id: each for each in statements if isinstance(each.target, ast.Name)}
        for field in dataclasses.fields(kind):
            kinds = [types[field.name], *typing.get_args(types[field.name])]
            if any(map(dataclasses.is_dataclass, kinds)) or not field.metadata.get("key", True):
                continue  # a table of its own, and what the reader adds
            needed = field.default is dataclasses.MISSING
            value = "needed" if needed else f"`{json.dumps(field.default, default=str)}`"
            parts = [_choices(types[field.name]), _comment(by_name[field.name], comments)]
            meaning = "; ".join(filter(None, parts))
            lines.append(f"- `{field.name}` ({value})" + (f": {meaning}" if meaning else ""))
    return lines


def _choices(kind: Any) -> str:
    """Names the values that a field may have where they can be counted."""
    options = [kind, *typing.get_args(kind)]
    names = [value for option in options if typing.get_origin(option) is Literal for value in typing.get_args(option)]
    return ", ".join(f"`{name}`" for name in names)


def _tables(path: str, kind: type) -> Iterator[tuple[str, type]]:
    yield path, kind
    for name, inner in typing.get_type_hints(kind).items():
        if dataclasses.is_dataclass(inner) and isinstance(inner, type):
            yield from _tables(f"{path}.{name}" if path else name, inner)


def _comments(source: str) -> dict[int, tuple[str, bool]]:
    """Returns the comment of each line that has one, and whether it stands alone."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    found = [token for token in tokens if token.type == tokenize.COMMENT]
    return {token.start[0]: (token.string.lstrip("# "), token.line.lstrip().startswith("#")) for token in found}


def _comment(statement: ast.AnnAssign, comments: dict[int, tuple[str, bool]]) -> str:
    """The comment within the statement, and its lines below that stand alone."""
    line = statement.end_lineno or statement.lineno
    lines = [comments[number][0] for number in range(statement.lineno, line + 1) if number in comments]
    while lines and comments.get(line + 1, ("", False))[1]:
        line += 1
        lines.append(comments[line][0])
    return " ".join(lines)


def main() -> None:
    for path, text in pages().items():
        (DOCS / path).parent.mkdir(exist_ok=True)
        write_atomically(DOCS / path, text.encode())


if __name__ == "__main__":
    main()
