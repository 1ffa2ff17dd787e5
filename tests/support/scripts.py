"""Imports scripts that are no module of the project."""

import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType


def import_script(path: Path) -> ModuleType:
    """Returns the script as a module of its file's name, which later imports find."""
    loader, module = SourceFileLoader(path.stem, str(path)), ModuleType(path.stem)
    module.__file__ = str(path)
    sys.modules[path.stem] = module  # dataclasses ask for it
    loader.exec_module(module)
    return module
