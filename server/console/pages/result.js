// The head in three.js: a mesh in metres, x to the subject's left, y up, the face towards +z.
import { GLTFLoader, OrbitControls, THREE } from "nicegui-scene";
import { besideIt } from "/console/static/beside.js";
import { FaceMarks, facesOf } from "/console/static/faces.js";
import { exports3d } from "/console/static/exports.js";
import { say, spoken } from "/console/static/language.js";
import { told } from "/console/static/messages.js";
import { fitted, lookThrough } from "/console/static/look_through.js";
import { views3d } from "/console/static/views.js";
import { clock, fixed, keepAddress, levelWords, methodWords, size, span, typing } from "/console/static/words.js";

// viridis sampled at nine places (dark is small), as linear steps between them; it stays readable without colour vision
const RAMP = [
  [0.267, 0.005, 0.329],
  [0.283, 0.141, 0.458],
  [0.254, 0.265, 0.53],
  [0.207, 0.372, 0.553],
  [0.164, 0.471, 0.558],
  [0.128, 0.567, 0.551],
  [0.267, 0.679, 0.48],
  [0.478, 0.821, 0.318],
  [0.993, 0.906, 0.144],
];
const LIGHTS = {
  studio: [
    [0.6, 0.8, 1.2, 1.6],
    [-1.2, 0.3, 0.7, 0.7],
    [0.2, 0.9, -1.2, 0.8],
  ],
  side: [
    [1.5, 0.3, 0.25, 2.6],
    [-1, 0, 0.4, 0.15],
    [0, 1, -1, 0.3],
  ],
  flat: [
    [0, 0.2, 1, 1.0],
    [0, 0, -1, 0.6],
    [0, 1, 0, 0.3],
  ],
};
const COLOURINGS = [
  ["texture", "Texture", "T"],
  ["clay", "Clay", "G"],
  ["uncertainty", "Uncertainty", "U"],
  ["parts", "Parts", "P"],
];
const SURFACES = [
  ["head", "Head", "H"],
  ["bust", "Bust", "B"],
];
const PARTS = [
  ["unseen", [0.45, 0.47, 0.5]],
  ["skin", [0.9, 0.65, 0.5]],
  ["hair", [0.35, 0.25, 0.6]],
  ["clothes", [0.2, 0.6, 0.55]],
];
const FAR = 4; // medians: what lies beyond is shown as the scale's end, so that shoulders do not stretch it
const FOV_DEG = 28; // up and down; in a view that is higher than wide about as much across
const MM = 1000;

function ramp(share) {
  const at = Math.min(1, Math.max(0, share)) * (RAMP.length - 1),
    i = Math.min(RAMP.length - 2, Math.floor(at)),
    rest = at - i;
  return RAMP[i].map((value, k) => value + rest * (RAMP[i + 1][k] - value));
}

function stop(values, share) {
  // a quantile: one far vertex must not stretch the scale
  const sorted = Float32Array.from(values).sort();
  return sorted[Math.floor(share * (sorted.length - 1))];
}

function nice(value) {
  const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-3)));
  return [1, 1.5, 2, 3, 4, 5, 7.5, 10].map((step) => step * power).find((candidate) => candidate >= value * 0.999);
}

export default spoken({
  mixins: [besideIt, exports3d, facesOf, views3d],
  components: { FaceMarks },
  props: { state: Object },
  emits: ["act", "choose"],
  data: () => ({
    sought: new URLSearchParams(location.search).get("find") || "",
    surface: "head",
    through: "",
    fade: 0.35,
    cameras: [],
    camerasKnown: false,
    strangers: false,
    picture: null,
    colouring: "texture",
    wire: false,
    measuring: false,
    lights: "studio",
    other: "",
    form: "obj",
    scale: null,
    loading: false,
    fault: "",
    points: [],
    pins: [],
    loaded: "",
    drawn: false,
    digits: 1,
  }),
  computed: {
    job() {
      return this.state.job;
    },
    surfaces() {
      return SURFACES.filter(([name]) => this.job?.files[`${name}.glb`]);
    },
    colourings() {
      return COLOURINGS.filter(([name]) => name !== "parts" || this.surface === "bust");
    },
    others() {
      return (this.state.results || []).filter((r) => r.id !== this.job?.id && (this.strangers || this.same(r)));
    },
    elsewhere() {
      return (this.state.results || []).filter((r) => r.id !== this.job?.id && !this.same(r)).length;
    },
    ofSubject() {
      return (this.state.results || []).filter((r) => r.id === this.job?.id || this.same(r));
    },
    ofOthers() {
      return (this.state.results || []).filter((r) => r.id !== this.job?.id && !this.same(r));
    },
    fileName() {
      // head-<subject>-<label>-<id>, of what every disk takes as a name
      const told = [this.job.subject, this.job.capture]
        .filter(Boolean)
        .join("-")
        .normalize("NFC")
        .replace(/[^\p{L}\p{N}]+/gu, "-")
        .replace(/^-|-$/g, "")
        .slice(0, 60);
      return ["head", told, this.job.id.slice(-6)].filter(Boolean).join("-");
    },
    distance() {
      return this.points.length === 2 ? MM * this.points[0].distanceTo(this.points[1]) : null;
    },
  },
  watch: {
    "job.id"(id) {
      if (id) {
        this.keepPlace();
        this.strangers = this.withFaces = false;
        this.load(id);
        this.readCameras(id);
      }
    },
    sought(text) {
      clearTimeout(this.typed);
      this.typed = setTimeout(() => this.$emit("choose", { find: text }), 250);
    },
    surface() {
      if (this.surface === "head" && this.colouring === "parts") this.colouring = "texture";
      this.load(this.job.id);
    },
    through() {
      this.fit();
    },
    withFaces(on) {
      if (on) this.readFaces(this.job.id, `/console/jobs/${this.job.id}/faces`);
    },
    async colouring() {
      await this.paint();
      this.paintMate();
      this.shine();
    },
    other() {
      this.compare();
      this.keepPlace();
    },
    wire() {
      this.showWire();
      this.paintMate();
      this.draw();
    },
    lights() {
      this.shine();
    },
    measuring(on) {
      if (!on) this.clearPoints();
    },
  },
  template: `
    <section class="page" aria-label="Result">
      <header class="wraps"><h1>Result</h1>
        <label class="line grow">
          <span v-if="job" class="muted small">Head</span>
          <select v-if="job" :value="job.id" aria-label="Head" style="max-width: 24rem"
            @change="$emit('choose', { job: $event.target.value })">
            <optgroup label="Of this subject">
              <option v-for="r in ofSubject" :key="r.id" :value="r.id">{{ headName(r) }}</option>
            </optgroup>
            <optgroup v-if="ofOthers.length" label="Of others">
              <option v-for="r in ofOthers" :key="r.id" :value="r.id">{{ headName(r) }}</option>
            </optgroup>
          </select>
          <input v-if="state.total > 8" v-model="sought" id="find" type="search" maxlength="200"
            placeholder="Find a head" aria-label="Find heads" style="width: 9rem">
        </label>
        <template v-if="job">
          <span v-if="surfaces.length > 1" class="group" role="group" aria-label="Surface">
            <button v-for="[name, title, k] in surfaces" :key="name" class="b" :aria-pressed="surface === name"
              @click="surface = name">{{ say(title) }} <kbd>{{ k }}</kbd>
            </button>
          </span>
        <span class="group" role="group" aria-label="Colouring">
          <button v-for="[name, title, k] in colourings" :key="name" class="b"
            :aria-pressed="(!other || !!mateId) && colouring === name"
            @click="paintAs(name)">{{ say(title) }} <kbd>{{ k }}</kbd>
          </button>
        </span>
        <button class="b" :aria-pressed="wire" @click="wire = !wire">Wireframe <kbd>W</kbd></button>
        <button class="b" :aria-pressed="measuring" @click="measuring = !measuring">Measure <kbd>M</kbd></button>
      </template>
    </header>
      <div class="columns beside">
        <div class="panel view3d" ref="view">
          <img v-if="surfaces.length && !drawn" id="first-view" ref="first" class="first"
            :src="'/console/jobs/' + job.id + '/first-view.jpg'" alt="" @error="drawn = true">
          <img v-if="picture" :src="picture.address" :alt="say('Photograph of {name}', { name: through })"
            :style="picture.style">
          <canvas ref="canvas" v-show="job" :style="{ opacity: through ? 1 - fade : 1 }" tabindex="0" role="img"
            aria-label="The head in 3D: drag to turn, wheel to come near, arrow keys to turn" :data-loaded="loaded"
            @keydown="turn" @pointerdown="press" @click="pick"></canvas>
          <face-marks v-if="picture" :faces="facesIn(job.id, through)" :size="picture.size"
            :style="picture.style"></face-marks>
          <div v-if="!state.loading && !job" class="empty" style="position: absolute; inset: 0; align-content: center">
            <h2>{{ say(state.requested ? 'This job has no head' : 'No heads yet') }}</h2>
            <p>{{ say(state.requested ? 'It is not done, it failed, or it was removed.'
              : 'A head appears here when a job is done.') }}</p>
            <a class="b main-action" :href="state.requested ? '/jobs'
              : '/captures'">{{ say(state.requested ? 'Go to jobs' : 'Go to captures') }}</a>
          </div>
          <div v-if="scale" class="scale" role="img"
            :aria-label="say('{title}, 0 to {most} mm', { title: scale.title, most: fixed(scale.most, digits) })">
            <i :style="{ background: gradient }"></i>
            <div>
              <span>{{ scale.beyond ? '≥ ' : '' }}{{ fixed(scale.most, digits) }} mm</span>
              <span>{{ fixed(scale.most / 2, digits) }}</span>
              <span>0</span>
            </div>
          </div>
          <p v-if="scale" class="small" style="position: absolute; left: .9rem; top: .8rem">{{ scale.title }}<br>
            <span class="muted">{{ say('median {median} mm, 95 % below {p95} mm',
              { median: fixed(scale.median, 2), p95: fixed(scale.p95, 2) }) }}</span>
          </p>
          <template v-if="split">
            <p class="small cut" id="left-head"
              style="position: absolute; left: .9rem; top: 3.4rem; max-width: 45%">{{ headName(job) }}</p>
            <p class="small cut" id="right-head"
              style="position: absolute; left: 50%; top: 3.4rem; max-width: 45%">{{ headName(others.find(r => r.id === mateId)
                || job) }}</p>
          </template>
          <ul v-if="colouring === 'parts' && surface === 'bust' && !other" class="legend small" aria-label="Parts">
            <li v-for="[name, colour] in parts" :key="name">
              <i :style="{ background: 'rgb(' + colour.map(v => Math.round(255 * v)) + ')' }"></i>{{ say(name) }}</li>
          </ul>
          <div class="below">
            <p v-if="loading || fault" :class="['told', 'small', { fault }]"
              role="status">{{ say(fault || 'Loading ...') }}</p>
            <p v-if="measuring" id="measured" class="told" role="status">{{ points.length === 0
              ? say('Click the first point') : points.length === 1 ? say('Click the second point') : '' }}<strong
              v-if="distance"
              class="mono">{{ say('{distance} mm, straight', { distance: fixed(distance, 1) }) }}</strong>
            </p>
            <div v-if="surfaces.length && !through" class="views" role="group" aria-label="Views">
              <button v-for="[name, title] in sides" :key="name" class="b small" :data-side="name"
                :aria-pressed="side === name" @click="lookFrom(name)">{{ say(title) }}</button>
              <button v-if="canFill" class="b small" id="full" :aria-pressed="full"
                @click="fill">Full screen <kbd>F</kbd>
              </button>
            </div>
          </div>
          <span v-for="(pin, i) in pins" :key="i" class="pin small mono" :style="{ left: pin.x + 'px',
            top: pin.y + 'px', visibility: pin.shown ? 'visible' : 'hidden' }">{{ i
            ? 'B' : 'A' }}</span>
        </div>
        <div class="panel pad scroll stack" tabindex="0" role="region" aria-label="About the head">
          <template v-if="job">
            <ul v-if="job.warnings.length" class="faults small">
              <li v-for="(w, i) in job.warnings" :key="i" class="warn">{{ say(w) }}</li>
            </ul>
            <div class="stack" style="gap: .35rem">
              <label class="field">Compare with<select v-model="other">
                  <option value="">nothing</option>
                  <option v-if="job.truth" value="truth">the truth (simulated)</option>
                  <option v-for="r in others" :key="r.id" :value="r.id">{{ same(r) ? headName(r)
                    : say('perhaps another person: {head}', { head: headName(r) }) }}</option>
                </select>
              </label>
              <label v-if="other && other !== 'truth'" class="check small">
                <input type="checkbox" v-model="beside" id="beside">side by side, turned together</label>
              <label v-if="elsewhere" class="check small">
                <input type="checkbox" v-model="strangers"
                  id="strangers">{{ say('offer {count} head of other subjects, too | offer {count} heads of other subjects, too',
                    { count: elsewhere }) }}</label>
              <label v-if="cameras.length || !camerasKnown" class="field">Look through<select v-model="through"
                id="through" :disabled="!cameras.length">
                  <option value="">no camera</option>
                  <option v-for="c in cameras" :key="c.name">{{ c.name }}</option>
                </select>
              </label>
              <label v-if="through" class="field">Photograph<input type="range" min="0" max="1" step="0.05"
                v-model.number="fade" aria-label="How much of the photograph shines through the head">
              </label>
              <label v-if="through" class="check small">
                <input type="checkbox" v-model="withFaces"
                  id="faces">{{ say(finding ? 'Looking for faces ...' : 'the face that was found in it') }}</label>
              <label class="field">Light<select v-model="lights">
                  <option value="studio">studio</option>
                  <option value="side">from the side (shows shape)</option>
                  <option value="flat">flat</option>
                </select>
              </label>
            </div>
            <div class="line">
              <h2 class="third grow">Downloads</h2>
              <a class="b" id="all" :href="'/console/jobs/' + job.id + '/all.zip'"
                :download="fileName + '.zip'">All files (.zip)</a>
            </div>
            <div class="line wrap">
              <button class="b" id="picture" title="What the view shows, on nothing, with the legend of its colours"
                @click="savePicture">Picture (PNG)</button>
              <template v-if="video">
                <button class="b" id="turntable" :disabled="!!through || loading"
                  :title="say(through ? 'Not through a camera' : 'One turn, as the view shows the head')"
                  @click="turning === null ? turntable() : stopTurning()">{{ turning === null ? say('Turntable (video)')
                    : say('Stop, {share} %', { share: Math.round(100 * turning) }) }}</button>
                <select v-model.number="turnS" aria-label="Seconds of the turn">
                  <option v-for="s in [4, 8, 16]" :key="s" :value="s">{{ s }} s</option>
                </select>
              </template>
            </div>
            <div class="line wrap">
              <label class="field">Another format<select v-model="form" id="form">
                  <option v-for="f in ['glb', 'ply', 'obj', 'usdz', 'stl', '3mf']" :key="f" :value="f">{{ f }}</option>
                </select>
              </label>
              <a class="b" id="export" :href="'/console/jobs/' + job.id + '/exports/' + form + '.zip'"
                :download="fileName + '-' + form + '.zip'">Export (.zip)</a>
            </div>
            <table class="small">
              <tbody>
                <tr v-for="(bytes, name) in job.files" :key="name">
                  <td><a :href="'/console/jobs/' + job.id + '/' + name" :download="name">{{ name }}</a></td>
                  <td class="num muted">{{ size(bytes) }}</td>
                </tr>
              </tbody>
            </table>
            <h2 class="third">Measurements, mm</h2>
            <table class="small" id="measurements">
              <thead v-if="theirs">
                <tr>
                  <th>of</th>
                  <th class="num">this</th>
                  <th class="num">other</th>
                  <th class="num" title="this less other">&Delta;</th>
                </tr>
              </thead>
              <tbody>
                <tr v-for="m in compared" :key="m.name">
                  <td>{{ say(m.name.replaceAll('_', ' ')) }}</td>
                  <td class="num">{{ fixed(m.value, 1) }}</td>
                  <td v-if="!theirs" class="num muted">&plusmn; {{ fixed(m.std, 1) }}</td>
                  <template v-if="theirs">
                    <td class="num">{{ fixed(m.theirs?.value, 1) }}</td>
                    <td class="num">{{ m.theirs ? fixed(m.value - m.theirs.value, 1) : '-' }}</td>
                  </template>
                </tr>
              </tbody>
            </table>
            <h2 class="third">Fit</h2>
            <table class="small">
              <tbody>
                <tr>
                  <td
                    title="Of cameras in which hair and clothes hide less than a quarter of the head's rim">{{ say('outline residual, {count} clear view | outline residual, {count} clear views',
                      { count: job.clear_views }) }}</td>
                  <td class="num">{{ fixed(job.contour_px, 2) }} px</td>
                </tr>
                <tr><td>standard deviation, median</td><td class="num">{{ fixed(job.quality.median, 2) }} mm</td></tr>
                <tr><td>model</td><td class="num">{{ job.model_name }}</td></tr>
                <tr><td>solver</td><td class="num">{{ methodWords(job.method) }}</td></tr>
                <tr><td>level of detail</td><td class="num">{{ levelWords(job.level) }}</td></tr>
                <tr><td>time</td><td class="num">{{ span(job.seconds) }}</td></tr>
              </tbody>
            </table>
            <a class="small" href="/jobs">Residuals and overlays are with the job</a>
          </template>
        </div>
      </div>
    </section>`,
  created() {
    Object.assign(this, {
      resumed: new URLSearchParams(location.search).get("other") || "",
      three: { THREE, GLTFLoader },
      clock,
      fixed,
      levelWords,
      methodWords,
      size,
      span,
      parts: PARTS,
      gradient: `linear-gradient(to top, ${this.gradientStops().join(", ")})`,
    });
  },
  mounted() {
    this.build();
    window.addEventListener("keydown", this.key);
    if (this.job) {
      this.keepPlace();
      this.load(this.job.id);
      this.readCameras(this.job.id);
    }
  },
  unmounted() {
    window.removeEventListener("keydown", this.key);
    this.observer?.disconnect();
    this.renderer?.dispose();
  },
  methods: {
    acted() {},
    keepPlace() {
      // which head, and with which it is compared, outlive a reload
      history.replaceState(history.state, "", `/result/${this.job.id}`);
      keepAddress({ find: this.sought, other: this.other || this.resumed });
    },
    goOnComparing() {
      const other = this.resumed,
        known = (this.state.results || []).find((r) => r.id === other);
      this.resumed = "";
      if (known || (other === "truth" && this.job.truth)) {
        this.strangers ||= !!known && !this.same(known);
        this.other = other;
      }
    },
    build() {
      try {
        this.renderer = new THREE.WebGLRenderer({ canvas: this.$refs.canvas, antialias: true, alpha: true });
      } catch {
        this.fault = "This browser shows no 3D (WebGL is off). The downloads work.";
        return;
      }
      this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
      this.scene = new THREE.Scene();
      this.camera = new THREE.PerspectiveCamera(FOV_DEG, 1, 0.01, 10);
      this.controls = new OrbitControls(this.camera, this.$refs.canvas);
      this.controls.addEventListener("change", this.draw);
      this.controls.addEventListener("end", this.turned);
      this.material = new THREE.MeshStandardMaterial({
        vertexColors: true,
        roughness: 0.85,
        metalness: 0,
        side: THREE.DoubleSide,
      });
      this.flat = new THREE.MeshBasicMaterial({ vertexColors: true, side: THREE.DoubleSide }); // data are not lit: shading would shift them off the legend
      this.rig3d = new THREE.Group();
      this.scene.add(this.rig3d);
      this.marks = new THREE.Group();
      this.scene.add(this.marks);
      this.shine();
      this.observer = new ResizeObserver(this.fit);
      this.observer.observe(this.$refs.view);
      this.fit();
    },
    shine() {
      if (!this.rig3d) return;
      this.rig3d.clear();
      this.rig3d.add(
        new THREE.AmbientLight(
          "#ffffff",
          this.lights === "side" ? 0.25 : this.lights === "flat" ? 2.2 : this.colouring === "texture" ? 1.6 : 0.9,
        ),
      );
      for (const [x, y, z, power] of LIGHTS[this.lights]) {
        const light = new THREE.DirectionalLight("#ffffff", power);
        light.position.set(x, y, z);
        this.rig3d.add(light);
      }
      this.draw();
    },
    fit() {
      const { clientWidth: w, clientHeight: h } = this.$refs.view;
      if (!w || !h || !this.renderer) return;
      this.renderer.setSize(w, h, false);
      this.camera.aspect = w / (this.split ? 2 : 1) / h;
      this.camera.fov = Math.min(FOV_DEG / Math.min(1, this.camera.aspect), 3 * FOV_DEG);
      this.camera.updateProjectionMatrix();
      const view = this.cameras.find((c) => c.name === this.through);
      this.seen = view ? lookThrough(THREE, view, w, h) : this.camera;
      const place = view && fitted(view, w, h);
      this.picture = view
        ? {
            address: `/console/jobs/${this.job.id}/photographs/${encodeURIComponent(view.name)}.jpg`,
            size: [view.width, view.height],
            style: `position: absolute; left: ${place.left}px; top: ${place.top}px; width: ${place.width}px; height: ${place.height}px`,
          }
        : null;
      this.controls.enabled = !view;
      this.draw();
    },
    async readCameras(id) {
      this.cameras = [];
      this.camerasKnown = false;
      this.through = "";
      const answer = await fetch(`/console/jobs/${id}/cameras`);
      if (answer.ok && id === this.job?.id) this.cameras = await answer.json();
      this.camerasKnown = true;
    },
    same(r) {
      return (
        r.capture_id === this.job?.capture_id ||
        (!!r.session && r.session === this.job?.session) ||
        (!!r.subject && r.subject === this.job?.subject)
      );
    },
    headName(r) {
      const how = [
        methodWords(r.settings.method),
        levelWords(r.settings.detail),
        r.model && r.model !== "default" && r.model,
      ]
        .filter(Boolean)
        .join(", ");
      return [
        r.subject,
        r.captured ? r.capture || say("capture {time}", { time: clock(r.captured) }) : say("removed capture"),
        how,
        say("made {time}", { time: clock(r.finished) }),
      ]
        .filter(Boolean)
        .join(" · ");
    },
    draw() {
      if (!this.renderer || this.waiting) return;
      this.waiting = requestAnimationFrame(() => {
        this.waiting = 0;
        this.renderOnce();
        this.place();
      });
    },
    renderOnce() {
      if (this.split && this.mate) {
        const { clientWidth: w, clientHeight: h } = this.$refs.view;
        this.renderPair(w, h);
      } else this.renderer.render(this.scene, this.seen || this.camera);
    },
    gradientStops() {
      return RAMP.map((c) => `rgb(${c.map((v) => Math.round(255 * v))})`);
    },
    place() {
      const { clientWidth: w, clientHeight: h } = this.$refs.view || {};
      this.pins = this.points.map((p) => {
        const q = p.clone().project(this.seen || this.camera);
        return {
          x: this.split ? ((q.x + 1) / 4) * w + (this.right ? w / 2 : 0) : ((q.x + 1) / 2) * w,
          y: ((1 - q.y) / 2) * h,
          shown: q.z < 1,
        };
      });
    },
    async numbers(name, id = this.job.id) {
      const answer = await fetch(`/console/jobs/${id}/${name}`);
      if (!answer.ok) throw new Error(say(told(await answer.json())));
      return new Float32Array(await answer.arrayBuffer());
    },
    async load(id) {
      if (!this.renderer) return;
      if (!this.surfaces.some(([name]) => name === this.surface)) this.surface = this.surfaces[0]?.[0] || "head";
      const surface = this.surface,
        first = this.shown !== id;
      this.loading = true;
      this.fault = "";
      this.loaded = "";
      this.clearPoints();
      try {
        const head = await new GLTFLoader().loadAsync(`/console/jobs/${id}/${surface}.glb`);
        if (!this.drawn) await this.pictureShown();
        if (id !== this.job?.id || surface !== this.surface) return;
        if (this.mesh) {
          this.scene.remove(this.mesh);
          this.mesh.geometry.dispose();
        }
        let found = null;
        head.scene.traverse((o) => {
          if (o.isMesh) found = o;
        });
        this.mesh = new THREE.Mesh(found.geometry, this.material);
        this.skin?.map.dispose();
        this.skin?.dispose();
        this.skin = found.material.map
          ? new THREE.MeshStandardMaterial({
              map: found.material.map,
              roughness: 0.85,
              metalness: 0,
              side: THREE.DoubleSide,
            })
          : null;
        this.showWire();
        this.texture = found.geometry.attributes.color?.clone();
        this.repeated = head.asset.extras?.repeated_vertices || []; // at the texture's seam, after those of the .ply
        this.scene.add(this.mesh);
        this.mesh.geometry.computeBoundingSphere();
        const { radius } = this.mesh.geometry.boundingSphere;
        this.controls.minDistance = radius * 0.4;
        this.controls.maxDistance = radius * 12;
        if (first || this.side) this.lookFrom(this.side || "threequarter"); // where somebody turned it to, another surface of the head stays
        this.shown = id;
        this.other = "";
        this.kept = {};
        await this.paint();
        if (first) this.goOnComparing();
        this.loaded = `${id} ${surface}`;
        requestAnimationFrame(() =>
          requestAnimationFrame(() => {
            this.drawn = true;
          }),
        ); // the service's picture goes when ours is there
      } catch (error) {
        this.fault = say("The head cannot be shown: {reason}", { reason: say(error.message) });
      }
      this.loading = false;
    },
    async pictureShown() {
      // a machine without graphics shows nothing while it draws the head: the picture goes first
      if (this.$refs.first?.complete)
        await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
    },
    paintAs(name) {
      if (!this.mateId) this.other = "";
      this.colouring = name;
      this.paint();
    },
    async paint() {
      if (!this.mesh || (this.other && !this.mateId)) return;
      const geometry = this.mesh.geometry;
      this.scale = null;
      if (this.colouring === "uncertainty" || this.colouring === "parts") {
        const name = this.colouring === "parts" ? "part" : "quality",
          surface = this.surface;
        try {
          this.kept[name] = this.kept[name] || (await this.numbers(`${surface}.${name}.f32`));
          if (surface !== this.surface) return;
          if (name === "quality") this.spread(this.kept.quality, say("Standard deviation"));
          else this.paintParts(this.kept.part);
        } catch (error) {
          this.fault = error.message;
        }
      } else if (this.colouring === "clay") {
        this.mesh.material = this.material;
        geometry.setAttribute(
          "color",
          new THREE.BufferAttribute(new Float32Array(3 * geometry.attributes.position.count).fill(0.55), 3),
        );
      } else if (this.skin) this.mesh.material = this.skin;
      else {
        this.mesh.material = this.material;
        geometry.setAttribute("color", this.texture);
      }
      this.draw();
    },
    showWire() {
      for (const material of [this.material, this.flat, this.skin]) if (material) material.wireframe = this.wire;
    },
    withRepeated(values, repeated = this.repeated) {
      const all = new Float32Array(values.length + repeated.length);
      all.set(values);
      repeated.forEach((from, i) => {
        all[values.length + i] = values[from];
      });
      return all;
    },
    paintParts(values) {
      const all = this.withRepeated(values),
        colours = new Float32Array(3 * all.length),
        colour = new THREE.Color();
      all.forEach((value, i) => {
        colour.setRGB(...PARTS[value][1], THREE.SRGBColorSpace).toArray(colours, 3 * i);
      });
      this.mesh.material = this.flat;
      this.mesh.geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
    },
    async compare() {
      if (!this.mesh) return;
      if (this.other && this.surface !== "head") {
        const wanted = this.other;
        this.surface = "head";
        await this.$nextTick();
        while (this.loading) await new Promise((done) => setTimeout(done, 50));
        this.other = wanted;
        return;
      }
      if (!this.other || this.mateId) {
        await this.paint();
        return this.paintMate();
      }
      this.loading = true;
      this.fault = "";
      const wanted = this.other;
      try {
        const values = await this.numbers(`distance.f32?other=${wanted}`);
        if (wanted === this.other && !this.mateId)
          this.spread(
            values,
            say(
              wanted === "truth"
                ? "Distance to the truth"
                : this.same((this.state.results || []).find((r) => r.id === wanted) || {})
                  ? "Distance to the other head"
                  : "Distance to a head of another subject",
            ),
          );
      } catch (error) {
        this.fault = error.message;
      }
      this.loading = false;
      this.draw();
    },
    heat(values, repeated, most) {
      const all = this.withRepeated(values, repeated),
        colours = new Float32Array(3 * all.length),
        colour = new THREE.Color();
      all.forEach((value, i) => {
        colour.setRGB(...ramp(value / most), THREE.SRGBColorSpace).toArray(colours, 3 * i);
      });
      return new THREE.BufferAttribute(colours, 3);
    },
    spread(values, title) {
      const p95 = stop(values, 0.95),
        most = nice(Math.min(p95, FAR * stop(values, 0.5)) || p95);
      this.mesh.material = this.flat;
      this.mesh.geometry.setAttribute("color", this.heat(values, this.repeated, most));
      this.digits = most < 1 ? 2 : 1;
      this.scale = { title, most, p95, beyond: stop(values, 1) > most, median: stop(values, 0.5) };
    },
    press(event) {
      this.pressed = [event.clientX, event.clientY];
    },
    pick(event) {
      if (
        !this.measuring ||
        !this.mesh ||
        Math.hypot(event.clientX - this.pressed[0], event.clientY - this.pressed[1]) > 4
      )
        return; // that was a turn
      const box = this.$refs.canvas.getBoundingClientRect();
      const across = (event.clientX - box.left) / box.width,
        right = this.split && across > 0.5;
      const at = new THREE.Vector2(
        (this.split ? 2 * across - (right ? 1 : 0) : across) * 2 - 1,
        1 - ((event.clientY - box.top) / box.height) * 2,
      );
      const ray = new THREE.Raycaster();
      if (this.through) {
        ray.ray.origin.setFromMatrixPosition(this.seen.matrixWorld);
        ray.ray.direction.set(at.x, at.y, 0.5).unproject(this.seen).sub(ray.ray.origin).normalize();
      } else ray.setFromCamera(at, this.camera);
      const hit = ray.intersectObject(right ? this.mate : this.mesh)[0];
      if (!hit) return;
      if (this.points.length === 2 || right !== this.right) this.clearPoints(); // a distance is on one head
      this.right = right;
      this.points = [...this.points, hit.point.clone()];
      const dot = new THREE.Mesh(
        new THREE.SphereGeometry(0.0015, 16, 12),
        new THREE.MeshBasicMaterial({ color: "#6cb2ff", depthTest: false }),
      );
      dot.position.copy(hit.point);
      dot.renderOrder = 2;
      this.marks.add(dot);
      if (this.points.length === 2) {
        const line = new THREE.Line(
          new THREE.BufferGeometry().setFromPoints([...this.points]),
          new THREE.LineBasicMaterial({ color: "#6cb2ff", depthTest: false }),
        );
        line.renderOrder = 2;
        this.marks.add(line);
      }
      this.draw();
    },
    clearPoints() {
      this.points = [];
      this.pins = [];
      this.marks?.clear();
      this.draw();
    },
    turn(event) {
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!by) return;
      event.preventDefault();
      const s = new THREE.Spherical().setFromVector3(this.camera.position.clone().sub(this.controls.target));
      s.theta += by[0] * 0.08;
      s.phi = Math.min(3.0, Math.max(0.14, s.phi + by[1] * 0.08));
      this.camera.position.setFromSpherical(s).add(this.controls.target);
      this.controls.update();
      this.turned();
      this.draw();
    },
    key(event) {
      if (typing(event) || !this.job) return;
      const key = event.key.toLowerCase(),
        has = ([, , k]) => k.toLowerCase() === key,
        named = this.colourings.find(has),
        solid = this.surfaces.find(has);
      if (named) this.paintAs(named[0]);
      else if (solid && this.surfaces.length > 1) this.surface = solid[0];
      else if (key === "w") this.wire = !this.wire;
      else if (key === "f" && this.canFill) this.fill();
      else if (key === "v" && !this.through) this.nextSide();
      else if (key === "m") this.measuring = !this.measuring;
      else if (event.key === "Escape") this.measuring = false;
    },
  },
});
