import assert from "node:assert/strict";
import test from "node:test";
import { THREE } from "nicegui-scene";
import { fitted, lookThrough } from "/console/static/look_through.js";

const VIEW = {
  width: 640,
  height: 480,
  fx: 800,
  fy: 805,
  cx: 318,
  cy: 241,
  camera_from_head: [
    [0.96, 0, 0.28, 0.01],
    [0, -1, 0, -0.02],
    [0.28, 0, -0.96, 1.1],
  ],
};
VIEW.camera_from_head.push([0, 0, 0, 1]);

// Written out anew: head to camera, pinhole, then the picture's place in the canvas. Pixel (0, 0) is a centre.
function onCanvas(point, width, height) {
  const [x, y, z] = VIEW.camera_from_head
    .slice(0, 3)
    .map((row) => row[3] + row.slice(0, 3).reduce((sum, r, i) => sum + r * point[i], 0));
  const scale = Math.min(width / VIEW.width, height / VIEW.height);
  const pixel = [(VIEW.fx * x) / z + VIEW.cx + 0.5, (VIEW.fy * y) / z + VIEW.cy + 0.5];
  return [(width - scale * VIEW.width) / 2 + scale * pixel[0], (height - scale * VIEW.height) / 2 + scale * pixel[1]];
}

test("a picture lies as large as it fits in the middle", () => {
  assert.deepEqual(fitted({ width: 640, height: 480 }, 1280, 1280), {
    scale: 2,
    left: 0,
    top: 160,
    width: 1280,
    height: 960,
  });
  assert.deepEqual(fitted({ width: 640, height: 480 }, 1000, 480), {
    scale: 1,
    left: 180,
    top: 0,
    width: 640,
    height: 480,
  });
});

for (const [width, height] of [
  [640, 480],
  [1366, 600],
  [400, 900],
])
  test(`points of the head fall where the camera saw them, ${width} x ${height}`, () => {
    const camera = lookThrough(THREE, VIEW, width, height);
    for (const point of [
      [0, 0, 0],
      [0.07, -0.09, 0.08],
      [-0.06, 0.11, -0.03],
    ]) {
      const seen = new THREE.Vector3(...point).project(camera);
      const [x, y] = onCanvas(point, width, height);
      assert.ok(Math.abs(((seen.x + 1) / 2) * width - x) < 1e-6, `x of ${point}`);
      assert.ok(Math.abs(((1 - seen.y) / 2) * height - y) < 1e-6, `y of ${point}`);
      assert.ok(Math.abs(seen.z) < 1, "within the near and the far plane");
    }
  });
