"""The catalogue and the code agree: what is composed is in it, and the reverse; and no sentence goes past it."""

import ast

import pytest

from pipeline.warnings import WARNING_CODES
from rig.messages.message import CATALOGUE, fields_of
from tests.support.sentences import ROOT, composed, modules, raw_sentences

# Sentences that are no messages yet, by module. The numbers fall; a module without any has no line.
RAW = {
    "pipeline/applications/model_building/correspondence/scan_checks.py": 11,
    "pipeline/applications/model_building/correspondence/scans.py": 6,
    "pipeline/head_model/expressions.py": 4,
    "pipeline/head_model/model_file.py": 5,
    "pipeline/head_model/model_names.py": 2,
    "pipeline/applications/model_building/sources/fetch.py": 9,
    "pipeline/applications/model_building/sources/imports.py": 15,
    "pipeline/head_model/subdivision.py": 4,
    "pipeline/applications/model_building/training/build.py": 2,
    "pipeline/faces/landmark_map.py": 1,
    "pipeline/faces/networks.py": 3,
    "pipeline/applications/verification/best_fit.py": 1,
    "pipeline/applications/verification/judgement.py": 1,
    "pipeline/applications/verification/measured.py": 4,
    "server/address.py": 2,
    "server/cli/answers.py": 3,
    "server/cli/cameras.py": 1,
    "server/cli/client.py": 7,
    "server/cli/demo.py": 1,
    "server/cli/doctor.py": 2,
    "server/cli/heads.py": 4,
    "server/tasks/refine.py": 2,
    "server/cli/studio.py": 1,
    "server/tasks/photographs.py": 3,
    "server/tasks/simulate.py": 1,
}


def test_every_code_is_composed_with_its_parameters() -> None:
    wrong = []
    for path, tree in modules().items():
        for line, codes, parameters in composed(tree):
            known = codes & CATALOGUE.keys()
            if not known or (parameters is not None and codes != known):
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {sorted(codes)} are not in the catalogue")
            wrong += [
                f"{path.relative_to(ROOT)}:{line}: {code} has {sorted(fields_of(CATALOGUE[code]))}"
                for code in known
                if parameters is not None and parameters != fields_of(CATALOGUE[code]).keys()
            ]
    assert wrong == []


def test_every_code_of_the_catalogue_is_used_and_every_warning_of_a_result_in_it() -> None:
    used = {code for tree in modules().values() for _, codes, _ in composed(tree) for code in codes}
    assert CATALOGUE.keys() - used - {"verbatim"} == set()
    assert set(WARNING_CODES) - CATALOGUE.keys() == set()


def test_sentences_are_messages() -> None:
    found = {path.relative_to(ROOT).as_posix(): raw_sentences(tree) for path, tree in modules().items()}
    more = {path: lines for path, lines in found.items() if len(lines) > RAW.get(path, 0)}
    assert more == {}
    assert [path for path in RAW if not found.get(path)] == []


@pytest.mark.parametrize(
    ("line", "is_raw"),
    [
        ('raise InputError("capture", ["is no picture"])', True),
        ('raise EigenheadError(f"the camera {name} is gone")', True),
        ('faults.append(f"{name} is empty")', True),
        ('faults += [f"{name} is empty" for name in names]', True),
        ('detail = "The job is gone."\n    raise Conflict("gone", detail)', True),
        ('warnings = [*told, "the view is " + "left out"]', True),
        ('raise InputError("capture", [compose("no-json-object")])', False),
        ('faults.append(compose("tag-empty", tag=number))', False),
    ],
)
def test_a_raw_sentence_is_found_and_a_message_is_none(line: str, is_raw: bool) -> None:
    found = raw_sentences(ast.parse(f"def planted(name, names, told, number):\n    {line}\n"))
    assert bool(found) == is_raw
