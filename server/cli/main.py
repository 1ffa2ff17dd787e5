"""Implements the command ``eigenhead``. Everything heavy is imported inside the commands, so that ``--help`` answers at
once."""

import os
import sys
from typing import Annotated

import typer

from rig.errors import EigenheadError
from server.cli import batch, cameras, clinic, export, heads, measure, models, rig, service, simulate, templates, wrap
from server.cli.answers import fail

app = typer.Typer(
    name="eigenhead",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # importing rich's markdown alone takes half a second
    context_settings={"help_option_names": ["-h", "--help"]},
)
for room in (service, heads, simulate, batch, export, clinic, measure, wrap, cameras):
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


@app.command(hidden=True, context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
def experiments(context: typer.Context) -> None:
    """Say where the experiments are."""
    name = next((word for word in context.args if not word.startswith("-")), "NAME")
    print(
        f"experiments are in the laboratory of a checkout: python -m tests.laboratory {name} [--json]", file=sys.stderr
    )
    raise typer.Exit(2)


def main() -> None:
    """Runs the command line. The exit status is 0 if it succeeded, 1 if it failed (one line on stderr), 2 for wrong
    usage."""
    # Set before NumPy is loaded, here and in workers. On small systems BLAS threads spin longer than they work: beside
    # another busy process a fit took five times the processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app()
    except EigenheadError as error:
        fail(str(error))
    except MemoryError as error:
        fail(f"more memory is needed than there is ({error}): a file is too large, or not what it says")
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if os.environ.get("EIGENHEAD_DEBUG"):
            raise
        if isinstance(error, OSError) and error.filename:
            fail(f"{error.filename} cannot be used ({error.strerror}): name another place, or mend who may use it")
        fail(f"{type(error).__name__}: {error} (EIGENHEAD_DEBUG=1 shows where)")
