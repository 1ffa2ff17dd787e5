"""docs/dependencies.md names what uv.lock has, and every package that we ask for has a reason and a licence."""

import json
import re
import subprocess
import tomllib

from tests.support.uv import uv
from tests.tools.dependencies import ABSENT, PAGE, ROOT, locked, reasons


def named(requirement: str) -> str:
    return re.split(r"[\[<>=~! ]", requirement, maxsplit=1)[0].lower()


def asked_for() -> set[str]:
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = document["project"]
    lists = [
        project["dependencies"],
        *project["optional-dependencies"].values(),
        *document["dependency-groups"].values(),
    ]
    return {named(requirement) for requirements in lists for requirement in requirements}


def rows() -> dict[str, tuple[str, str]]:
    cells = re.findall(r"^\| ([\w.-]+) \| (.+) \| (.+) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return {name: (licence, why) for name, licence, why in cells if name != "package"}


def test_every_package_that_is_asked_for_has_a_reason() -> None:
    assert set(reasons()) == asked_for()
    assert {name: why for name, (_, why) in rows().items() if name in asked_for()} == reasons()


def test_the_page_names_every_package_that_is_locked() -> None:
    """`make dependencies` writes it anew."""
    lists = re.findall(r"^- [^:]+: (.+(?:\n  .+)*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    needed = [name for names in lists for name in re.split(r",\s+", names)]
    assert sorted([*rows(), *needed]) == sorted({package["name"] for package in locked()})


def test_every_package_that_is_delivered_states_its_licence() -> None:
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    delivered = {named(requirement) for requirement in document["project"]["dependencies"]}
    assert [name for name in sorted(delivered) if rows()[name][0] in (ABSENT, "see its files")] == []


def test_the_bill_of_materials_names_what_is_delivered() -> None:
    """With `make sbom`'s own options."""
    (options,) = re.findall(r"\$\(UV\) export (.*) --output-file", (ROOT / "Makefile").read_text(encoding="utf-8"))
    command = [uv(), "export", "--offline", *options.split()]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True).stdout
    bill = json.loads(printed)
    assert (bill["bomFormat"], bill["metadata"]["component"]["name"]) == ("CycloneDX", "eigenhead")
    versions = {part["name"]: part["version"] for part in bill["components"]}
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    delivered = {named(requirement) for requirement in document["project"]["dependencies"]}
    assert delivered <= set(versions)
    assert not {"pytest", "mkdocs-material", "mutmut"} & set(versions)
    assert {(package["name"], package["version"]) for package in locked()} >= set(versions.items())
