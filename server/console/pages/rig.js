// Eleven tiles. Pictures and their exposure and sharpness come by one stream; the rest is the page's state.
import { liveView } from "/console/static/live.js";
import { liveHead } from "/console/static/live_head.js";
import { say, spoken } from "/console/static/language.js";
import { begunHere, leaveBegun } from "/console/static/started.js";
import { Outline, Verdict, checksOf, faultsOf } from "/console/static/verdict.js";
import {
  clock,
  fixed,
  keepAddress,
  keepDraft,
  keepSession,
  kept,
  openSession,
  sessionName,
  span,
  stageWords,
  typing,
} from "/console/static/words.js";

const COUNT_S = 3;
const STALE_MS = 2500;
const EXPOSURE = { dark: 50, bright: 205, clipped: 0.02 }; // mean grey level of 255; share of pixels at 255 in all channels
const SOFT_PX = 2.0; // spread of an edge from which a contour is measurably worse

export default spoken({
  mixins: [liveView, liveHead, checksOf],
  components: { Outline, Verdict },
  props: { state: Object },
  emits: ["act", "choose"],
  data: () => ({
    now: Date.now(),
    taken: 0,
    count: 0,
    busy: "",
    session: openSession(),
    label: kept("shot")?.label || "",
    expression: kept("shot")?.expression || "",
    asking: null,
    dismissed: sessionStorage.getItem("eigenhead-plates") || "",
  }),
  watch: {
    session(id) {
      keepSession(id);
    },
    label() {
      this.keepTyped();
    },
    expression() {
      this.keepTyped();
    },
    "state.job"(job, before) {
      if (job?.id !== before?.id || job?.state !== before?.state) this.keepPlace();
    },
    dismissed(id) {
      sessionStorage.setItem("eigenhead-plates", id);
    },
    "state.shot.id": {
      handler(id) {
        this.readChecks(id);
        if (!this.state.loading) this.keepPlace();
      },
      immediate: true,
    },
    "state.sessions": {
      handler(all) {
        if (all && this.session && !this.open) this.session = "";
      },
      immediate: true,
    },
  },
  computed: {
    open() {
      return (this.state.sessions || []).find((s) => s.id === this.session) || null;
    },
    cameras() {
      return this.state.cameras || [];
    },
    lead() {
      if (this.state.loading) return say("Reading the rig's state");
      const kind = say(
        this.state.kind === "simulated"
          ? "Simulated studio, {count} camera. | Simulated studio, {count} cameras."
          : "Rig, {count} camera. | Rig, {count} cameras.",
        { count: this.cameras.length },
      );
      if (this.state.last) return `${kind} ${say("Last capture {time}", { time: clock(this.state.last.created) })}`;
      const next = this.state.calibration
        ? "No capture yet: seat the subject and press the space bar"
        : "Calibrate it before the first capture";
      return `${kind} ${say(next)}`;
    },
    calibration() {
      if (this.state.in_use)
        return { text: say("calibrated {time}", { time: clock(this.state.in_use.created) }), kind: "good" };
      if (this.state.calibration)
        return { text: say(this.state.calibration === "studio" ? "studio's own layout" : "calibrated"), kind: "good" };
      return { text: say("not calibrated"), kind: "fault" };
    },
    advice() {
      const todo = (this.state.faults || []).map((text) => ({ text: say(text), kind: "fault" }));
      const where = (test) =>
        this.cameras
          .map((c) => c.name)
          .filter((name) => this.live[name] && test(this.live[name]))
          .join(", ");
      const add = (names, text, kind = "warn") => names && todo.push({ text: `${names}: ${say(text)}`, kind });
      add(
        where((l) => l.fault),
        "no picture. Check cable and power.",
        "fault",
      );
      add(
        where((l) => l.clipped > EXPOSURE.clipped || l.mean > EXPOSURE.bright),
        "too bright, skin burns out. Close the aperture or dim the lamps.",
      );
      add(
        where((l) => l.mean < EXPOSURE.dark),
        "too dark. Open the aperture or raise the lamps.",
      );
      add(
        where((l) => l.blur_px > SOFT_PX),
        "soft. Focus on the subject's near eye.",
      );
      add(
        this.cameras
          .filter((c) => c.moved)
          .map((c) => c.name)
          .join(", "),
        "has moved since the calibration. Calibrate again.",
      );
      add(
        this.cameras
          .filter((c) => this.sync(c).bad)
          .map((c) => c.name)
          .join(", "),
        "not in sync in the last shot. Check the trigger cable, shoot again.",
      );
      return todo;
    },
    looked() {
      return this.cameras.length > 0 && this.cameras.every((c) => this.live[c.name]?.bytes);
    },
    ready() {
      if (!this.looked) return say("Waiting for a picture of every camera.");
      const sharp = this.cameras.filter((c) => typeof this.live[c.name].blur_px === "number").length;
      const sharpness = sharp
        ? say("So is sharpness, in the {sharp} of {all} judged so far.", { sharp, all: this.cameras.length })
        : say("Sharpness is looked at next.");
      return [
        say("Exposure is in order."),
        sharpness,
        say(this.cameras.every((c) => c.sync) ? "The last shot was in sync." : "Sync shows after a shot."),
      ].join(" ");
    },
    taking() {
      const seconds = Math.max(0, Math.round((this.now - this.taken) / 1000));
      return this.state.kind === "simulated"
        ? say("The simulated studio seats another person and draws every picture: {seconds} s so far.", { seconds })
        : say("Every camera delivers, then the pictures are judged: {seconds} s so far.", { seconds });
    },
    shot() {
      return this.state.shot;
    },
    job() {
      return this.state.job;
    },
    refused() {
      const found = this.state.plates?.refused;
      return found && found.id !== this.dismissed ? found : null;
    },
    columns() {
      return Math.min(6, Math.ceil(Math.sqrt(Math.max(this.cameras.length + 1, 4))));
    },
  },
  template: `
    <section class="page" aria-label="Rig" :data-holds="busy || count ? '' : null">
      <header>
        <h1>Rig</h1><span class="lead">{{ lead }}</span>
        <button class="b" :disabled="!!busy"
          @click="plates">{{ say(busy === 'plates' ? 'Taking plates ...' : 'Clean plates') }} <kbd>B</kbd>
        </button>
        <button class="b main-action" id="capture" :disabled="!!busy"
          style="min-width: 10.5rem; justify-content: center" @click="start">{{ say(busy === 'capture' ? 'Capturing ...'
            : count ? 'Stop' : 'Capture') }}
            <kbd>{{ say(count ? 'Esc' : 'Space') }}</kbd>
        </button>
      </header>
      <div v-if="refused" class="panel pad stack small" role="alertdialog" aria-label="Clean plates refused"
        id="refused-plates" style="border-color: var(--warn)">
        <p>
          <strong class="warn">Somebody seems to be in the new clean plates.</strong>
            {{ say('The old ones of {time} stay in use. Send everybody out and press B again; where the studio itself has changed, use the new ones.',
              { time: clock(state.plates.taken) }) }}</p>
        <details>
          <summary>{{ say('{count} camera differs | {count} cameras differ',
            { count: refused.faults.length }) }}</summary>
          <ul class="faults"><li v-for="fault in refused.faults" :key="fault.message">{{ say(fault) }}</li></ul>
        </details>
        <div class="line wrap">
          <button class="b main-action" @click="dismissed = refused.id">Keep the old ones</button>
          <button class="b" id="use-refused" :disabled="!!busy"
            @click="usePlates(refused.id)">Use the new ones all the same</button>
        </div>
      </div>
      <div v-if="shot" class="panel pad scroll stack grow" tabindex="0" role="region" aria-label="The shot"
        :data-shot="shot.id">
        <div class="line wrap" style="align-items: start"><verdict :capture="shot" class="grow"></verdict>
          <span class="line wrap">
            <button class="b" :class="{ 'main-action': shot.verdict === 'usable' }" id="keep" :disabled="!!busy"
              @click="decide('keep')">Keep <kbd>K</kbd>
            </button>
          <button class="b" :class="{ 'main-action': shot.verdict === 'poor' }" id="retake" :disabled="!!busy"
            title="Removes this shot (it can be taken back) and counts down to the next"
            @click="decide('retake')">Retake <kbd>R</kbd>
          </button>
          <button class="b" :class="{ 'main-action': shot.verdict === 'good' }" id="reconstruct" :disabled="!!busy"
            @click="decide('reconstruct')">Reconstruct <kbd>Enter</kbd>
          </button>
        </span>
      </div>
        <div class="thumbs four shot">
          <div v-for="camera in shot.cameras" :key="shot.id + camera" class="thumb" :data-camera="camera"
            :style="{ aspectRatio: shot.sizes[camera][0] + ' / ' + shot.sizes[camera][1] }">
          <img :src="'/console/captures/' + shot.id + '/' + encodeURIComponent(camera) + '.jpg'"
            :alt="say('Picture of {name}', { name: camera })">
          <outline :view="view(shot.id, camera)" :size="shot.sizes[camera]"></outline>
          <span>{{ camera }}{{ camera === shot.front ? ' · ' + say('front') : '' }} <b
            v-if="faultsOf(shot, camera).length" class="warn">{{ faultsOf(shot, camera).join(', ') }}</b>
            <small v-else class="muted">{{ measures(shot.id, camera) }}</small>
          </span>
        </div>
      </div>
      </div>
      <div v-if="job" class="panel pad line wrap" id="job" role="status" :data-state="job.state"
        aria-label="The job that was started here">
        <template v-if="job.state === 'succeeded'">
          <i class="dot good"></i>
          <strong class="grow">The head is ready</strong>
          <a class="b main-action" id="open-head" :href="'/result/' + job.id">Open the head <kbd>H</kbd></a>
        </template>
        <template v-else-if="['queued', 'running'].includes(job.state)">
          <strong>{{ job.state === 'queued' ? say(job.detail || 'Waiting for the worker')
            : stageWords(job.stage) }}</strong>
          <span class="bar grow" role="progressbar" aria-label="Progress of the job"
            :aria-valuenow="Math.round(100 * job.progress)" aria-valuemin="0" aria-valuemax="100">
            <i :style="{ width: 100 * job.progress + '%' }"></i>
          </span>
          <span class="num">{{ Math.round(100 * job.progress) }} %<template
            v-if="job.eta_s !== null">, {{ say('about {time} left', { time: span(job.eta_s) }) }}</template>
          </span>
        </template>
        <template v-else>
          <i class="dot fault"></i>
          <span class="grow">
            <strong>{{ say(job.state === 'failed' ? 'The job failed.' : 'The job was cancelled.') }}</strong>
              {{ say(job.detail) }}</span>
          <a class="b" :href="'/jobs?job=' + job.id">See why</a>
        </template>
        <button class="b quiet" aria-label="Close" title="Hides this line; the job goes on"
          @click="leaveJob">&times;</button>
      </div>
      <div v-show="!shot" class="tiles" :style="{ gridTemplateColumns: 'repeat(' + columns + ', minmax(0, 1fr))',
        gridTemplateRows: 'repeat(' + Math.ceil((cameras.length + 1) / columns) + ', minmax(0, 1fr))' }">
        <article v-for="camera in cameras" :key="camera.name" class="panel tile" :data-camera="camera.name"
          :data-frames="live[camera.name]?.frames || 0" :aria-label="camera.name">
          <div class="picture">
            <canvas :ref="el => keep(camera.name, el)" width="320" height="240" role="img"
              :aria-label="say('Live picture of {name}', { name: camera.name })"></canvas>
            <p v-if="waiting(camera)">{{ waiting(camera) }}</p></div>
          <div class="facts">
            <strong>{{ camera.name }}</strong>
            <span class="cut muted" :class="{ warn: sync(camera).bad }">{{ sync(camera).text }}</span>
            <span class="line">
              <i :class="['dot', camera.moved ? 'warn' : calibration.kind]"></i>
              <span :class="{ warn: camera.moved, fault: calibration.kind === 'fault' }">{{ say(camera.moved ? 'moved'
                : calibration.kind === 'good' ? 'calibrated' : 'uncalibrated') }}</span>
            </span>
            <ul class="lamps" :aria-label="say('Lamps of {name}', { name: camera.name })">
              <li v-for="lamp in lamps(camera.name)" :key="lamp.lamp" :data-lamp="lamp.lamp" :class="lamp.kind">
                <i :class="['dot', lamp.kind]"></i>{{ lamp.text }}<span class="unseen">: {{ lamp.told }}</span>
              </li>
            </ul>
            <div class="gauge">
              <span title="Mean grey level, 0 to 255">exp <b
                :class="{ warn: light(camera.name).bad }">{{ light(camera.name).text }}</b>
              </span>
              <span title="Pixels at full white">clip <b :class="{ warn: (live[camera.name]?.clipped
                || 0) > limit.clipped }">{{ percent(live[camera.name]?.clipped) }}</b>
              </span>
              <span title="Spread of edges in pixels; smaller is sharper">blur <b
                :class="{ warn: live[camera.name]?.blur_px > soft }">{{ fixed(live[camera.name]?.blur_px, 1) }}</b>
              </span>
            </div>
          </div>
        </article>
        <aside class="panel pad stack scroll" aria-label="State of the rig">
          <div class="line" id="live-head" style="align-items: start">
            <canvas ref="head" width="112" height="112" role="img"
              aria-label="The head as the front camera sees it"></canvas>
            <div class="stack small grow" style="gap: .2rem" role="status"><strong>{{ state_of_head }}</strong>
              <ul v-if="words.length" class="faults">
                <li v-for="word in words" :key="word.code + word.camera" :data-code="word.code"
                  :class="word.camera ? 'warn' : 'accent'">{{ say(word) }}</li>
              </ul>
            </div>
          </div>
          <h2>{{ say(busy === 'capture' ? 'Taking the pictures' : advice.length || words.length ? 'To do' : looked
            ? 'Ready to capture' : 'Starting') }}</h2>
          <p v-if="busy === 'capture'" class="muted small" role="status" id="taking">{{ taking }}</p>
          <ul v-else-if="advice.length" class="faults small">
            <li v-for="(a, i) in advice" :key="i" :class="a.kind">{{ a.text }}</li>
          </ul>
          <p v-else class="muted small">{{ ready }}</p>
          <label class="check small">
            <input type="checkbox" id="auto" v-model="auto"
              @change="takeWhenReady">Capture once when steady, with open eyes</label>
          <div class="small stack" style="gap: .3rem; margin-top: auto">
            <label class="field">Session<select v-model="session" id="session">
                <option value="">none</option>
                <option v-for="s in state.sessions || []" :key="s.id"
                  :value="s.id">{{ sessionName(s, state.sessions) }}</option>
              </select>
            </label>
            <div class="line" @keydown.enter="$event.target.blur()" @keydown.esc="$event.target.blur()">
              <label class="field grow">Label<input v-model="label" maxlength="500"></label>
              <label class="field grow">Expression<input v-model="expression" maxlength="500" placeholder="neutral">
              </label>
            </div>
          </div>
          <div v-if="state.plates" class="small muted line wrap">
            <span>{{ say('Clean plates of {time}', { time: clock(state.plates.taken) }) }}</span>
            <button v-if="state.plates.before" class="b push" id="undo-plates" :disabled="!!busy"
              @click="usePlates(state.plates.before.id)">{{ say('Use those of {time}',
                { time: clock(state.plates.before.taken) }) }}</button>
          </div>
          <div class="small muted line">
            <i :class="['dot', calibration.kind]"></i>
            <a href="/calibration" class="cut" aria-label="Calibration">{{ calibration.text }}<template
              v-if="state.in_use?.rms_px">, {{ fixed(state.in_use.rms_px, 2) }} px</template>
            </a>
            <a v-if="state.last" href="/captures" class="push">Captures</a></div>
        </aside>
      </div>
      <div v-if="asking" class="keys" role="dialog" aria-label="Consent before the first shot">
        <form class="panel pad stack" style="width: min(30rem, 92vw)" @submit.prevent="consent">
          <h2>Consent comes before the first shot</h2>
          <p class="small muted">A session holds one person's captures, so that they can be erased together.</p>
          <label class="field">Subject<input v-model="asking.label" id="subject" maxlength="500" required
            placeholder="name or number" :disabled="!!asking.id">
          </label>
          <label class="field">Consent<input v-model="asking.consent" id="consent" maxlength="500" required
            placeholder="who signed what, when">
          </label>
          <div class="line">
            <button class="b main-action" :disabled="!!busy">Go on</button>
            <button type="button" class="b quiet" @click="asking = null">No shot</button>
          </div>
        </form>
      </div>
      <div v-if="count" class="countdown" role="alert"><span>{{ count }}</span></div>
    </section>`,
  created() {
    this.faultsOf = faultsOf;
    this.clock = clock;
    this.sessionName = sessionName;
    this.soft = SOFT_PX;
    this.limit = EXPOSURE;
    this.fixed = fixed;
    this.span = span;
    this.stageWords = stageWords;
  },
  mounted() {
    window.addEventListener("keydown", this.key);
    this.clockTimer = setInterval(() => {
      this.now = Date.now();
    }, 500);
    this.look();
    if (!this.job && !this.shot && begunHere()) this.$emit("choose", { job: begunHere() });
  },
  unmounted() {
    window.removeEventListener("keydown", this.key);
    clearInterval(this.clockTimer);
    clearInterval(this.counter);
  },
  methods: {
    leaveJob() {
      leaveBegun(this.job.id);
      this.$emit("choose", { job: null });
    },
    keepTyped() {
      keepDraft("shot", this.label || this.expression ? { label: this.label, expression: this.expression } : null);
    },
    keepPlace() {
      keepAddress({ shot: this.shot?.id, job: this.job?.id });
    },
    percent(share) {
      return share === undefined ? "-" : `${fixed(100 * share, share < 0.1 ? 1 : 0)}%`;
    },
    light(name) {
      const mean = this.live[name]?.mean;
      if (mean === undefined || mean === null) return { text: "-", bad: false };
      return { text: mean.toFixed(0), bad: mean < EXPOSURE.dark || mean > EXPOSURE.bright };
    },
    sync(camera) {
      if (!camera.sync) return { text: say("no shot yet"), bad: false };
      const skew =
        camera.sync.skew_ms === null || camera.sync.skew_ms === undefined ? "" : ` ${fixed(camera.sync.skew_ms, 1)} ms`;
      return { text: say(camera.sync.status) + skew, bad: !["in sync", "ok"].includes(camera.sync.status) };
    },
    waiting(camera) {
      const seen = this.live[camera.name];
      if (camera.state === "missing") return say("No camera. Check its cable and power.");
      if (!seen) return say(this.fault || "Starting the live view ...");
      if (seen.fault) return say(seen.fault);
      return this.now - seen.at > STALE_MS ? say("The picture stands still") : "";
    },
    start() {
      if (this.count) this.stop();
      else if (this.busy) return;
      else if (this.state.ask_consent && !this.open?.consent)
        this.asking = { id: this.open?.id || "", label: this.open?.label || "", consent: "" };
      else this.countDown();
    },
    consent() {
      this.begun = this.asking.id
        ? null
        : { label: this.asking.label, known: (this.state.sessions || []).map((s) => s.id) };
      this.busy = "consent";
      this.$emit("act", { name: this.asking.id ? "edit_session" : "new_session", ...this.asking });
    },
    countDown() {
      this.count = COUNT_S;
      this.counter = setInterval(() => {
        this.count -= 1;
        if (this.count === 0) {
          clearInterval(this.counter);
          this.act("capture");
        }
      }, 1000);
    },
    stop() {
      clearInterval(this.counter);
      this.count = 0;
    },
    usePlates(id) {
      if (!this.busy) {
        this.busy = "use_plates";
        this.$emit("act", { name: "use_plates", id });
      }
    },
    plates() {
      if (!this.busy) this.act("plates");
    },
    act(name) {
      this.busy = name;
      this.taken = this.now = Date.now();
      this.$emit("act", { name, label: this.label, expression: this.expression, session: this.open?.id });
    },
    acted(name) {
      this.busy = "";
      if (name === "new_session" && this.begun) {
        const made = (this.state.sessions || []).find(
          (s) => s.label === this.begun.label && !this.begun.known.includes(s.id),
        );
        if (made) this.session = made.id;
        this.begun = null;
      }
      if (["new_session", "edit_session"].includes(name) && this.asking && this.open?.consent) {
        this.asking = null;
        this.countDown();
      }
      if (name === "retake" && !this.shot) this.countDown();
    },
    decide(name) {
      if (this.shot && !this.busy) {
        this.busy = name;
        this.$emit("act", { name, id: this.shot.id });
      }
    },
    key(event) {
      if (typing(event)) return;
      if (event.key === " ") {
        event.preventDefault();
        if (!event.repeat) this.start();
      } else if (event.key === "Escape") this.stop();
      else if (this.shot && "kK".includes(event.key)) this.decide("keep");
      else if (this.shot && "rR".includes(event.key)) this.decide("retake");
      else if (this.shot && event.key === "Enter" && event.target.tagName !== "BUTTON") this.decide("reconstruct");
      else if (this.job?.state === "succeeded" && "hH".includes(event.key)) location.href = `/result/${this.job.id}`;
      else if (event.key === "b" || event.key === "B") this.plates();
    },
  },
});
