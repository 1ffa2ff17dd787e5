"""Locates a user's data and head models: one rule for the command line, the service and its workers.

The data folder is ``--data``, which sets EIGENHEAD_DATA, else EIGENHEAD_DATA, else ``$XDG_DATA_HOME/eigenhead``, else
~/.local/share/eigenhead. Models lie in its folder ``models``, unless EIGENHEAD_MODELS names another one.
"""

import os
from pathlib import Path

DATA, MODELS = "EIGENHEAD_DATA", "EIGENHEAD_MODELS"


def data_folder() -> Path:
    """Returns the folder in which captures, results, keys, jobs and models are kept. The folder need not exist."""
    configured = os.environ.get(DATA)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "eigenhead"


def models_folder() -> Path:
    """Returns the folder of the user's head models. The folder need not exist."""
    configured = os.environ.get(MODELS)
    return Path(configured) if configured else data_folder() / "models"
