"""head-NAME.glb of a template opened and played by three.js in a real browser."""

from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from pipeline.applications.templates.animated import AnimatedMesh, animate_mesh
from pipeline.applications.templates.write.writers import animated_scene
from pipeline.evidence.expression import build_blendshape_rig
from pipeline.head_model.expressions import VISEMES
from pipeline.head_model.model import load_model
from rig.formats.meshes.glb import scene_glb_bytes
from rig.geometry import Similarity
from rig.mesh import Mesh
from tests.end_to_end.test_glb_browser import open_page, site
from tests.support.ready_templates import ready_template

__all__ = ["site"]  # a fixture
pytestmark = pytest.mark.slow
NAMES = ("jawOpen", "eyeBlinkLeft")
PAGE = """<!doctype html><link rel="icon" href="data:,"><body><script type="module">
import {THREE, GLTFLoader} from "./three.js";
new GLTFLoader().load("./head.glb", gltf => {
  const {scene} = gltf, head = scene.getObjectByName("head"), found = {nodes: [], names: head.morphTargetDictionary};
  scene.traverse(node => found.nodes.push(node.name));
  const place = (mesh, row) => {
    scene.updateMatrixWorld(true);
    return mesh.localToWorld(mesh.getVertexPosition(row, new THREE.Vector3())).toArray();
  };
  const [chin, iris] = ROWS, eye = scene.getObjectByName("eye_left");
  head.morphTargetInfluences.fill(0);
  found.rest = place(head, chin);
  head.morphTargetInfluences[found.names.jawOpen] = 0.5;
  found.half = place(head, chin);
  found.iris = place(eye, iris);
  eye.rotation.y = 0.5;
  found.turned = place(eye, iris);
  window.found = found;
}, undefined, error => { window.found = {error: String(error)}; });
</script></body>"""


@pytest.fixture(scope="module")
def animated() -> tuple[AnimatedMesh, bytes]:
    model, template = load_model(), ready_template(load_model())
    faces, mean = model.levels["full"].faces, model.vertices(np.zeros(0))
    morphs = build_blendshape_rig(model, Similarity.identity(), Mesh(mean, faces), ()).morphs
    shapes, triangles = {name: morphs[name] for name in NAMES}, template.mesh.triangles()
    made = animate_mesh(template.surface_binding, triangles, mean, faces, shapes, model.landmarks)
    colours = np.full((len(made.neutral), 3), 180, np.uint8)
    return made, scene_glb_bytes(animated_scene(made, triangles, colours, {}))


@pytest.mark.timeout(600)
def test_three_js_opens_the_mouth_and_turns_the_eye(
    animated: tuple[AnimatedMesh, bytes], site: tuple[Path, str], browser: Browser
) -> None:
    made, glb = animated
    folder, url = site
    chin = int(np.abs(made.shapes["jawOpen"][:, 1]).argmax())
    eye = made.eyeballs["eye_left"]
    iris = int(made.neutral[eye][:, 2].argmax())
    (folder / "head.glb").write_bytes(glb)
    (folder / "index.html").write_text(PAGE.replace("ROWS", f"[{chin}, {iris}]"))
    found = open_page(browser, url, "", folder / "shot.png")
    assert {"neck", "head", "jaw", "eye_left", "eye_right"} <= set(found["nodes"])
    assert sorted(found["names"]) == sorted([*NAMES, *VISEMES])
    np.testing.assert_allclose(found["rest"], made.neutral[chin] / 1000.0, atol=1e-6)
    half = made.neutral[chin] + 0.5 * made.shapes["jawOpen"][chin]
    np.testing.assert_allclose(found["half"], half / 1000.0, atol=1e-5)
    pivot = made.pivots["eye_left"] / 1000.0
    before, after = np.array(found["iris"]) - pivot, np.array(found["turned"]) - pivot
    np.testing.assert_allclose(np.linalg.norm(after), np.linalg.norm(before), atol=1e-6)
    gaze = np.arctan2(after[0], after[2]) - np.arctan2(before[0], before[2])
    np.testing.assert_allclose(gaze, 0.5, atol=1e-4)
