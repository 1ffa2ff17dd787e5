// Up to four views side by side; what is drawn over them is in pixels of the image, pixel (0, 0) being a centre.
import { say, spoken } from "/console/static/language.js";
import { clock, fixed, keepAddress, typing } from "/console/static/words.js";

const TITLES = {
  exocanthion_right: "Right eye, outer corner",
  exocanthion_left: "Left eye, outer corner",
  pronasale: "Tip of the nose",
  subnasale: "Below the nose",
  cheilion_right: "Right corner of the mouth",
  cheilion_left: "Left corner of the mouth",
  gnathion: "Underside of the chin",
};
const ZOOM = 5,
  LENS_REM = 11;
const GRAB_SHARE = 0.012; // of the image's width: who drags from so near carries the point, or the model's landmark
const DRAG_PX = 3; // of the screen, which the pointer moves before a click is a drag
const SEVEN = 7;
const VIEWS_LEAST = 2,
  POINTS_LEAST = 3;

export default spoken({
  props: { state: Object },
  emits: ["act", "choose"],
  watch: {
    views(names, before) {
      if (names.join() !== before.join()) this.$emit("choose", { views: names.join("\n") });
    },
    point: {
      handler(name) {
        if (name) {
          this.$emit("choose", { point: name });
          keepAddress({ point: this.at });
        }
      },
      immediate: true,
    },
  },
  data: () => ({
    at: Number(new URLSearchParams(location.search).get("point")) || 0,
    all: false,
    chosen: {},
    lens: null,
    drag: null,
    count: 4,
    busy: "",
    pending: {},
    sent: 0,
  }),
  computed: {
    capture() {
      return this.state.capture;
    },
    names() {
      return this.capture?.names || [];
    },
    point() {
      return this.names[this.at];
    },
    offered() {
      return this.names
        .map((name, i) => ({ name, i }))
        .filter(
          ({ name, i }) =>
            i < SEVEN || this.all || i === this.at || Object.keys(this.capture.points[name] || {}).length,
        );
    },
    wrong() {
      return Object.entries(this.capture?.contradictions || {});
    },
    sizes() {
      return Object.fromEntries((this.capture?.cameras || []).map((c) => [c.name, c]));
    },
    views() {
      return (this.capture?.views || []).slice(0, this.count).map((name, i) => this.chosen[i] || name);
    },
    suggestions() {
      return Object.values(this.capture?.suggested || {}).reduce((sum, views) => sum + Object.keys(views).length, 0);
    },
    ready() {
      return this.names.filter((n) => Object.keys(this.capture.points[n] || {}).length >= VIEWS_LEAST).length;
    },
    lead() {
      if (!this.capture) return this.state.loading ? say("Reading") : "";
      if (!Object.keys(this.capture.points).length) return say("Optional. Without points the head is found by itself.");
      return this.ready < POINTS_LEAST
        ? say("{ready} of at least {least} points are in two views", { ready: this.ready, least: POINTS_LEAST })
        : say(
            this.capture.dirty
              ? "{ready} points in two views or more, not saved"
              : "{ready} points in two views or more, saved",
            { ready: this.ready },
          );
    },
  },
  template: `
    <section class="page" aria-label="Features" :data-digits="capture ? '1 2 3 4 5 6 7' : null">
      <header><h1>Features</h1>
        <select v-if="capture" :value="capture.id" aria-label="Capture"
          @change="$emit('choose', { capture: $event.target.value })">
          <option v-for="c in state.captures" :key="c.id"
            :value="c.id">{{ c.label || clock(c.created) }} &middot; {{ c.id.slice(-6) }}</option>
        </select>
        <span class="lead" role="status">{{ lead }}</span>
        <template v-if="capture">
          <span class="group" role="group" aria-label="Number of views">
            <button v-for="n in [3, 4]" :key="n" class="b" :aria-pressed="count === n"
              @click="count = n">{{ say('{count} view | {count} views', { count: n }) }}</button>
          </span>
        <button class="b" id="suggest" :disabled="!!busy" :aria-busy="busy === 'suggest'"
          @click="act('suggest')">{{ say(busy === 'suggest' ? 'Looking for the face ...'
            : 'Suggest all points') }}</button>
        <button class="b" id="save" :disabled="!capture.dirty || !!busy" @click="act('save')">Save <kbd>S</kbd></button>
        <button class="b main-action" id="reconstruct" :disabled="!!busy"
          @click="act('reconstruct')">{{ say(ready ? 'Reconstruct' : 'Skip and reconstruct') }}</button>
      </template>
    </header>
      <div v-if="capture && capture.is_contradictory && wrong.length" class="panel pad stack small" role="alertdialog"
        aria-label="Points contradict each other" id="contradictions" style="border-color: var(--warn)">
        <p>
          <strong
            class="warn">Not saved yet: views contradict each other.</strong> A job would leave these out. Right and
              left confused, or another point clicked?</p>
        <ul class="faults">
          <li v-for="[name, text] in wrong" :key="name">
            <button class="b quiet" @click="at = names.indexOf(name)">{{ title(name) }}</button> {{ say(text) }}</li>
        </ul>
        <div class="line wrap">
          <button class="b main-action" @click="at = names.indexOf(wrong[0][0])">Look at them</button>
          <button class="b" id="save-anyway" :disabled="!!busy"
            @click="act('save', { sure: true })">Save all the same</button>
        </div>
      </div>
      <div v-if="suggestions" class="panel pad line wrap small" role="region" aria-label="Suggested places"
        id="suggestions" style="border-color: #ff9de0">
        <span class="grow">
          <strong>{{ say('{count} place is suggested, and not a point yet. | {count} places are suggested, and no points yet.',
            { count: suggestions }) }}</strong>
            Pink squares, by the face that was found: drag what is off, reject what is hidden, accept the rest.</span>
        <button class="b main-action" id="accept-all" :disabled="!!busy" @click="act('accept')">Accept all</button>
        <button class="b" id="reject-all" :disabled="!!busy" @click="act('reject')">Reject all</button>
      </div>
      <div v-if="!state.loading && !capture" class="panel grow" style="display: grid">
        <div class="empty">
          <h2>{{ say(state.requested ? 'This capture is not there' : 'No captures yet') }}</h2>
          <p>Points are picked in the pictures of a capture.</p>
          <a class="b main-action" :href="state.requested ? '/captures'
            : '/'">{{ say(state.requested ? 'Go to captures' : 'Go to the rig') }}</a>
        </div>
      </div>
      <div v-else-if="capture" class="columns" style="grid-template-columns: 15rem minmax(0, 1fr)">
        <div class="panel scroll" tabindex="0" role="region" aria-label="The points" data-scroll="points">
          <button v-for="{ name, i } in offered" :key="name" class="row-button" :data-point="name"
            :aria-current="i === at" @click="at = i">
            <span class="line"><kbd v-if="i < 7">{{ i + 1 }}</kbd><span class="grow">{{ title(name) }}</span></span>
            <span class="small muted line">
              <span class="grow">{{ placed(name) }}</span>
              <span v-if="capture.suggested[name]" class="tag suggested">{{ say('{count} suggested',
                { count: Object.keys(capture.suggested[name]).length }) }}</span>
              <span v-if="capture.contradictions[name]" class="tag fault"
                :title="say(capture.contradictions[name])">contradicts</span>
              <span v-if="worst(name) !== null" class="num"
                :class="{ warn: worst(name) > 3 }">{{ fixed(worst(name), 1) }} px</span>
            </span>
          </button>
          <button class="b quiet small" style="margin: .5rem .75rem 0" :aria-pressed="all"
            @click="all = !all">{{ say(all ? 'The seven points alone' : 'All 26 points') }}</button>
          <p class="small muted" style="padding: .7rem .75rem">Right and left are the subject's. Click the point in each
            view where you see it; lines show where the other views expect it, the ring where all of them do, the
            diamond where the model has it. <kbd>Enter</kbd> takes that place, arrows move it, <kbd>Del</kbd> takes it
            back.</p>
        </div>
        <div :style="{ display: 'grid', gap: '.6rem', minHeight: 0, gridTemplateColumns: 'repeat(2, minmax(0, 1fr))',
          gridTemplateRows: 'repeat(2, minmax(0, 1fr))' }">
          <div v-for="(camera, i) in views" :key="i" class="panel"
            style="display: flex; flex-direction: column; min-height: 0; overflow: hidden">
            <div class="line" style="padding: .25rem .5rem">
              <select :value="camera" :aria-label="say('Camera of view {number}', { number: i + 1 })"
                @change="chosen[i] = $event.target.value">
                <option v-for="c in capture.cameras" :key="c.name">{{ c.name }}</option>
              </select>
              <span class="small muted cut grow">{{ position(camera) }}</span>
              <template v-if="offer(camera)">
                <button class="b quiet small" data-accept :disabled="!!busy"
                  @click="act('accept', { point, camera })">Accept</button>
                <button class="b quiet small" data-reject :disabled="!!busy"
                  @click="act('reject', { point, camera })">Reject</button>
              </template>
            </div>
            <svg tabindex="0" role="application" :aria-label="say('{point} in {camera}, {place}', { point: title(point),
              camera, place: position(camera) || say('not set') })" :data-view="camera" :viewBox="'0 0 ' +
              sizes[camera].width + ' ' + sizes[camera].height" style="flex: 1; min-height: 0; width: 100%; cursor:
              crosshair; background: #08090b; touch-action: none"
              @pointerdown="press($event, camera)" @pointermove="move($event, camera)" @pointerup="release"
                @pointerleave="lens = null" @keydown="nudge($event, camera)">
              <image :href="address(camera)" :width="sizes[camera].width" :height="sizes[camera].height"></image>
              <g fill="none" :stroke-width="unit(camera)">
                <polyline v-for="(curve, k) in curves(camera)" :key="'g' + k" :points="line(curve)" stroke="#8cc4ff"
                  :stroke-width="1.7 * unit(camera)" :stroke-dasharray="7 * unit(camera)"></polyline>
                <path v-for="(d, name) in others(camera)" :key="name" :d="d" stroke="#ffffff" opacity=".55"></path>
                <path v-for="(d, name) in otherOffers(camera)" :key="'s' + name" :d="d" stroke="#ff9de0"
                  :stroke-width="1.4 * unit(camera)"></path>
                <g v-if="offer(camera)" data-offer>
                  <path :d="square(offer(camera), camera, 8)" stroke="#000000"
                    :stroke-width="3.5 * unit(camera)"></path>
                  <path :d="square(offer(camera), camera, 8)" stroke="#ff9de0"
                    :stroke-width="1.8 * unit(camera)"></path>
                  <circle :cx="offer(camera)[0] + .5" :cy="offer(camera)[1] + .5" :r="1.4 * unit(camera)" fill="#ff9de0"
                    stroke="none"></circle>
                </g>
                <path v-if="suggested('predicted', camera)" :d="diamond(suggested('predicted', camera), camera)"
                  stroke="#f0b95b" :stroke-width="1.6 * unit(camera)"></path>
                <circle v-if="suggested('reprojected', camera)" :cx="suggested('reprojected', camera)[0] + .5"
                  :cy="suggested('reprojected', camera)[1] + .5" :r="7 * unit(camera)" stroke="#6cb2ff"
                  :stroke-width="1.6 * unit(camera)"></circle>
                <path v-if="here(camera)" :d="cross(here(camera), camera, 9)" stroke="#000000"
                  :stroke-width="4 * unit(camera)"></path>
                <path v-if="here(camera)" :d="cross(here(camera), camera, 9)" stroke="#ffffff"
                  :stroke-width="1.6 * unit(camera)"></path>
              </g>
            </svg>
          </div>
        </div>
      </div>
      <svg v-if="lens" :style="lensStyle()" :viewBox="lensBox()" aria-hidden="true">
        <image :href="address(lens.camera)" :width="sizes[lens.camera].width" :height="sizes[lens.camera].height"
          style="image-rendering: pixelated"></image>
        <g fill="none" stroke="#6cb2ff">
          <polyline v-for="(curve, k) in curves(lens.camera)" :key="k" :points="line(curve)"
            :stroke-width="lens.step * 1.2" opacity=".8"></polyline>
        <path
          :d="'M' + (lens.x + .5) + ' ' + (lens.y - 999) + 'v1998M' + (lens.x - 999) + ' ' + (lens.y + .5) + 'h1998'"
          stroke="#ffffff" :stroke-width="lens.step" opacity=".8"></path>
      </g>
    </svg>
    </section>`,
  created() {
    Object.assign(this, { clock, fixed });
  },
  mounted() {
    window.addEventListener("keydown", this.key);
  },
  unmounted() {
    window.removeEventListener("keydown", this.key);
  },
  methods: {
    title(name) {
      return say(TITLES[name] || name.replaceAll("_", " "));
    },
    address(camera) {
      return `/console/captures/${this.capture.id}/${encodeURIComponent(camera)}.image`;
    },
    act(name, more) {
      this.busy = name;
      this.$emit("act", { name, ...more });
    },
    acted(name) {
      this.busy = "";
      if (name === "place" && --this.sent === 0) this.pending = {};
    },
    placed(name) {
      const n = Object.keys(this.capture.points[name] || {}).length;
      return n ? say("{count} view | {count} views", { count: n }) : say("not set");
    },
    worst(name) {
      const off = Object.values(this.capture.off_px[name] || {});
      return off.length ? Math.max(...off) : null;
    },
    here(camera) {
      if (this.drag?.camera === camera) return this.drag.at;
      const sent = this.pending[`${this.point} ${camera}`]; // not yet answered by the service
      return sent === undefined ? this.capture.points[this.point]?.[camera] : sent;
    },
    position(camera) {
      const p = this.here(camera);
      return p ? `${p[0].toFixed(1)}, ${p[1].toFixed(1)}` : "";
    },
    suggested(kind, camera) {
      return this.capture[kind][this.point]?.[camera];
    },
    // What the found face suggests for the chosen point, as long as it is not set in that view.
    offer(camera) {
      return this.here(camera) ? null : this.suggested("suggested", camera);
    },
    otherOffers(camera) {
      const found = {};
      for (const [name, views] of Object.entries(this.capture.suggested))
        if (name !== this.point && views[camera]) found[name] = this.square(views[camera], camera, 4);
      return found;
    },
    square([x, y], camera, arm) {
      const a = arm * this.unit(camera);
      return `M${x + 0.5 - a} ${y + 0.5 - a}h${2 * a}v${2 * a}h${-2 * a}z`;
    },
    curves(camera) {
      return this.capture.guides[this.point]?.[camera] || [];
    },
    line(curve) {
      return curve.map(([x, y]) => `${x + 0.5},${y + 0.5}`).join(" ");
    },
    unit(camera) {
      return this.sizes[camera].width / 520;
    },
    cross([x, y], camera, arm) {
      const a = arm * this.unit(camera),
        g = a * 0.3;
      return `M${x + 0.5 - a} ${y + 0.5}h${a - g}m${2 * g} 0h${a - g}M${x + 0.5} ${y + 0.5 - a}v${a - g}m0 ${2 * g}v${a - g}`;
    },
    diamond([x, y], camera) {
      const a = 8 * this.unit(camera);
      return `M${x + 0.5} ${y + 0.5 - a}l${a} ${a}l${-a} ${a}l${-a} ${-a}z`;
    },
    others(camera) {
      const found = {};
      for (const name of this.names)
        if (name !== this.point && this.capture.points[name]?.[camera])
          found[name] = this.cross(this.capture.points[name][camera], camera, 5);
      return found;
    },
    pixel(event, svg) {
      const p = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
      return [p.x - 0.5, p.y - 0.5];
    },
    inside([x, y], camera) {
      return x >= -0.5 && y >= -0.5 && x <= this.sizes[camera].width - 0.5 && y <= this.sizes[camera].height - 0.5;
    },
    press(event, camera) {
      const at = this.pixel(event, event.currentTarget);
      if (event.button || !this.inside(at, camera)) return;
      event.currentTarget.focus();
      event.currentTarget.setPointerCapture(event.pointerId);
      const reach = GRAB_SHARE * this.sizes[camera].width,
        held =
          this.here(camera) ||
          this.offer(camera) ||
          this.suggested("reprojected", camera) ||
          this.suggested("predicted", camera);
      const off = held ? [held[0] - at[0], held[1] - at[1]] : [0, 0];
      this.drag = { camera, at, from: [event.clientX, event.clientY], off: Math.hypot(...off) < reach ? off : [0, 0] };
    },
    move(event, camera) {
      const at = this.pixel(event, event.currentTarget);
      this.lens = this.inside(at, camera)
        ? {
            camera,
            x: at[0],
            y: at[1],
            clientX: event.clientX,
            clientY: event.clientY,
            step: 1 / ZOOM / event.currentTarget.getScreenCTM().a,
          }
        : null;
      if (this.drag?.camera !== camera) return;
      const { from, off } = this.drag;
      this.drag.moved ||= Math.hypot(event.clientX - from[0], event.clientY - from[1]) > DRAG_PX;
      if (this.drag.moved) this.drag.at = [at[0] + off[0], at[1] + off[1]];
    },
    release() {
      if (!this.drag) return;
      const { camera, at } = this.drag;
      this.set(camera, at);
      this.drag = null;
    },
    set(camera, at) {
      const clamped = at && [
        Math.min(this.sizes[camera].width - 0.5, Math.max(-0.5, at[0])),
        Math.min(this.sizes[camera].height - 0.5, Math.max(-0.5, at[1])),
      ];
      this.pending[`${this.point} ${camera}`] = clamped;
      this.sent += 1;
      this.$emit("act", { name: "place", point: this.point, camera, at: clamped });
    },
    nudge(event, camera) {
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key],
        p = this.here(camera) || this.offer(camera);
      if (by && p) {
        event.preventDefault();
        const step = event.shiftKey ? 2 : 0.25;
        this.set(camera, [p[0] + by[0] * step, p[1] + by[1] * step]);
      } else if (event.key === "Enter") {
        const to = this.offer(camera) ||
          this.suggested("reprojected", camera) ||
          this.suggested("predicted", camera) || [this.sizes[camera].width / 2, this.sizes[camera].height / 2];
        if (!this.here(camera)) this.set(camera, to);
      } else if (event.key === "Delete" || event.key === "Backspace") {
        if (this.here(camera)) this.set(camera, null);
        else if (p) this.act("reject", { point: this.point, camera });
      }
    },
    lensStyle() {
      const side = LENS_REM * parseFloat(getComputedStyle(document.documentElement).fontSize),
        gap = 24;
      const left =
        this.lens.clientX + gap + side > window.innerWidth ? this.lens.clientX - gap - side : this.lens.clientX + gap;
      const top = Math.max(4, Math.min(window.innerHeight - side - 4, this.lens.clientY - side / 2));
      return {
        position: "fixed",
        left: `${left}px`,
        top: `${top}px`,
        width: `${side}px`,
        height: `${side}px`,
        borderRadius: "50%",
        border: "2px solid var(--accent)",
        background: "#000",
        pointerEvents: "none",
        zIndex: 30,
      };
    },
    lensBox() {
      const side = this.lens.step * LENS_REM * parseFloat(getComputedStyle(document.documentElement).fontSize);
      return `${this.lens.x + 0.5 - side / 2} ${this.lens.y + 0.5 - side / 2} ${side} ${side}`;
    },
    key(event) {
      if (typing(event) || !this.capture) return;
      if (/^[1-7]$/.test(event.key)) this.at = Number(event.key) - 1;
      else if (event.key.toLowerCase() === "s" && this.capture.dirty && !this.busy) this.act("save");
    },
  },
});
