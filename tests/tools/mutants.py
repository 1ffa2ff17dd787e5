"""Mutation testing: `make mutants MODULE=rig/geometry.py` changes the module piece by piece, in a copy of the checkout,
and tells which changes none of its tests noticed. Ends with status 1 where fewer than 85 of 100 are noticed.

mutmut does the work. It changes functions that no decorator wraps: compiled loops and properties stay as they are.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
KILLED_LEAST = 0.85
HOURS_MOST = 6
PACKAGES = ("rig", "pipeline", "calibration", "server")
# What speaks of the module beside its namesake, or in its place.
TESTS = {
    "pipeline/geometry/registration/rigid.py": ["tests/pipeline/alignment/test_landmarks.py"],
    "pipeline/simplex/xor_objective.py": ["tests/pipeline/simplex/test_xor_objective.py"],
    "rig/geometry.py": ["tests/rig/test_geometry.py"],
    "server/http/auth.py": ["tests/server/http/test_callers.py"],
}


def namesake(module: str) -> str:
    path = Path(module)
    return str(Path("tests") / path.parent / f"test_{path.name}")


def copy_of_checkout(folder: Path, module: str, tests: list[str]) -> None:
    """The files that git knows or would add, and mutmut's settings in their pyproject.toml."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    package = module.partition("/")[0]
    beside = [*(name for name in PACKAGES if name != package), "tests", "docs", "deploy", "README.md", "uv.lock"]
    settings = {
        "source_paths": [package],
        "only_mutate": [module],
        "pytest_add_cli_args_test_selection": tests,
        "pytest_add_cli_args": ["-p", "no:cacheprovider", "--hypothesis-profile", "mutants"],
        "also_copy": beside,
        # A process that has drawn cannot be forked: its child would wait for OpenGL's threads for ever.
        "process_isolation": "forkserver",
    }
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items())
    with (folder / "pyproject.toml").open("a", encoding="utf-8") as project:
        project.write(f"\n[tool.mutmut]\n{lines}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("module", help="path of the module from the top of the checkout")
    parser.add_argument("--tests", nargs="+", help="test files; else those that tests/tools/mutants.py knows")
    parser.add_argument("--children", type=int, default=2, help="mutants tried at once")
    arguments = parser.parse_args()
    tests = arguments.tests or TESTS.get(arguments.module, [namesake(arguments.module)])
    missing = [name for name in (arguments.module, *tests) if not (ROOT / name).is_file()]
    if missing:
        sys.exit(f"there is no {', no '.join(missing)}")
    mutmut = str(Path(sys.executable).with_name("mutmut"))
    if not Path(mutmut).exists():
        sys.exit("mutmut is not installed: run `uv sync --group mutants`")
    with tempfile.TemporaryDirectory(prefix="eigenhead-mutants-") as scratch:
        folder = Path(scratch)
        copy_of_checkout(folder, arguments.module, tests)

        def run_mutmut(*command: str) -> str:
            done = subprocess.run([mutmut, *command], cwd=folder, capture_output=True, text=True, check=False)
            return done.stdout

        with (folder / "log").open("wb") as log:
            run = [mutmut, "run", "--max-children", str(arguments.children)]
            subprocess.run(run, cwd=folder, stdout=log, stderr=log, timeout=HOURS_MOST * 3600, check=False)
        run_mutmut("export-cicd-stats")
        stats = folder / "mutants" / "mutmut-cicd-stats.json"
        if not stats.exists():
            sys.exit((folder / "log").read_text(errors="replace")[-4000:])
        counts = json.loads(stats.read_text())
        survivors = [line.split(":")[0].strip() for line in run_mutmut("results").splitlines() if ": survived" in line]
        for name in survivors:
            sys.stdout.write(run_mutmut("show", name) + "\n")
        untested = counts.get("no_tests", 0)
        tried = counts["total"] - counts.get("skipped", 0)
        noticed = counts["killed"] + counts.get("timeout", 0) + counts.get("segfault", 0)
        share = noticed / max(tried, 1)
        sys.stdout.write(
            f"{arguments.module}: {noticed} of {tried} mutants noticed ({share:.1%}), {len(survivors)} survived, "
            f"{untested} that no test reaches\n"
        )
        sys.exit(share < KILLED_LEAST)


if __name__ == "__main__":
    main()
