// Views from fixed sides, which fit what is shown into the window, and the whole screen. A page that mixes it in has
// THREE as this.three, mesh, camera, controls and draw(). Sides are the subject's: x to their left, y up, the face to +z.
const SIDES = [
  ["front", "Front", [0, 0, 1]],
  ["threequarter", "Three-quarter", [0.26, 0.06, 0.96]],
  ["left", "Left", [1, 0, 0]],
  ["right", "Right", [-1, 0, 0]],
  ["top", "Top", [0, 1, 1e-4]],
];
const AWAY = 4.25; // radii of the mesh's sphere, which the view's 28 degrees then just hold

export const views3d = {
  data: () => ({ side: "", full: false, canFill: !!document.fullscreenEnabled, sides: SIDES }),
  mounted() {
    document.addEventListener("fullscreenchange", this.filled);
  },
  unmounted() {
    document.removeEventListener("fullscreenchange", this.filled);
  },
  methods: {
    lookFrom(name) {
      if (!this.mesh) return;
      const { THREE } = this.three,
        { center, radius } = this.mesh.geometry.boundingSphere;
      const [, , direction] = SIDES.find(([known]) => known === name);
      this.side = name;
      this.controls.target.copy(center);
      this.camera.position.copy(center).add(new THREE.Vector3(...direction).setLength(AWAY * radius));
      this.controls.update();
      this.draw();
      this.stood = this.camera.position.clone();
    },
    nextSide() {
      const at = SIDES.findIndex(([name]) => name === this.side);
      this.lookFrom(SIDES[(at + 1) % SIDES.length][0]);
    },
    turned() {
      if (this.stood && this.camera.position.distanceTo(this.stood) > 1e-6) this.side = "";
    }, // a click alone turns nothing
    fill() {
      if (document.fullscreenElement) document.exitFullscreen();
      else this.$refs.view.requestFullscreen();
    },
    filled() {
      this.full = !!document.fullscreenElement;
    },
  },
};
