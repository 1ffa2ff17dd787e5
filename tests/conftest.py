"""Fixtures of all tests, the figures that they measured, and the rule that in CI no test skips unless
``allowed_skips.txt`` names it."""

import os
import sys
from collections.abc import Generator, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

# As the command does, before NumPy is loaded: beside another test process, threads of BLAS spin longer than they work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import pytest

from tests.support.shape_checks import check_imports, checked_modules

if TYPE_CHECKING:  # the product is imported after the hook
    from rig.render.renderer import Renderer

hypothesis.settings.register_profile("eigenhead", deadline=None)  # an example may have to compile its loops first
hypothesis.settings.register_profile(  # `make mutants`: the first example that fails is enough
    "mutants", deadline=None, max_examples=25, derandomize=True, database=None, phases=[hypothesis.Phase.generate]
)
hypothesis.settings.load_profile("eigenhead")

FAST = "not slow"  # shapes and types of every call are checked in these tests; the slow ones measure time, too
ALLOWED_SKIPS = Path(__file__).with_name("allowed_skips.txt")


@pytest.fixture(scope="session")
def renderer() -> "Iterator[Renderer]":
    """The one renderer of the test session. Where EGL is missing the tests fail: `make setup` installs it."""
    from rig.render.renderer import Renderer

    with Renderer.create() as shared_renderer:
        yield shared_renderer


@pytest.fixture(autouse=True)
def _no_gl_error(request: pytest.FixtureRequest) -> Iterator[None]:
    """Tests marked ``gl`` find OpenGL without an error and leave it so."""
    if request.node.get_closest_marker("gl") is None:
        yield
        return
    context = request.getfixturevalue("renderer").context
    with context.current() as gl:
        assert gl.error == "GL_NO_ERROR", "an earlier test left an OpenGL error"
    yield
    with context.current() as gl:
        assert gl.error == "GL_NO_ERROR"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A test that fails shows what its services wrote last: they run on until its fixtures end."""
    report = yield
    services = sys.modules.get("tests.support.services")  # not imported here: the product comes after the hook below
    if report.failed and services is not None:
        for service in services.running:
            report.sections.append((f"end of {service.log}", service.log_end()))
    return report


class SkipList:
    """Collects skips; ``unnamed`` are those that no line of the list allows."""

    def __init__(self, allowed: list[str]) -> None:
        self.allowed = allowed
        self.unnamed: list[str] = []

    def note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if not report.skipped or hasattr(report, "wasxfail"):
            return
        if not any(fnmatchcase(report.nodeid, pattern) for pattern in self.allowed):
            reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
            self.unnamed.append(f"{report.nodeid}: {reason}")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self.note(report)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self.unnamed and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self.unnamed:
            terminalreporter.section("skips that tests/allowed_skips.txt does not name (they fail in CI)")
            for line in self.unnamed:
                terminalreporter.write_line(line)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Prints what tests gave to ``record_property``."""
    ended = [*terminalreporter.getreports("passed"), *terminalreporter.getreports("failed")]
    figures = [(report.nodeid, *figure) for report in ended for figure in report.user_properties]
    if figures:
        terminalreporter.section("figures")
    for test, name, value in figures:
        terminalreporter.write_line(f"{name} = {value}  ({test})")


def pytest_configure(config: pytest.Config) -> None:
    if config.option.markexpr == FAST:  # before anything of the product is imported
        check_imports(checked_modules())
    if os.environ.get("CI") == "true":
        lines = ALLOWED_SKIPS.read_text(encoding="utf-8").splitlines()
        patterns = [line.split()[0] for line in lines if line.strip() and not line.startswith("#")]
        config.pluginmanager.register(SkipList(patterns), "skip-list")
