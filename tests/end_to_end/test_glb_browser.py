"""head.glb opened by three.js in a real browser, pictured, and compared with our own drawing of the same view."""

import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import nicegui
import numpy as np
import pytest

from pipeline.zbuffer import picture
from rig.camera import Camera, Intrinsics
from rig.capture import read_image
from rig.geometry import look_at
from rig.mesh import Mesh
from rig.mesh_files import srgb_from_linear, write_glb
from tests.pipeline.scenes import ellipsoid, pattern

pytestmark = pytest.mark.slow
CHROMIUM = "/usr/bin/chromium"
FLAGS = [
    "--no-sandbox",
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a GPU
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
SIZE, FIELD_DEG, EYE_M = 400, 20.0, (0.35, 0.25, 0.9)
PAGE = """<!doctype html><link rel="icon" href="data:,"><body style="margin:0"><script type="module">
import {THREE, GLTFLoader} from "./three.js";
const renderer = new THREE.WebGLRenderer({antialias: false, preserveDrawingBuffer: true});
renderer.setSize(%(size)d, %(size)d);
document.body.appendChild(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color("white");
const camera = new THREE.PerspectiveCamera(%(field)f, 1, 0.01, 10);
camera.position.set(%(eye)s);
camera.lookAt(0, 0, 0);
new GLTFLoader().load("./head.glb", gltf => {
  const found = {meshes: 0};
  gltf.scene.traverse(node => {
    if (!node.isMesh) return;
    found.meshes += 1;
    found.vertices = node.geometry.attributes.position.count;
    found.triangles = node.geometry.index.count / 3;
    found.vertexColors = node.material.vertexColors;
    found.hasNormals = !!node.geometry.attributes.normal;
    node.material = new THREE.MeshBasicMaterial({vertexColors: true, side: THREE.FrontSide});
  });
  const box = new THREE.Box3().setFromObject(gltf.scene);
  found.low = box.min.toArray(); found.high = box.max.toArray();
  scene.add(gltf.scene);
  renderer.render(scene, camera);
  window.found = found;
}, undefined, error => { window.found = {error: String(error)}; });
</script></body>"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def site(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder served on the loopback, with three.js as it comes inside nicegui."""
    three = Path(nicegui.__file__).parent / "elements" / "scene" / "dist" / "index.js"
    shutil.copy(three, tmp_path / "three.js")
    page = PAGE % {"size": SIZE, "field": FIELD_DEG, "eye": ", ".join(map(str, EYE_M))}
    (tmp_path / "index.html").write_text(page)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield tmp_path, f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    thread.join()
    server.server_close()


def open_page(url: str, shot: Path, profile: Path) -> tuple[dict[str, Any], list[str]]:
    """What the page found, and what the browser complained of; the picture goes to ``shot``."""
    if not Path(CHROMIUM).exists():
        pytest.skip("no chromium: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    complaints: list[str] = []
    with sync_playwright() as play:
        browser = play.chromium.launch_persistent_context(
            str(profile), executable_path=CHROMIUM, headless=True, args=FLAGS, viewport={"width": SIZE, "height": SIZE}
        )
        page = browser.new_page()
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda entry: complaints.append(entry.text) if entry.type == "error" else None)
        page.goto(url)
        page.wait_for_function("window.found !== undefined", timeout=60_000)
        found = page.evaluate("window.found")
        page.screenshot(path=str(shot))
        browser.close()
    return found, complaints


def our_drawing(mesh: Mesh, colours: np.ndarray) -> np.ndarray:
    focal = SIZE / 2 / np.tan(np.radians(FIELD_DEG) / 2)
    lens = Intrinsics(SIZE, SIZE, focal, focal, (SIZE - 1) / 2, (SIZE - 1) / 2)
    eye = 1000 * np.array(EYE_M)
    camera = Camera("browser", lens, look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0])))
    return picture(camera, mesh.vertices, mesh.faces, colours)


def test_three_js_shows_the_head_as_we_do(site: tuple[Path, str], tmp_path_factory: pytest.TempPathFactory) -> None:
    folder, url = site
    mesh = ellipsoid(5)
    colours = np.rint(255 * srgb_from_linear(pattern(mesh.vertices))).astype(np.uint8)
    write_glb(folder / "head.glb", mesh, normals=mesh.normals(), colours=colours)
    shot = folder / "browser.png"
    found, complaints = open_page(url, shot, tmp_path_factory.mktemp("profile"))
    assert complaints == []
    assert found["meshes"] == 1
    assert (found["vertices"], found["triangles"]) == (len(mesh.vertices), len(mesh.faces))
    assert found["vertexColors"]
    assert found["hasNormals"]
    np.testing.assert_allclose(found["high"], mesh.vertices.max(axis=0) / 1000, atol=1e-6)  # metres
    seen, ours = read_image(shot).astype(float), our_drawing(mesh, colours).astype(float)
    inside = (ours < 250).any(axis=2)
    assert np.count_nonzero(inside != (seen < 250).any(axis=2)) < 0.01 * inside.sum()
    difference = np.abs(seen - ours)[inside]
    # Both interpolate over 4 mm triangles, three.js in linear light and we in codes: a few codes where they differ.
    assert np.median(difference) <= 2
    assert np.percentile(difference, 99) < 12
