"""A folder with packages named like this project's, whose code tells when it runs."""

from pathlib import Path

PACKAGES = ("rig", "pipeline", "calibration", "server")


def hostile_folder(folder: Path) -> Path:
    """Fills ``folder`` with the four packages; returns the file that any of them writes when it is imported."""
    marker = folder / "imported.txt"
    for name in PACKAGES:
        (folder / name).mkdir(parents=True)
        code = f"open({str(marker)!r}, 'a').write(__file__ + '\\n')\nraise ImportError('not the project')\n"
        (folder / name / "__init__.py").write_text(code)
    return marker
