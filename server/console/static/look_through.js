// A browser's camera that sees what a camera of the rig saw. Pixel (0, 0) is the centre of the first pixel; the picture
// lies as large as it fits in the middle of a canvas of w x h.
export function fitted(view, w, h) {
  const scale = Math.min(w / view.width, h / view.height);
  return {
    scale,
    left: (w - scale * view.width) / 2,
    top: (h - scale * view.height) / 2,
    width: scale * view.width,
    height: scale * view.height,
  };
}

export function lookThrough(THREE, view, w, h, near = 0.05, far = 20) {
  const { scale, left, top } = fitted(view, w, h);
  const fx = (2 * scale * view.fx) / w,
    fy = (2 * scale * view.fy) / h;
  const cx = (scale * (view.cx + 0.5) + left) / w,
    cy = (scale * (view.cy + 0.5) + top) / h;
  const camera = new THREE.Camera();
  camera.projectionMatrix.set(
    fx,
    0,
    1 - 2 * cx,
    0,
    0,
    fy,
    2 * cy - 1,
    0,
    0,
    0,
    -(far + near) / (far - near),
    (-2 * far * near) / (far - near),
    0,
    0,
    -1,
    0,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  const flip = new THREE.Matrix4().makeScale(1, -1, -1); // a camera of the rig looks along +z with y down, one of three.js along -z with y up
  camera.matrix.copy(flip.multiply(new THREE.Matrix4().set(...view.camera_from_head.flat()))).invert();
  camera.matrixAutoUpdate = false;
  camera.updateMatrixWorld(true);
  return camera;
}
