"""Words that are no names (docs/style.md), since they do not say what a value is; and names that better ones replaced.

Held to it are names, parameters, attributes, keywords, functions, classes and modules' names for what they import.
Keys that are stored or that others read are no names of ours to change: those are listed. The list may only shrink: an
entry that nothing needs fails.
"""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("rig", "pipeline", "calibration", "server", "deploy", "tests")
DOCUMENTED = ("rig", "pipeline", "calibration", "server")  # whose docstrings are held to begin as docs/style.md says
WORDS = frozenset({"told", "given", "own", "asked", "looks"})
REPLACED = {
    "About": "CaptureMetadata",
    "AspectsAt": "LinearisedAspectPrior",
    "Carrier": "SurfaceBinding",
    "Children": "ChildProcessPool",
    "CornersAt": "LinearisedCornerTerm",
    "Displaced": "DeformedSurface",
    "LensPriorAt": "LinearisedLensPrior",
    "Linger": "DrainRequestBody",
    "MOST_AGAINST": "MAX_CONTRADICTING_VIEWS",
    "OwnPictures": "ImageAssignment",
    "PageOf": "Page",
    "Posable": "BlendshapeRig",
    "PriorAt": "LinearisedPriorTerm",
    "QuadraticAt": "LinearisedQuadratic",
    "RimAt": "LinearisedRimTerm",
    "Room": "DepthRange",
    "SILENT_S": "HEARTBEAT_TIMEOUT_S",
    "Solved": "ContourSolution",
    "SurfaceAt": "LinearisedSurfaceTerm",
    "Unknown": "Unauthenticated",
    "Unusable": "InvalidInput",
    "Work": "ReconstructionRequest",
    "_crowd": "_local_density",
    "add_alike": "add_similar_views",
    "bridged": "bridge_eyelids",
    "carrier": "surface_binding",
    "colour_looks": "colour_histogram",
    "detail_looks": "detail_histogram",
    "dim_views": "underexposed_views",
    "draw_to_surface": "deform_to_points",
    "encodes": "is_encodable",
    "find_rooms": "find_depth_ranges",
    "held_inside": "downweight_outside_contour",
    "is_bare": "is_hairless",
    "judged_lids": "estimate_eyelid_closure",
    "kept_arrays": "cached_arrays",
    "look_at_eyes": "measure_eye_appearance",
    "own_misses": "tangency_errors_px",
    "own_pictures": "assign_images",
    "patiently": "with_idle_timeout",
    "pencil": "epipolar_plane_axes",
    "posable": "blendshape_rig",
    "posable_head": "build_blendshape_rig",
    "refiled": "reassign_images",
    "see_blind_patches": "fill_unobserved_patches",
    "set_aside": "list_quarantined",
    "settle": "publish_outcome",
    "turning_radius": "max_valid_radius",
    "unfollowed": "local_misfit_mm",
    "weight_room": "weight_bounds",
}
PUBLIC = {
    ("rig/formats/cameras/foreign.py", "told"),  # a parameter of the message key-not-used
    ("server/storage/records.py", "own"),  # of deliveries that wait in the job engine's queue
}

SPELLED: dict[type[ast.AST], str] = {  # the field in which a node of a syntax tree spells a name of its own
    ast.Name: "id",
    ast.Attribute: "attr",
    ast.arg: "arg",
    ast.keyword: "arg",
    ast.FunctionDef: "name",
    ast.AsyncFunctionDef: "name",
    ast.ClassDef: "name",
    ast.ExceptHandler: "name",
    ast.alias: "asname",
    ast.MatchAs: "name",
}


def words_of(source: str) -> list[tuple[str, int]]:
    """Lists the names in a module and their lines. Hypothesis' decorator ``given`` is not one of ours."""
    nodes = list(ast.walk(ast.parse(source)))
    calls = (call for node in nodes for call in getattr(node, "decorator_list", ()) if isinstance(call, ast.Call))
    decorators = {id(call.func) for call in calls}
    named = ((getattr(node, SPELLED.get(type(node), ""), None), node) for node in nodes if id(node) not in decorators)
    return [(name, getattr(node, "lineno", 0)) for name, node in named if name]


@cache
def uses() -> dict[str, list[tuple[str, int]]]:
    """Finds, for every file, the names that it should not have and their lines."""
    held = WORDS | REPLACED.keys()
    spelled = re.compile(rf"\b(?:{'|'.join(sorted(held))})\b")  # most files need no syntax tree
    found = {}
    for path in (path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))):
        source = path.read_text(encoding="utf-8")
        names = words_of(source) if spelled.search(source) else []
        found[path.relative_to(ROOT).as_posix()] = [(name, line) for name, line in names if name in held]
    return found


def test_no_name_is_a_word_that_says_nothing() -> None:
    wrong = [
        f"{file}:{line}: {name!r} does not say what the value is"
        for file, names in uses().items()
        for name, line in names
        if name in WORDS and (file, name) not in PUBLIC
    ]
    assert not wrong, "\n".join(wrong)


def test_no_replaced_name_comes_back() -> None:
    wrong = [
        f"{file}:{line}: {name} is {REPLACED[name]} now"
        for file, names in uses().items()
        for name, line in names
        if name in REPLACED
    ]
    assert not wrong, "\n".join(wrong)


def test_the_list_of_exceptions_only_shrinks() -> None:
    assert not PUBLIC - {(file, name) for file, names in uses().items() for name, _ in names}


def test_bounds_of_the_pipeline_begin_with_min_or_max() -> None:
    bound = re.compile(r"^[A-Z0-9_, ]*(?:\b|_)(?:LEAST|MOST)(?:_[A-Z0-9_]+)?\b[A-Z0-9_, ]*(?=:| =)", re.MULTILINE)
    modules = {path: path.read_text(encoding="utf-8") for path in sorted((ROOT / "pipeline").rglob("*.py"))}
    wrong = [f"{path.relative_to(ROOT)}: {name}" for path, text in modules.items() for name in bound.findall(text)]
    assert not wrong, "\n".join(wrong)


def wrong_beginnings(source: str) -> list[str]:
    """Lists the public classes and functions whose docstring does not begin with a verb in the third person."""
    nodes = ast.walk(ast.parse(source))
    named = [node for node in nodes if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)]
    texts = [(node.name, ast.get_docstring(node, clean=False) or "") for node in named if node.name[0] != "_"]
    firsts = [(name, word) for name, text in texts for word in text.split(maxsplit=1)[:1]]
    return [name for name, word in firsts if not re.fullmatch(r"[A-Z][a-z]*s,?", word)]


def test_docstrings_begin_with_a_verb_in_the_third_person() -> None:
    modules = [path for room in DOCUMENTED for path in sorted((ROOT / room).rglob("*.py"))]
    modules = [path for path in modules if path.parent.name != "cli"]  # a command's docstring is its help: an order
    wrong = {path: wrong_beginnings(path.read_text(encoding="utf-8")) for path in modules}
    assert not [f"{path.relative_to(ROOT)}: {name}" for path, names in wrong.items() for name in names]


def test_a_noun_is_seen_where_a_verb_should_begin() -> None:
    source = (
        'def f():\n    """The sum."""\ndef g():\n    """Returns, in order, all."""\nclass A:\n    """``a.json``."""'
    )
    assert wrong_beginnings(source) == ["f", "A"]


@pytest.mark.parametrize(
    "source",
    [
        "told = 1",
        "def f(own): ...",
        "def asked(): ...",
        "class Work: ...",
        "f(given=1)",
        "value.looks",
        "import json as told",
        "try: ...\nexcept ValueError as told: ...",
        "text = f'{told}'",
    ],
)
def test_every_kind_of_name_is_seen(source: str) -> None:
    assert {name for name, _ in words_of(source)} & (WORDS | REPLACED.keys())


@pytest.mark.parametrize("source", ["@given(x=1)\ndef f(x): ...", "rows['told'] = 1", "# told\nvalue = 1"])
def test_keys_prose_and_hypothesis_are_left_alone(source: str) -> None:
    assert not {name for name, _ in words_of(source)} & WORDS
