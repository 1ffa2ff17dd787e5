"""Implements the command ``eigenhead``. Each command imports heavy modules when it runs, so that ``--help`` answers at
once."""

import os
import sys
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import typer
from typer.core import TyperGroup, TyperOption

from rig.errors import DISK_FULL, EigenheadError
from server.cli import batch, cameras, clinic, export, heads, models, moments, rig, service, simulate, templates
from server.cli.answers import QUIET, fail, stoppable, use_threads

ROOMS = {  # page below docs/commands: its title, and its commands in the order of a day's work
    "heads": ("Heads", ("reconstruct", "take", "sequence", "batch", "check", "export")),
    "clinic": ("Clinic", ("compare", "register", "measure")),
    "trials": ("Trials", ("simulate", "demo", "verify")),
    "cameras": ("Cameras", ("board", "calibrate", "refine", "clock", "convert")),
    "rig": ("The rig", ("rig",)),
    "service": ("The service", ("serve", "worker", "keys", "doctor", "prepare")),
    "models": ("Models and templates", ("model", "template", "wrap")),
}
THREADS, ALONE = "Of compiled loops; all processors by default.", "No progress and no warnings, errors alone."


class Commands(TyperGroup):
    """Lists the commands by purpose, adds the common options to each command, and prints each example on a line."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for command in _leaves(self):
            command.epilog = "\b\n" + (command.epilog or "").replace("   ", "\n")
            if command.name == "check" or ("out", ["--out"]) in ((each.name, each.opts) for each in command.params):
                command.callback = stoppable(command.callback, command.name)
            command.params += [_option("--threads", use_threads, THREADS, type=int, metavar="N")]
            command.params += [
                _option(
                    "--quiet", lambda value: QUIET.set() if value else QUIET.clear(), ALONE, is_flag=True, default=False
                )
            ]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes a section for each group of commands."""
        width = formatter.width - 6 - max(map(len, self.commands))
        for title, names in ROOMS.values():
            with formatter.section(title):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(width)) for name in names])


def _option(name: str, use: Callable[[Any], None], help_text: str, **kind: Any) -> TyperOption:
    """Returns an option that every command has; its value goes to the function ``use``, not to the command."""
    return TyperOption(param_decls=[name], callback=lambda *of: use(of[-1]), help=help_text, expose_value=False, **kind)


def _leaves(group: TyperGroup) -> Iterator[Any]:
    for command in group.commands.values():
        yield from _leaves(command) if isinstance(command, TyperGroup) else [command]


app = typer.Typer(
    name="eigenhead",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # importing rich's markdown alone takes half a second
    context_settings={"help_option_names": ["-h", "--help"]},
)
for room in (service, heads, moments, simulate, batch, export, clinic, templates, cameras):
    app.add_typer(room.app)
groups = {"keys": service.keys_app, "rig": rig.rig_app, "model": models.model_app, "template": templates.template_app}
for name, group in groups.items():
    app.add_typer(group, name=name)


def _show_version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        print(f"eigenhead {version('eigenhead')}")
        raise typer.Exit


@app.callback()
def of_all(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and leave.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """One shot of a calibrated camera rig in, a textured 3D head with its uncertainty out."""


def main() -> None:
    """Runs the command line. The exit status is 0 if the command succeeded, 1 if it failed (one line on stderr), 2 for
    wrong usage."""
    # Set before NumPy is loaded, here and in workers. On small systems BLAS threads spin longer than they work: beside
    # another busy process a fit took five times the processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app()
    except EigenheadError as error:
        fail(str(error))
    except MemoryError as error:
        fail(f"more memory is needed than there is ({error}): a file is too large, or not what it says")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if os.environ.get("EIGENHEAD_DEBUG"):
            raise
        if isinstance(error, OSError) and error.errno in DISK_FULL:
            fail("the disk is full: make room, then run the same command again")
        if isinstance(error, OSError) and error.filename:
            fail(f"{error.filename} cannot be used ({error.strerror}): name another place, or mend who may use it")
        fail(f"{type(error).__name__}: {error} (EIGENHEAD_DEBUG=1 shows where)")
