// History at the left; at the right the shots that are being taken, or the report of the chosen calibration.
import { liveView } from "/console/static/live.js";
import { say, spoken } from "/console/static/language.js";
import { told, toldFaults } from "/console/static/messages.js";
import { clock, fixed, keepAddress, keepDraft, kept, send, span, stageWords } from "/console/static/words.js";

export default spoken({
  mixins: [liveView],
  props: { state: Object },
  emits: ["act"],
  data: () => ({
    chosen: new URLSearchParams(location.search).get("calibration"),
    sure: false,
    board: {
      kind: "charuco",
      columns: 12,
      rows: 9,
      square_mm: 30,
      marker_ratio: 0.75,
      dictionary: "DICT_4X4_1000",
      measured_width_mm: null,
      inverted: false,
      ...kept("board"),
    },
    label: kept("calibration name") || "",
    busy: "",
    source: kept("calibration source") || "board",
    over: false,
    upload: null,
  }),
  watch: {
    chosen(id) {
      keepAddress({ calibration: id });
      this.sure = false;
    },
    board: {
      handler(board) {
        keepDraft("board", board);
      },
      deep: true,
    },
    label(text) {
      keepDraft("calibration name", text);
    },
    source(of) {
      keepDraft("calibration source", of);
    },
    "state.board": {
      handler(board) {
        if (board?.kind) Object.assign(this.board, { measured_width_mm: null, inverted: false }, board);
      },
      immediate: true,
    },
    "state.rig.kind": {
      handler(kind) {
        if (kind === "real") this.look();
      },
      immediate: true,
    },
  }, // nobody holds a board in the simulated studio
  computed: {
    collecting() {
      return this.state.shots > 0;
    }, // then the board stays what it is
    list() {
      return this.state.calibrations || [];
    },
    current() {
      return this.list.find((c) => c.id === this.chosen) || null;
    },
    cameras() {
      return Object.entries(this.current?.figures?.cameras || {});
    },
    lead() {
      if (this.state.loading) return say("Reading");
      const used = this.list.find((c) => c.in_use);
      return used
        ? say("In use: {name}", { name: used.label || clock(used.created) })
        : say(this.state.rig.calibration ? "In use: the rig's own" : "No calibration in use");
    },
  },
  template: `
    <section class="page" aria-label="Calibration" @dragover.prevent="over = true" @dragleave="over = false"
      @drop.prevent="over = false; take($event.dataTransfer.files)">
      <header><h1>Calibration</h1><span class="lead">{{ lead }}</span>
        <button class="b" :aria-pressed="!current" @click="chosen = null">New calibration</button>
        <template v-if="current">
          <a v-if="current.state === 'succeeded'" class="b" target="_blank" rel="noopener"
            :href="'/console/calibrations/' + current.id + '/report.html'">Whole report</a>
          <a v-if="current.state === 'succeeded'" class="b"
            :href="'/console/calibrations/' + current.id + '/cameras.json'" download="cameras.json">cameras.json</a>
          <button class="b" :disabled="!!busy || ['queued', 'running'].includes(current.state)"
            @click="act('remove', { id: current.id })">Remove</button>
          <button class="b" id="use" :class="{ 'main-action': current.verdict !== 'poor' }"
            :disabled="!!busy || current.in_use || current.state !== 'succeeded'" @click="current.verdict === 'poor'
              ? (sure = true)
              : act('use', { id: current.id })">{{ say(current.in_use ? 'In use' : current.verdict === 'poor'
                ? 'Use this ...' : 'Use this') }}</button>
        </template>
      </header>
      <div class="columns" style="grid-template-columns: 19rem minmax(0, 1fr)">
        <div class="stack" style="min-height: 0">
          <div :class="['drop', { over }]">
            <label class="field">Calibrate from<select v-model="source" id="source">
                <option value="board">pictures of a board</option>
                <option value="scene">the photographs (no board)</option>
              </select>
            </label>
            <div class="small" style="margin-top: .4rem">{{ say(source === 'board'
              ? 'Drop an archive of IMAGES/ and board.toml here'
              : 'Drop an archive of photographs here: 20 to 40, 10 to 15 degrees apart, of anything that holds still; scale.json beside them makes the scale known') }}</div>
            <div style="margin-top: .4rem">
              <button class="b" @click="$refs.file.click()">Choose a file</button>
              <input ref="file" type="file" hidden accept=".zip,.tar,.gz,.tgz" aria-label="Archive of pictures"
                @change="take($event.target.files); $event.target.value = ''">
            </div>
          </div>
          <div v-if="upload" class="panel pad small stack" style="gap: .3rem" role="status">
            <div class="line">
              <span class="grow cut">{{ upload.name }}</span>
              <span class="num">{{ say(upload.state) }}</span>
              <button class="b quiet" aria-label="Close" @click="upload = null">&times;</button>
            </div>
            <template v-if="upload.detail">
              <p class="fault">{{ say(upload.detail) }}</p>
              <ul class="faults"><li v-for="(e, i) in upload.errors" :key="i">{{ say(e) }}</li></ul>
            </template>
          </div>
          <div class="panel scroll grow" tabindex="0" role="region" aria-label="History of calibrations"
            data-scroll="calibrations">
            <p v-if="!state.loading && !list.length" class="muted small"
              style="padding: .8rem">No calibrations yet. Take board shots at the right, or drop an archive above.</p>
            <button v-for="c in list" :key="c.id" class="row-button" :data-calibration="c.id" :data-state="c.state"
              :aria-current="current && c.id === current.id" @click="chosen = c.id">
              <span class="line">
                <strong class="cut grow">{{ c.label || clock(c.created) }}</strong>
                <span class="tag" :class="{ accent: c.in_use || c.state === 'running',
                  fault: c.state === 'failed' }">{{ c.state === 'running'
                  && !c.in_use ? Math.round(100 * c.progress) + ' %'
                  : say(c.in_use ? 'in use' : c.state === 'succeeded' && c.verdict ? c.verdict : c.state) }}</span>
              </span>
              <span class="small muted">{{ clock(c.created) }} &middot;
                {{ say('{count} camera | {count} cameras', { count: Object.keys(c.pictures).length }) }}<template
                v-if="c.kind === 'scene'">, no board</template>
                <template v-if="c.figures.rms_px"> &middot; {{ fixed(c.figures.rms_px, 2) }} px</template>
              </span>
            </button>
          </div>
        </div>
        <div v-if="current" class="panel pad scroll stack" tabindex="0" role="region" aria-label="Report">
          <div class="line wrap">
            <h2>{{ current.label || clock(current.created) }}</h2>
            <span class="tag" :class="{ accent: current.in_use,
              fault: current.state === 'failed' }">{{ say(current.in_use ? 'in use' : current.state) }}</span>
          </div>
          <template v-if="current.error">
            <p class="fault">{{ say(current.error.detail_message) }}</p>
            <ul class="faults small"><li v-for="(e, i) in current.error.error_messages" :key="i">{{ say(e) }}</li></ul>
          </template>
          <ul v-if="current.warning_messages.length" class="faults small">
            <li v-for="(w, i) in current.warning_messages" :key="i" class="warn">{{ say(w) }}</li>
          </ul>
          <div v-if="['queued', 'running'].includes(current.state)" class="stack" role="status">
            <div class="line">
              <strong class="grow">{{ current.state === 'queued' ? say('Waiting for the worker')
                : stageWords(current.stage || (current.kind === 'scene' ? 'features' : 'detection')) }}</strong>
              <span class="num">{{ Math.round(100 * current.progress) }} %</span>
              <span v-if="current.eta_s !== null && current.state === 'running'"
                class="num muted">{{ say('about {time} left', { time: span(current.eta_s) }) }}</span>
            </div>
            <div class="bar" role="progressbar" aria-label="Progress of the calibration"
              :aria-valuenow="Math.round(100 * current.progress)" aria-valuemin="0" aria-valuemax="100">
              <i :style="{ width: 100 * current.progress + '%' }"></i>
            </div>
          </div>
          <div v-if="current.verdict" class="stack" id="calibration-verdict" role="region" aria-label="Verdict"
            :data-verdict="current.verdict" style="gap: .35rem">
            <div class="line wrap">
              <span class="tag" :class="{ good: 'good', usable: 'warn',
                poor: 'fault' }[current.verdict]">{{ say({ good: 'Good', usable: 'Usable',
                  poor: 'Poor' }[current.verdict]) }}</span>
              <span>{{ say({ good: 'Every camera is known well enough.',
                usable: 'Enough for heads; better ones are had with what is missing.',
                poor: 'Not enough: heads made with it would be wrong.' }[current.verdict]) }}</span>
            </div>
            <ul v-if="current.missing_messages.length" class="faults small" aria-label="What is missing">
              <li v-for="(m, i) in current.missing_messages" :key="i">{{ say(m) }}</li>
            </ul>
          </div>
          <div v-if="sure && current.verdict === 'poor' && !current.in_use" class="panel pad line wrap small"
            role="alertdialog" aria-label="Use a poor calibration" style="border-color: var(--warn)">
            <span class="grow warn">Every capture from now on would get cameras that are not known well enough.</span>
            <button class="b main-action" @click="sure = false; chosen = null">Take more shots</button>
            <button class="b" id="use-poor" :disabled="!!busy"
              @click="act('use', { id: current.id, poor: true })">Use it all the same</button>
          </div>
          <template v-if="current.state === 'succeeded'">
            <div class="line wrap" style="gap: 2rem">
              <div>
                <div class="small muted">Residual</div>
                <div class="mono" style="font-size: 1.4rem">{{ fixed(current.figures.rms_px, 2) }} px</div>
              </div>
              <div>
                <div
                  class="small muted">{{ say(current.kind === 'scene' ? 'Matched points used' : 'Corners used') }}</div>
                <div class="mono" style="font-size: 1.4rem">{{ fixed(100 * current.figures.used_share, 1) }} %</div>
              </div>
              <div>
                <div class="small muted">Front camera</div>
                <div class="mono" style="font-size: 1.4rem">{{ current.front }}</div>
              </div>
            </div>
            <div class="columns" style="grid-template-columns: minmax(0, 2fr) minmax(0, 1fr); flex: none">
              <div v-if="current.checks.length" class="stack">
                <h3>Checks</h3>
                <table class="small">
                  <tbody>
                    <tr v-for="c in current.checks" :key="c.name">
                      <td>
                        <i role="img"
                          :aria-label="say(c.passed === null ? 'not checked' : c.passed ? 'passed' : 'failed')"
                          :class="['dot', c.passed === null ? '' : c.passed ? 'good' : 'fault']"></i>
                      </td>
                      <td style="white-space: nowrap">{{ say(c.name) }}</td>
                      <td>{{ say(c.detail_message ?? c.detail) }}<div v-if="c.passed === false && c.advice"
                        class="warn">{{ say(c.advice_message ?? c.advice) }}</div>
                      </td>
                    </tr>
                  </tbody>
                </table>
              </div>
              <div class="stack">
                <h3>Residual by camera</h3>
                <table class="small">
                  <tbody>
                    <tr v-for="[name, f] in cameras" :key="name">
                      <td>{{ name }}</td>
                      <td class="num">{{ fixed(f.rms_px, 2) }} px</td>
                      <td class="num muted">{{ say('{count} picture | {count} pictures',
                        { count: current.pictures[name] }) }}</td>
                    </tr>
                  </tbody>
                </table>
              </div>
            </div></template>
        </div>
        <div v-else class="stack" style="min-height: 0">
          <form class="panel pad line wrap" style="align-items: end" aria-label="The board"
            @submit.prevent="act('shoot', { board })">
            <fieldset :disabled="collecting"
              :title="collecting ? say('All shots are of one board: start over to change it') : ''" class="line wrap"
              style="align-items: end">
              <label class="field">Board<select v-model="board.kind">
                  <option value="charuco">ChArUco</option>
                  <option value="checkerboard">checkerboard</option>
                </select>
              </label>
            <label class="field">Squares across<input v-model.number="board.columns" type="number" min="3" max="100"
              style="width: 6rem">
            </label>
            <label class="field">Squares down<input v-model.number="board.rows" type="number" min="3" max="100"
              style="width: 6rem">
            </label>
            <label class="field">Square, mm<input v-model.number="board.square_mm" type="number" min="0.5" step="any"
              style="width: 6rem">
            </label>
            <template v-if="board.kind === 'charuco'">
              <label class="field">Marker / square<input v-model.number="board.marker_ratio" type="number" min="0.3"
                max="0.95" step="any" style="width: 6rem">
              </label>
            <label class="field">Dictionary<input v-model="board.dictionary" style="width: 11rem" spellcheck="false">
            </label>
          </template>
            <label class="field" title="Of the printed pattern, by a ruler: checks the scale">Measured width, mm<input
              v-model.number="board.measured_width_mm" type="number" min="1" step="any" style="width: 8rem"
              placeholder="optional">
            </label>
            <label class="check small muted" style="padding-bottom: .4rem">
              <input v-model="board.inverted" type="checkbox">White on black</label>
          </fieldset>
            <span class="line push">
              <button v-if="collecting" type="button" class="b quiet" :disabled="!!busy"
                @click="act('start_over', {})">Start over</button>
              <button type="button" class="b" :disabled="!!busy || !collecting"
                @click="act('take_back', {})">Take the last one back</button>
              <button class="b main-action" id="shoot" :disabled="!!busy">{{ busy === 'shoot'
                ? say('Looking for the board ...')
                : say('Take shot {number}', { number: (state.shots || 0) + 1 }) }}</button>
            </span>
          </form>
          <div class="panel pad line wrap">
            <span class="grow" style="flex-basis: 12rem" role="status">{{ say(state.advice) }}</span>
            <span class="muted num">{{ say('{count} shot | {count} shots', { count: state.shots || 0 }) }}</span>
            <input v-model="label" placeholder="name of the calibration" aria-label="Name of the calibration"
              style="width: 14rem">
            <button class="b" id="calibrate" :class="{ 'main-action': state.shots >= 3 }"
              :disabled="!!busy || !(state.shots >= 3)" @click="act('calibrate', { label })">Calibrate</button>
          </div>
          <div class="panel pad scroll grow" tabindex="0" role="region" aria-label="Coverage by camera">
            <div class="thumbs four">
            <figure v-for="c in state.coverage" :key="c.name" style="margin: 0" class="stack">
              <div class="seen">
                <canvas :ref="el => keep(c.name, el)" width="640" height="480" aria-hidden="true"></canvas>
                <svg viewBox="0 0 4 3" preserveAspectRatio="none" role="img"
                  :aria-label="say('{name}: {count} view, {share} % covered | {name}: {count} views, {share} % covered',
                    { name: c.name, count: c.views, share: Math.round(100 * c.covered) })">
                <path d="M1 0v3M2 0v3M3 0v3M0 1h4M0 2h4" stroke="#4a5361" stroke-width=".01"></path>
                <circle v-for="(p, i) in c.corners" :key="i" :cx="4 * p[0]" :cy="3 * p[1]" r=".03"
                  fill="#e8ebf0"></circle>
                <circle v-for="(p, i) in c.last" :key="'l' + i" :cx="4 * p[0]" :cy="3 * p[1]" r=".035"
                  fill="#6cb2ff"></circle>
              </svg>
            </div>
              <figcaption class="line small" style="margin-top: -.3rem">
                <i :class="['dot', c.enough ? 'good' : '']"></i>
                <span style="flex: 1 0 auto">{{ c.name }}</span>
                <span class="muted num">{{ say('{count} view, {share} % | {count} views, {share} %',
                  { count: c.views, share: Math.round(100 * c.covered) }) }}</span>
              </figcaption>
            </figure>
          </div></div>
        </div>
      </div>
    </section>`,
  created() {
    Object.assign(this, { clock, fixed, span, stageWords });
  },
  methods: {
    act(name, more) {
      this.busy = name;
      this.$emit("act", { name, ...more });
    },
    acted(name, done) {
      this.busy = "";
      if (name === "use" && done) this.sure = false;
      if (name === "calibrate" && done) this.label = "";
    },
    async take(files) {
      const file = files[0];
      if (!file) return;
      this.upload = { name: file.name, state: "0 %", detail: "", errors: [] };
      const mine = this.upload;
      const { status, document } = await send(
        "/console/calibrations",
        file,
        { from: this.source, label: file.name.replace(/\.(zip|tar|tgz|tar\.gz)$/, "") },
        (share) => {
          mine.state = share < 1 ? `${Math.round(100 * share)} %` : "checking";
        },
      );
      if (status === 202) {
        this.upload = null;
        this.chosen = document.id;
        window.eigenheadSay("done", "The calibration is queued.");
      } else {
        mine.state = "refused";
        mine.detail = told(document);
        mine.errors = toldFaults(document);
      }
    },
  },
});
