"""Fixtures of all tests, the figures that they measured, and two rules of CI: no test skips unless
``allowed_skips.txt`` names it, and no fast test takes more CPU time than ``MAX_CALL_S`` unless ``allowed_seconds.txt``
names it."""

import math
import os
import sys
from collections.abc import Generator, Iterator
from fnmatch import fnmatchcase
from functools import cache
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

ALLOWED_SKIPS = Path(__file__).with_name("allowed_skips.txt")
ALLOWED_SECONDS = Path(__file__).with_name("allowed_seconds.txt")
# CPU seconds of a fast test in its call, children included: a second of a free core, and up to two of one whose caches
# another process uses (the same twelve poses took 1.4 s and 2.0 s).
MAX_CALL_S = 2.0
IN_CI = os.environ.get("CI") == "true"
CPU_S = pytest.StashKey[float]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--shapes",
        choices=("once", "all"),
        help="hold every call to its annotated types and shapes: with the first parameters of each test, or with all",
    )


@pytest.hookimpl(trylast=True)  # of what no marker left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """``--shapes once`` runs each test with its first parameters: others rarely differ in types and shapes."""
    if config.option.shapes != "once":
        return
    first = {item.nodeid.partition("[")[0]: item for item in reversed(items)}
    config.hook.pytest_deselected(items=[item for item in items if first[item.nodeid.partition("[")[0]] is not item])
    items[:] = [item for item in items if first[item.nodeid.partition("[")[0]] is item]


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


def pytest_itemcollected(item: pytest.Item) -> None:
    """A test of the night is a slow one, too, so that the fast tests leave it out."""
    if item.get_closest_marker("nightly"):
        item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    before_s = cpu_seconds()
    yield
    item.stash[CPU_S] = cpu_seconds() - before_s


def cpu_seconds() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A test that fails shows what its services wrote last: they run on until its fixtures end."""
    report = yield
    if IN_CI and report.when == "call" and report.passed and item.get_closest_marker("slow") is None:
        seconds, most = item.stash[CPU_S], allowed_seconds(item)
        if seconds > most:
            report.outcome = "failed"
            report.longrepr = (
                f"The call took {seconds:.1f} s of CPU time, and it may take {most} s. Make it faster, mark it as "
                f"slow, or name it with a reason in {ALLOWED_SECONDS.name}."
            )
    services = sys.modules.get("tests.support.services")  # not imported here: the product comes after the hook below
    if report.failed and services is not None:
        for service in services.running:
            report.sections.append((f"end of {service.log}", service.log_end()))
    return report


def allowed_seconds(item: pytest.Item) -> float:
    """CPU seconds that the call of a fast test may take: any number where shapes are checked, too."""
    named = (float(line[1]) for line in allowed(ALLOWED_SECONDS) if fnmatchcase(item.nodeid, line[0]))
    return math.inf if item.config.option.shapes else max(named, default=MAX_CALL_S)


@cache
def allowed(path: Path) -> list[list[str]]:
    """The lines of a list of what is allowed, as words; the first of each is a glob over test ids."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [line.split() for line in lines if line.strip() and not line.startswith("#")]


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
    if config.option.shapes:  # before anything of the product is imported
        check_imports(checked_modules())
    if IN_CI:
        config.pluginmanager.register(SkipList([line[0] for line in allowed(ALLOWED_SKIPS)]), "skip-list")
