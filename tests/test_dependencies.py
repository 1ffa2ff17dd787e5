"""docs/dependencies.md names what uv.lock has, and every package that we ask for has a reason and a licence."""

import re
import tomllib

from tests.support.dependencies import ABSENT, PAGE, ROOT, locked, reasons


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
    assert set(rows()) == {package["name"] for package in locked()}


def test_every_package_that_is_delivered_states_its_licence() -> None:
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    delivered = {named(requirement) for requirement in document["project"]["dependencies"]}
    assert [name for name in sorted(delivered) if rows()[name][0] in (ABSENT, "see its files")] == []
