"""Implements ``eigenhead verify``: judges captures of a mannequin, or their results, by the mannequin's scan."""

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from rig.errors import EigenheadError, InputError
from rig.progress import Progress
from server.cli.reconstruct_local import reconstruct_locally

if TYPE_CHECKING:
    from pipeline.applications.verification.limits import Limits
    from pipeline.applications.verification.report import VerificationReport


class LimitsMissed(EigenheadError):
    """Reports that a figure exceeds its limit. Report and certificate have been written by then."""

    def __init__(self, document: "VerificationReport", out: Path) -> None:
        missed = [
            f"{name} is {check['value']:.3g}, the limit is {check['limit']:g}"
            for name, check in document["checks"].items()
            if check["passed"] is False and check["value"] is not None
        ]
        super().__init__(f"not passed: {'; '.join(missed)} ({out / 'certificate.pdf'} says where)")


def verify_captures(
    captures: Sequence[Path],
    out: Path,
    *,
    reference: Path,
    landmarks: Path | None,
    model: str | None,
    settings: Mapping[str, object],
    limits: "Limits",
    report: Progress,
) -> "VerificationReport":
    """Judges captures of a mannequin, or their results, by the scan ``reference``. Writes report.json and
    certificate.pdf into ``out``, and results of captures into ``out/results``.

    The reference is checked before anything is reconstructed. Raises InputError, also if results were made with
    different models, and the errors of the pipeline.
    """
    from pipeline.applications.verification.judgement import judge
    from pipeline.applications.verification.measured import identity_of, is_result, read_measured
    from pipeline.applications.verification.reference import read_reference
    from pipeline.applications.verification.report import Occasion
    from pipeline.applications.verification.write import write_verification
    from pipeline.head_model.model import load_model

    names = capture_names(captures)
    scan = read_reference(reference, landmarks)
    folders: list[Path] = []
    for i, (capture, name) in enumerate(zip(captures, names, strict=True)):
        folder = capture
        if not is_result(capture):
            folder = out / "results" / name

            def report_one(stage: str, fraction: float, i: int = i) -> None:
                report(f"{names[i]}: {stage}", (i + fraction) / len(captures))

            report_one("read", 0.0)
            reconstruct_locally(capture, folder, model=model, settings=head_alone(settings), report=report_one)
        folders.append(folder)
    report("judge", 1.0)
    identities = {name: identity_of(folder) for name, folder in zip(names, folders, strict=True)}
    identity = identities[names[0]]
    others = [name for name, of in identities.items() if of != identity]
    if others:
        raise InputError("captures", [f"{name} was made with another model than {names[0]}" for name in others])
    chosen = load_model(model or identity.model)
    measured = [read_measured(folder, chosen, name) for folder, name in zip(folders, names, strict=True)]
    judgement = judge(measured, scan, limits)
    occasion = Occasion(date.today().isoformat(), identity, limits)
    return write_verification(out, measured[0], scan, judgement, occasion)


def read_limits(path: Path | None) -> "Limits":
    """Reads limits from a TOML or JSON file. Those that it omits, or all without a file, have their defaults. Raises
    InputError."""
    from pipeline.applications.verification.limits import limits_from_document
    from server.tasks.settings_file import settings_document

    return limits_from_document(settings_document(path), path.name if path else "limits")


def lines(document: "VerificationReport", out: Path) -> list[str]:
    """Returns lines for people: each figure beside its limit, then the paths of report and certificate."""
    verdicts = {None: "not judged", True: "met", False: "missed"}
    visits = [
        f"{name:<20} {'-' if check['value'] is None else format(check['value'], '.4g'):>8}   "
        f"limit {check['limit']:<6g} {verdicts[check['passed']]}"
        for name, check in document["checks"].items()
    ]
    return [*visits, str(out / "report.json"), str(out / "certificate.pdf")]


def capture_names(captures: Sequence[Path]) -> list[str]:
    """Returns the captures' names. Raises InputError if two are alike."""
    names = [path.resolve().name.removesuffix(".gz").removesuffix(".tar").removesuffix(".zip") for path in captures]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError("captures", [f"more than one is called {name}: rename one" for name in twice])
    return names


def head_alone(settings: Mapping[str, object]) -> dict[str, object]:
    """Returns the settings with the bust switched off: only the head is judged, and a capture takes ten seconds
    less."""
    outputs = settings.get("outputs")
    return {**settings, "outputs": {"surface": "head", **(outputs if isinstance(outputs, Mapping) else {})}}
