"""head.glb and bust.glb of a reconstructed head opened by three.js in a real browser, pictured, and compared with
our own drawing of the same view."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from typing import Any

import cv2
import nicegui
import numpy as np
import pytest
from playwright.sync_api import Browser, ViewportSize

from pipeline.geometry.projection import picture
from rig.camera import Camera, Intrinsics
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.pictures.images import read_image
from rig.geometry import look_at
from rig.mesh import Mesh
from tests.support.browser import Visit
from tests.support.loopback import served
from tests.support.shared_data import shared

pytestmark = pytest.mark.slow
SIZE, EYE_M = 400, (0.25, 0.05, 0.95)
FIELDS_DEG = {"bust.glb": 20.0, "head.glb": 6.0}  # the whole head; from the mouth to the brows
PAGE = """<!doctype html><link rel="icon" href="data:,"><body style="margin:0"><script type="module">
import {THREE, GLTFLoader} from "./three.js";
const renderer = new THREE.WebGLRenderer({antialias: false, preserveDrawingBuffer: true});
renderer.setSize(%(size)d, %(size)d);
document.body.appendChild(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color("white");
const [file, field] = location.search.slice(1).split("&");
const camera = new THREE.PerspectiveCamera(Number(field), 1, 0.01, 10);
camera.position.set(%(eye)s);
camera.lookAt(0, 0, 0);
new GLTFLoader().load("./" + file, gltf => {
  const found = {meshes: 0};
  gltf.scene.traverse(node => {
    if (!node.isMesh) return;
    found.meshes += 1;
    found.vertices = node.geometry.attributes.position.count;
    found.triangles = node.geometry.index.count / 3;
    found.vertexColors = node.material.vertexColors;
    found.hasNormals = !!node.geometry.attributes.normal;
    const {map, vertexColors} = node.material;
    found.texture = map ? map.image.width : 0;
    node.material = new THREE.MeshBasicMaterial({map, vertexColors, side: THREE.FrontSide});
  });
  const box = new THREE.Box3().setFromObject(gltf.scene);
  found.low = box.min.toArray(); found.high = box.max.toArray();
  scene.add(gltf.scene);
  renderer.render(scene, camera);
  window.found = found;
}, undefined, error => { window.found = {error: String(error)}; });
</script></body>"""


@pytest.fixture
def site(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder served on the loopback, with three.js as it comes inside nicegui."""
    three = Path(nicegui.__file__).parent / "elements" / "scene" / "dist" / "index.js"
    shutil.copy(three, tmp_path / "three.js")
    page = PAGE % {"size": SIZE, "eye": ", ".join(map(str, EYE_M))}
    (tmp_path / "index.html").write_text(page)
    with served(SimpleHTTPRequestHandler, tmp_path) as url:
        yield tmp_path, f"{url}/"


def open_page(browser: Browser, url: str, query: str, shot: Path) -> dict[str, Any]:
    """What the page found, without a complaint of the browser; the picture goes to ``shot``."""
    visited = Visit(browser.new_page(viewport=ViewportSize(width=SIZE, height=SIZE)), url)
    visited.page.goto(url + query)
    visited.page.wait_for_function("window.found !== undefined")
    visited.page.screenshot(path=shot)
    visited.check_clean()
    return visited.page.evaluate("window.found")


def our_drawing(mesh: Mesh, colours: np.ndarray, field_deg: float) -> np.ndarray:
    focal = SIZE / 2 / np.tan(np.radians(field_deg) / 2)
    lens = Intrinsics(SIZE, SIZE, focal, focal, (SIZE - 1) / 2, (SIZE - 1) / 2)
    eye = 1000 * np.array(EYE_M)
    camera = Camera("browser", lens, look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0])))
    return picture(camera, mesh.vertices, mesh.faces, colours)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command line makes of photographs of a real head."""
    out = tmp_path_factory.mktemp("result")
    options = ["--out", str(out), "--detail", "span", "--formats", "glb,ply"]
    command = [sys.executable, "-m", "server.cli", "reconstruct", str(shared("data/captures/scan-a"))]
    subprocess.run([*command, *options], check=True, timeout=600)
    return out


@pytest.mark.parametrize("name", ["head.glb", "bust.glb"])
@pytest.mark.timeout(900)
def test_three_js_shows_the_head_as_we_do(name: str, result: Path, site: tuple[Path, str], browser: Browser) -> None:
    folder, url = site
    shutil.copy(result / name, folder)
    shot = result / f"{name}.png"
    found = open_page(browser, url, f"?{name}&{FIELDS_DEG[name]}", shot)
    head, written = read_mesh(result / name), read_mesh((result / name).with_suffix(".ply"))
    head = Mesh(1000 * head.vertices, head.faces)
    assert found["meshes"] == 1
    assert found["triangles"] == len(head.faces)
    assert found["hasNormals"]
    assert not found["vertexColors"]
    assert found["texture"] in (1024, 2048)
    np.testing.assert_allclose(found["high"], head.vertices.max(axis=0) / 1000, atol=1e-6)  # metres
    assert written.colours is not None
    seen = read_image(shot).astype(np.float32)
    shown = Mesh(head.vertices[: len(written.vertices)], written.faces)  # without what the seam repeats
    ours = our_drawing(shown, written.colours, FIELDS_DEG[name]).astype(np.float32)
    inside = (ours < 250).any(axis=2)
    assert np.count_nonzero(inside != (seen < 250).any(axis=2)) < 0.01 * inside.sum()
    # Over a few pixels a texture is as bright as the vertices' colours; finer, it shows more than they can.
    even = [cv2.GaussianBlur(image, (0, 0), 3.0) for image in (seen, ours)]
    core = cv2.GaussianBlur(np.asarray(inside, np.float32), (0, 0), 5.0) > 0.99
    assert np.median(np.abs(even[0] - even[1])[core]) <= 2
    fine = [np.abs(cv2.Laplacian(image, cv2.CV_32F))[core].mean() for image in (seen, ours)]
    # A bust's pixels of 2 mm are wider than its triangles of 1.5 mm, so that both show as much, to a hundredth.
    assert fine[0] > (1.1 if name == "head.glb" else 0.98) * fine[1]
