import assert from "node:assert/strict";
import test from "node:test";
import { THREE } from "nicegui-scene";

globalThis.document = { fullscreenEnabled: false };
const { views3d } = await import("/console/static/views.js");

function page() {
  const geometry = { boundingSphere: new THREE.Sphere(new THREE.Vector3(0.01, 0.02, 0.03), 0.1) };
  const controls = { target: new THREE.Vector3(), update() {} };
  return {
    ...views3d.methods,
    ...views3d.data(),
    three: { THREE },
    mesh: { geometry },
    camera: new THREE.PerspectiveCamera(28),
    controls,
    draw() {},
  };
}

test("each side is seen from its own direction, and the sphere fits into the view", () => {
  const directions = { front: [0, 0, 1], left: [1, 0, 0], right: [-1, 0, 0], top: [0, 1, 0] };
  for (const [side, direction] of Object.entries(directions)) {
    const viewer = page();
    viewer.lookFrom(side);
    const away = viewer.camera.position.clone().sub(viewer.controls.target);
    assert.ok(
      away
        .clone()
        .normalize()
        .distanceTo(new THREE.Vector3(...direction)) < 1e-3,
      side,
    );
    assert.ok(Math.asin(0.1 / away.length()) < THREE.MathUtils.degToRad(14), "half of 28 degrees");
  }
});

test("the key goes once through all sides", () => {
  const viewer = page();
  const seen = views3d.data().sides.map(() => {
    viewer.nextSide();
    return viewer.side;
  });
  assert.equal(new Set(seen).size, 5);
  viewer.nextSide();
  assert.equal(viewer.side, seen[0]);
});

test("a side is left by a turn, not by a click", () => {
  const viewer = page();
  viewer.lookFrom("left");
  viewer.turned();
  assert.equal(viewer.side, "left");
  viewer.camera.position.x += 0.01;
  viewer.turned();
  assert.equal(viewer.side, "");
});
