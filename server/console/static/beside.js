// Another head beside the shown one, seen by the same camera, so that both turn together; each lies in its head's frame.
// A page that mixes it in has THREE and GLTFLoader as this.three, mesh, material, flat, colouring, other, numbers(), heat(), draw() and fit().
import { say } from "/console/static/language.js";

export const besideIt = {
  data: () => ({ beside: false, theirs: null, split: false }),
  computed: {
    mateId() {
      return this.beside && this.other !== "truth" && !this.through ? this.other : "";
    },
    compared() {
      // measurements of both heads
      const mine = Object.entries(this.job?.measurements || {});
      return mine.map(([name, m]) => ({ name, ...m, theirs: this.theirs?.[name] }));
    },
  },
  watch: {
    mateId() {
      this.showMate();
      this.compare();
    },
    other(id) {
      this.readMeasurements(id);
    },
  },
  methods: {
    async readMeasurements(id) {
      this.theirs = null;
      if (!id || id === "truth") return;
      const answer = await fetch(`/console/jobs/${id}/report.json`);
      if (answer.ok && id === this.other) this.theirs = (await answer.json()).measurements || {};
    },
    async showMate() {
      this.dropMate();
      const { THREE, GLTFLoader } = this.three,
        id = this.mateId;
      if (!id) {
        this.split = false;
        this.fit();
        return;
      }
      this.loading = true;
      try {
        const head = await new GLTFLoader().loadAsync(`/console/jobs/${id}/head.glb`);
        if (id !== this.mateId) return;
        let found = null;
        head.scene.traverse((o) => {
          if (o.isMesh) found = o;
        });
        this.mate = new THREE.Mesh(found.geometry, this.material);
        this.mate.visible = false;
        this.scene.add(this.mate);
        this.mateRepeated = head.asset.extras?.repeated_vertices || [];
        this.mateColours = found.geometry.attributes.color?.clone();
        this.mateSkin = found.material.map
          ? new THREE.MeshStandardMaterial({
              map: found.material.map,
              roughness: 0.85,
              metalness: 0,
              side: THREE.DoubleSide,
            })
          : null;
        this.split = true;
        this.fit();
        await this.paintMate();
      } catch (error) {
        this.fault = say("The other head cannot be shown: {reason}", { reason: say(error.message) });
      } finally {
        this.loading = false;
      }
    },
    async paintMate() {
      // uncertainty by the scale of the shown head
      if (!this.mate) return;
      const { THREE } = this.three,
        { mate } = this,
        geometry = mate.geometry;
      mate.material = this.material;
      if (this.colouring === "uncertainty" && this.scale) {
        const values = await this.numbers("head.quality.f32", this.mateId);
        if (mate !== this.mate || !this.scale) return;
        mate.material = this.flat;
        geometry.setAttribute("color", this.heat(values, this.mateRepeated, this.scale.most));
      } else if (this.colouring === "texture" && this.mateSkin) {
        mate.material = this.mateSkin;
        this.mateSkin.wireframe = this.wire;
      } else if (this.colouring === "texture" && this.mateColours) geometry.setAttribute("color", this.mateColours);
      else
        geometry.setAttribute(
          "color",
          new THREE.BufferAttribute(new Float32Array(3 * geometry.attributes.position.count).fill(0.55), 3),
        );
      this.draw();
    },
    dropMate() {
      if (!this.mate) return;
      this.scene.remove(this.mate);
      this.mate.geometry.dispose();
      this.mateSkin?.map.dispose();
      this.mateSkin?.dispose();
      this.mate = this.mateSkin = null;
    },
    renderPair(width, height) {
      // each half is drawn with the other head hidden
      const half = width / 2;
      this.renderer.setScissorTest(true);
      [
        [this.mesh, this.mate, 0],
        [this.mate, this.mesh, half],
      ].forEach(([shown, hidden, left]) => {
        shown.visible = true;
        hidden.visible = false;
        this.renderer.setViewport(left, 0, half, height);
        this.renderer.setScissor(left, 0, half, height);
        this.renderer.render(this.scene, this.camera);
      });
      this.mesh.visible = true;
      this.mate.visible = false;
      this.renderer.setScissorTest(false);
      this.renderer.setViewport(0, 0, width, height);
    },
  },
};
