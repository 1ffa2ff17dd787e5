"""The parts of the operator's pages that need no browser: identity, removal with undo, numbers by vertex, guides."""

import asyncio
import json
import struct
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.types import Scope

from pipeline.head_model.model import load_model
from pipeline.settings import settings_from_document
from pipeline.texturing.paint import find_layout
from rig.camera import Camera, Distortion, Intrinsics
from rig.errors import InputError
from rig.geometry import RigidTransform, rotation_from_vector
from rig.mesh import Mesh
from rig.messages.message import compose, verbatim
from rig.rig import Rig
from server.console import coverage, guides, live, media
from server.console.identity import caller_of, cookie_secret, is_foreign, is_rebound, permit
from server.console.live import look_bytes
from server.console.mount import path_below
from server.console.pages.captures import PRESETS, Preset, chosen_work, settings_of
from server.console.pages.jobs import chosen_settings, log_lines
from server.console.removal import Removals
from server.errors import Conflict, Forbidden, NotFound, Unauthenticated, Unavailable
from server.services.keys import Keys
from server.services.live.live import nothing
from server.services.records import RigOut
from server.services.work import ReconstructionRequest
from server.settings import ServiceSettings
from server.storage.database import open_database
from server.storage.events import JobEvent
from tests.support.result_folders import write_head
from tests.support.services import await_true

SHOWN = nothing(compose("live-starting"))


def scope(host: str, origin: str | None = None) -> Scope:
    headers = [(b"host", host.encode())] + ([] if origin is None else [(b"origin", origin.encode())])
    return {"type": "http", "path": "/", "headers": headers}


@pytest.mark.parametrize(
    ("host", "origin", "foreign"),
    [
        ("127.0.0.1:8600", None, False),
        ("127.0.0.1:8600", "http://127.0.0.1:8600", False),
        ("127.0.0.1:8600", "http://evil.example", True),
        ("127.0.0.1:8600", "http://127.0.0.1:9999", True),  # another program's page on this machine
        ("studio.example", "https://studio.example", False),
        ("127.0.0.1:8600", "null", True),
    ],
)
def test_what_another_page_sent_is_foreign(host: str, origin: str | None, foreign: bool) -> None:
    assert is_foreign(scope(host, origin), ServiceSettings()) is foreign


@pytest.mark.parametrize(
    ("host", "listens", "rebound"),
    [
        ("127.0.0.1:8600", "127.0.0.1", False),
        ("localhost:8600", "127.0.0.1", False),
        ("localhost", "127.0.0.1", False),
        ("[::1]:8600", "::1", False),
        ("evil.example:8600", "127.0.0.1", True),
        ("evil.example", "127.0.0.1", True),
        ("studio.example", "0.0.0.0", False),  # it has keys
    ],
)
def test_a_service_of_this_machine_answers_to_its_own_names(host: str, listens: str, rebound: bool) -> None:
    assert is_rebound(scope(host), ServiceSettings(host=listens)) is rebound


def test_behind_a_proxy_the_public_address_is_our_own() -> None:
    settings = ServiceSettings(public_url="https://heads.example:8443")
    request = scope("heads.example:8443", "https://heads.example:8443")
    assert not is_rebound(request, settings)
    assert not is_foreign(request, settings)
    assert not is_foreign(scope("127.0.0.1:8600", "https://heads.example:8443"), settings)  # the proxy names itself
    assert is_rebound(scope("evil.example"), settings)
    assert is_foreign(scope("heads.example:8443", "https://evil.example"), settings)


@pytest.mark.parametrize(
    ("path", "root", "below"),
    [
        ("/captures", "", "/captures"),
        ("/heads/captures", "/heads", "/captures"),
        ("/heads", "/heads", ""),
        ("/headsets", "/heads", "/headsets"),
        ("/captures", "/heads", "/captures"),
    ],
)
def test_a_page_is_found_below_where_the_service_is_mounted(path: str, root: str, below: str) -> None:
    assert path_below({"type": "http", "path": path, "root_path": root}) == below


def test_the_cookie_secret_stays_is_the_owners_alone_and_is_made_again_where_it_is_empty(tmp_path: Path) -> None:
    first = cookie_secret(tmp_path)
    assert cookie_secret(tmp_path) == first
    assert len(first) == 64
    path = tmp_path / "console" / "secret"
    assert path.stat().st_mode & 0o077 == 0
    path.unlink()
    path.touch()  # as a full disk left it
    assert len(cookie_secret(tmp_path)) == 64
    assert path.stat().st_mode & 0o077 == 0


def test_a_removal_waits_and_can_be_taken_back() -> None:
    removals, hasty, removed = Removals(wait_s=600.0), Removals(wait_s=0.1), []
    for name, kept in (("a", removals), ("b", hasty)):
        kept.add(name, lambda name=name: removed.append(name), verbatim(f"capture {name}"), "capture")
    assert {name: removal.title.text for name, removal in removals.waiting().items()} == {"a": "capture a"}
    assert removals.undo("a")
    assert not removals.undo("a")
    await_true(lambda: "b" not in hasty)
    assert removed == ["b"]
    assert not hasty.undo("b")


def test_a_removal_that_fails_shows_the_thing_again() -> None:
    removals, tried = Removals(wait_s=0.01), threading.Event()

    def refuse() -> None:
        tried.set()
        raise Conflict("capture-in-use", "a job needs it")

    removals.add("a", refuse, verbatim("capture a"), "capture")
    assert tried.wait(60)
    await_true(lambda: removals.waiting() == {})


def grid(size: int = 12) -> Mesh:
    """A flat square of triangles in the plane z = 0."""
    y, x = np.mgrid[:size, :size] * 10.0
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(size * size)], axis=1)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    one = np.stack([corner, corner + 1, corner + size], axis=1)
    other = np.stack([corner + 1, corner + size + 1, corner + size], axis=1)
    return Mesh(vertices, np.concatenate([one, other]).astype(np.int32))


def test_quality_and_distance_come_in_the_order_of_the_vertices(tmp_path: Path) -> None:
    mesh = grid()
    quality = np.linspace(0.1, 3.0, len(mesh.vertices))
    mine = write_head(tmp_path / "mine", mesh, quality)
    np.testing.assert_array_equal(media.vertex_numbers(mine / "head.ply", "quality"), quality.astype(np.float32))
    with pytest.raises(NotFound):
        media.vertex_numbers(mine / "head.ply", "curvature")
    lifted = Mesh(mesh.vertices + [0, 0, 2.5], mesh.faces)
    theirs = write_head(tmp_path / "theirs", lifted, quality)
    np.testing.assert_allclose(media.to_surface(mine, theirs / "head.ply"), 2.5, atol=1e-5)


@pytest.mark.parametrize("shared_vertices", [True, False])
def test_heads_of_two_captures_are_compared_after_a_rigid_motion(tmp_path: Path, shared_vertices: bool) -> None:
    bumpy = grid(16)
    x, y, _ = bumpy.vertices.T
    bumpy = Mesh(bumpy.vertices + np.stack([0 * x, 0 * x, 12 * np.sin(x / 31) * np.cos(y / 23)], axis=1), bumpy.faces)
    motion = RigidTransform(rotation_from_vector(np.array([0.03, -0.05, 0.04])), np.array([300.0, -80.0, 40.0]))
    moved = Mesh(motion.apply(bumpy.vertices), bumpy.faces)
    if not shared_vertices:  # two more vertices that no face uses: the meshes are no longer of one model
        moved = Mesh(np.concatenate([moved.vertices, moved.vertices[:2]]), moved.faces)
    mine, theirs = write_head(tmp_path / "mine", bumpy), write_head(tmp_path / "theirs", moved)
    distance = media.to_surface(mine, theirs / "head.ply", align=True)
    # the files hold float32: 3e-5 mm at 300 mm; nearest points converge to less than a hundredth of the step
    assert distance.max() < (1e-3 if shared_vertices else 0.1)


def camera(name: str, angle: float) -> Camera:
    intrinsics = Intrinsics(640, 480, 800.0, 805.0, 318.0, 241.0, Distortion(-0.12, 0.03, 0.001, -0.0005, 0.0))
    turn = rotation_from_vector(np.array([0.0, angle, 0.0]))
    return Camera(name, intrinsics, RigidTransform(turn, np.array([0.0, 0.0, 1200.0])))


RIG = Rig((camera("left", -0.5), camera("front", 0.0), camera("right", 0.45)))
coordinates = st.floats(-90.0, 90.0)


@given(coordinates, coordinates, coordinates)
def test_a_guide_passes_through_the_point_that_was_picked(x: float, y: float, z: float) -> None:
    point = np.array([[x, y, z]])
    seen = {c.name: c.project(point)[0] for c in RIG}
    curve = guides.guide(RIG, "left", seen["left"], "front")
    ends, starts = curve[1:], curve[:-1]
    along = np.clip(((seen["front"] - starts) * (ends - starts)).sum(1) / ((ends - starts) ** 2).sum(1), 0, 1)
    # samples are 10 mm apart on the ray; between them the lens bends the curve by far less than a tenth of a pixel
    assert np.linalg.norm(seen["front"] - starts - along[:, None] * (ends - starts), axis=1).min() < 0.1


def test_three_picked_points_place_the_models_landmarks() -> None:
    rng = np.random.default_rng(3)
    head = {name: rng.normal(0, 40, 3) for name in "abcdefg"}
    place = RigidTransform(rotation_from_vector(np.array([0.1, -0.2, 0.05])), np.array([8.0, -5.0, 12.0]))
    world = {name: place.apply(point[None])[0] for name, point in head.items()}
    picked = {n: {c.name: c.project(world[n][None])[0] for c in RIG if c.name != "right"} for n in "abd"}
    result = guides.Guides(RIG).helps(picked, head, list(picked))
    for name in "abcdefg":
        for c in RIG:
            np.testing.assert_allclose(result["predicted"][name][c.name], c.project(world[name][None])[0], atol=0.02)
    for name in picked:
        np.testing.assert_allclose(
            result["reprojected"][name]["right"], RIG["right"].project(world[name][None])[0], atol=0.02
        )
        assert max(result["off_px"][name].values()) < 0.01
    assert guides.Guides(RIG).helps({"a": picked["a"]}, head, [])["predicted"] == {}
    assert guides.nearest_views(RIG, "front", 2) == ["front", "right"]


def test_coverage_names_the_next_thing_to_do() -> None:
    everywhere = [[x, y] for x in np.linspace(0.02, 0.98, 9) for y in np.linspace(0.02, 0.98, 7)]
    corner = [[0.1, 0.1], [0.12, 0.2], [0.2, 0.12]]
    lines = coverage.summary(["a", "b", "c"], [])
    assert coverage.advice(lines) == compose("board-hold")
    lines = coverage.summary(["a", "b", "c"], [{"a": everywhere, "b": corner, "c": []}])
    assert [line["covered"] for line in lines] == [1.0, round(1 / 12, 3), 0.0]
    assert coverage.advice(lines) == compose("board-turn-to", cameras=["c"])
    lines = coverage.summary(["a", "b"], [{"a": everywhere, "b": corner}] * 6)
    assert [line["enough"] for line in lines] == [True, False]
    assert coverage.advice(lines) == compose("board-cover", cameras=["b"])
    lines = coverage.summary(["a"], [{"a": everywhere}] * 6)
    assert coverage.advice(lines) == compose("board-covered")


def test_a_jobs_log_has_one_line_a_stage() -> None:
    stages = [("read", 0.0), ("fit", 1.0), ("fit", 1.5), ("texture", 2.25)]
    events = [JobEvent(i, 100.0 + at, {"stage": stage}) for i, (stage, at) in enumerate(stages)]
    assert log_lines(events) == [
        {"at_s": 0.0, "text": "read"},
        {"at_s": 1.0, "text": "fit"},
        {"at_s": 2.2, "text": "texture"},
    ]
    assert log_lines([]) == []


def test_the_restart_form_becomes_settings() -> None:
    event = {"method": "simplex", "detail": "", "front": "cam03", "more": '{"fitting": {"modes": 80}}'}
    assert chosen_settings(event) == {"method": "simplex", "front": "cam03", "fitting": {"modes": 80}}
    assert chosen_settings({}) == {}
    for wrong in ("{", "[1]"):
        with pytest.raises(InputError):
            chosen_settings({"more": wrong})


def test_the_captures_form_becomes_work() -> None:
    assert chosen_work({"id": "", "model": "", "method": "", "template": ""}) == ReconstructionRequest(None, {})
    work = chosen_work({"id": "", "model": "ict", "method": "texture", "template": "flame"})
    assert work == ReconstructionRequest(
        "ict", {"outputs": {"formats": ["glb", "ply", "obj", "usdz"], "template": "flame"}}
    )
    assert settings_of("texture") == {"outputs": {"formats": ["glb", "ply", "obj", "usdz"]}}  # as it was


@pytest.mark.parametrize("preset", PRESETS, ids=lambda preset: preset.id or "standard")
def test_no_preset_is_warned_of(preset: Preset) -> None:
    _, warnings = find_layout(load_model(), settings_from_document(preset.settings))
    assert [warning.text for warning in warnings] == []


def test_a_look_on_the_wire_holds_every_picture() -> None:
    frames = [
        {"name": "a", "jpeg": b"abc", "mean": 1.0},
        {"name": "b", "jpeg": None, "fault": verbatim("unplugged").document()},
    ]
    message = look_bytes(frames, None)
    header, body = struct.unpack(">II", message[:8])
    document = json.loads(message[8 : 8 + header])
    assert [(c["name"], c["bytes"]) for c in document["cameras"]] == [("a", 3), ("b", 0)]
    assert message[8 + header :] == b"abc"
    assert body == 3


def test_the_live_view_names_an_error_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it comes from: here not from the cameras."""
    monkeypatch.setattr(live, "AGAIN_S", 0.0)
    monkeypatch.setattr(live, "KEEP_S", 0.5)
    errors = iter([Unavailable("rig-unavailable", compose("live-no-pictures"))])

    def describe() -> RigOut:
        for error in errors:
            raise error
        return RigOut(id="", kind="real", ready=True, cameras=[], faults=(), calibration=None)

    rig = SimpleNamespace(describe=describe, look=dict)
    view = live.LiveView(SimpleNamespace(rig=rig, live=SimpleNamespace(offer=lambda *_: SHOWN)))  # type: ignore[arg-type]

    async def faults() -> list[str | None]:
        stream = view.stream()
        headers = [json.loads((await anext(stream))[8:]) for _ in range(2)]
        return [header["fault"] and header["fault"]["code"] for header in headers]

    assert asyncio.run(faults()) == ["live-no-pictures", None]


def test_a_session_is_worth_what_its_key_is(tmp_path: Path) -> None:
    settings = ServiceSettings(data=tmp_path)
    engine = open_database(settings)
    keys = Keys(engine)
    service = SimpleNamespace(settings=settings, keys=keys)
    assert caller_of(service, {}).key == "local"  # type: ignore[arg-type]
    key = keys.add("console", ("read",))
    identity = key.split("_")[1]
    assert caller_of(service, {}) is None  # type: ignore[arg-type]
    caller = caller_of(service, {"key_id": identity})  # type: ignore[arg-type]
    assert permit(caller, "read").key == identity
    with pytest.raises(Forbidden, match="scope 'capture'"):
        permit(caller, "capture")
    keys.add("other", ("admin",))
    keys.remove(identity)
    assert caller_of(service, {"key_id": identity}) is None  # type: ignore[arg-type]
    with pytest.raises(Unauthenticated, match="sign in"):
        permit(None, "read")
    engine.dispose()
