// The queue at the left, one job at the right.
import { Pager, paged } from "/console/static/list.js";
import { say, spoken } from "/console/static/language.js";
import {
  LEVELS,
  METHODS,
  clock,
  fixed,
  keepDraft,
  kept,
  methodWords,
  span,
  stageWords,
} from "/console/static/words.js";

const asked = new URLSearchParams(location.search);

const MOSTLY = 0.25; // of the rim: beyond it hair or clothes hide the face, and the residual says nothing
const POOR_PX = 3.0; // outline residual from which a camera is worth a look

export default spoken({
  mixins: [paged],
  components: { Pager },
  props: { state: Object },
  emits: ["act", "choose"],
  data: () => ({
    chosen: asked.get("job") || "",
    only: asked.get("state") || "",
    sort: asked.get("sort") || "",
    batch: asked.get("batch") || "",
    form: null,
    busy: "",
    show: "",
  }),
  watch: {
    "job.id": {
      handler(id) {
        if (id) this.keepAddress();
        this.form = kept("restart")?.job === id ? kept("restart") : null;
      },
      immediate: true,
    },
    only() {
      this.first();
    },
    sort() {
      this.first();
    },
    batch() {
      this.first();
    },
    form: {
      handler(form) {
        keepDraft("restart", form);
      },
      deep: true,
    },
  },
  computed: {
    jobs() {
      return this.state.jobs || [];
    },
    listed() {
      return this.jobs;
    },
    job() {
      return this.state.job || null;
    },
    active() {
      return this.job && ["queued", "running"].includes(this.job.state);
    },
    waiting() {
      if (this.job.notice_message) return say(this.job.notice_message);
      const before = this.job.ahead || 0;
      return before
        ? say("Waiting, {count} job before it | Waiting, {count} jobs before it", { count: before })
        : say("Waiting for the worker");
    },
    sheet() {
      return `/console/jobs/${this.job.id}/contact_sheet.png`;
    },
    lead() {
      const { running = 0, queued = 0, succeeded = 0, failed = 0, cancelled = 0 } = this.state.counts || {};
      return this.state.loading
        ? say("Reading")
        : say("{running} running, {queued} queued, {ended} ended", {
            running,
            queued,
            ended: succeeded + failed + cancelled,
          });
    },
  },
  template: `
    <section class="page" aria-label="Jobs">
      <header><h1>Jobs</h1><span class="lead">{{ lead }}</span>
        <template v-if="job">
          <button class="b" v-if="active" id="cancel" :disabled="!!busy" @click="act('cancel')">Cancel</button>
          <button class="b" v-else :disabled="!!busy" @click="act('delete')">Remove</button>
          <button class="b" id="restart" :disabled="!!busy" @click="open">Restart</button>
          <a class="b main-action" v-if="job.state === 'succeeded' && job.frames" id="all"
            :href="'/console/jobs/' + job.id + '/all.zip'" download>All files (.zip)</a>
          <a class="b main-action" v-else-if="job.state === 'succeeded'" id="to-result"
            :href="'/result/' + job.id">Open the head</a>
        </template></header>
      <div class="columns" style="grid-template-columns: 24rem minmax(0, 1fr)">
        <div class="stack" style="min-height: 0">
          <div class="line">
            <input v-model="sought" id="find" class="grow" type="search" maxlength="200"
              placeholder="Find: label, session, solver, id" aria-label="Find jobs">
            <button class="b" id="pick" :aria-pressed="picking" @click="pickMany">Select</button>
          </div>
          <div class="line">
            <select v-model="only" id="state" class="grow" aria-label="State">
              <option value="">every state</option>
              <option v-for="(n, s) in state.counts" :key="s" :value="s">{{ say(s) }} ({{ n }})</option>
            </select>
            <select v-model="sort" id="sort" class="grow" aria-label="Order">
              <option value="">newest first</option>
              <option value="created">oldest first</option>
              <option value="-finished">ended last first</option>
            </select>
          </div>
          <p v-if="batch" class="line small">
            <span class="grow">Only jobs of one batch</span>
            <a class="b" :href="'/batches?batch=' + batch">To the batch</a>
            <button class="b quiet" id="all-jobs" @click="batch = ''">All jobs</button>
          </p>
          <div v-if="picking" class="panel pad line wrap small" role="region" aria-label="Selected jobs">
            <strong>{{ say('{count} selected', { count: picked.length }) }}</strong>
            <button class="b quiet" @click="pickAll">All of this page</button>
            <button class="b quiet" @click="picked = []">None</button>
            <button class="b" id="bulk-cancel" :disabled="!picked.length || !!busy"
              @click="bulk('cancel')">Cancel</button>
            <button class="b" id="bulk-restart" :disabled="!picked.length || !!busy"
              @click="bulk('restart')">Restart</button>
            <button class="b" id="bulk-remove" :disabled="!picked.length || !!busy"
              @click="bulk('remove')">Remove</button>
          </div>
        <div class="panel scroll grow" tabindex="0" role="region" aria-label="List of jobs" data-scroll="jobs"
          @keydown="walk">
          <p v-if="(sought || only || batch) && !jobs.length" class="muted small"
            style="padding: .5rem .75rem">No job matches.</p>
          <div v-for="j in jobs" :key="j.id" class="row-line">
            <input v-if="picking" type="checkbox" :value="j.id" v-model="picked"
              :aria-label="say('Select job {id}', { id: j.id.slice(-6) })">
          <button class="row-button" :data-job="j.id" :data-state="j.state" :aria-current="job && j.id === job.id"
            @click="choose(j.id)">
            <span class="line">
              <strong class="cut grow">{{ captureOf(j) }}</strong>
              <span class="tag" :class="kind(j)">{{ say(j.state) }}</span>
            </span>
            <span class="bar" role="progressbar" :aria-label="say('Progress of {id}', { id: j.id.slice(-6) })"
              :aria-valuenow="Math.round(100 * j.progress)" aria-valuemin="0" aria-valuemax="100">
              <i :style="{ width: 100 * j.progress + '%' }"></i>
            </span>
            <span class="small muted line">
              <span class="grow cut">{{ j.state === 'running' ? stageWords(j.stage) : clock(j.created) }}<template
                v-if="j.restart_of"> &middot; {{ say('after {id}', { id: j.restart_of.slice(-6) }) }}</template>
              </span>
              <span class="num">{{ j.state === 'running' && j.eta_s !== null
                ? say('{time} left', { time: span(j.eta_s) }) : j.state === 'queued' ? place(j) : took(j) }}</span>
            </span>
          </button></div>
          <p v-if="state.waiting" class="muted small"
            style="padding: .5rem .75rem">{{ say('{count} more waits in the queue. | {count} more wait in the queue.',
              { count: state.waiting }) }}</p>
          <pager :behind="behind.length" :next="state.next" :size="jobs.length" :total="state.total" @back="back"
            @forward="forward"></pager>
        </div></div>
        <div class="panel pad scroll stack" tabindex="0" role="region" aria-label="The chosen job">
          <template v-if="job">
            <div class="line wrap">
              <h2>{{ captureOf(job) }}</h2>
              <span class="tag" :class="kind(job)">{{ say(job.state) }}</span>
              <span class="muted small mono">{{ job.id.slice(-6) }}</span>
              <span class="muted small push">{{ job.model || say('default model') }} &middot;
                {{ methodWords(job.settings.method) }} &middot; {{ say('queue {name}', { name: job.queue }) }}</span>
            </div>
            <form v-if="form" class="panel pad stack" style="background: var(--raised)" @submit.prevent="restart"
              aria-label="Restart with other settings">
              <div class="line wrap" style="align-items: end">
                <label class="field">Method<select v-model="form.method">
                    <option value="">as set</option>
                    <option v-for="(words, m) in methods" :key="m" :value="m">{{ say(words) }}</option>
                  </select>
                </label>
                <label v-if="state.models.length > 1" class="field">Model<select v-model="form.model">
                    <option value="">as before</option>
                    <option v-for="m in state.models" :key="m">{{ m }}</option>
                  </select>
                </label>
                <label class="field">Detail<select v-model="form.detail">
                    <option value="">as deep as the images carry</option>
                    <option v-for="(words, l) in levels" :key="l" :value="l">{{ say(words) }}</option>
                  </select>
                </label>
                <label class="field">Front camera<input v-model="form.front" placeholder="guessed" size="8"></label>
              </div>
              <label class="field">Further settings, JSON<textarea v-model="form.more" rows="3"
                spellcheck="false"></textarea>
              </label>
              <div class="line">
                <button class="b main-action" :disabled="!!busy">Queue the new job</button>
                <button type="button" class="b quiet" @click="form = null">Keep it as it is</button>
              </div>
            </form>
            <div v-if="job.error" class="stack" role="alert">
              <p class="fault">{{ say(job.error.detail_message) }}</p>
              <ul class="faults small"><li v-for="(e, i) in job.error.error_messages" :key="i">{{ say(e) }}</li></ul>
            </div>
            <ul v-if="state.detail.warnings.length" class="faults small">
              <li v-for="(w, i) in state.detail.warnings" :key="i" class="warn">{{ say(w) }}</li>
            </ul>
            <div class="columns" style="grid-template-columns: minmax(0, 1fr) 15rem; flex: none">
              <div v-if="state.detail.cameras.length" class="scroll" tabindex="0" role="region"
                aria-label="Residuals by camera">
                <table>
                <thead>
                  <tr>
                    <th>Camera</th>
                    <th class="num" title="Overlap of silhouette and fitted head in the face region">IoU</th>
                    <th class="num"
                      title="From the fitted rim to the silhouette, hair and clothes among it">outline, px</th>
                    <th class="num"
                      title="Share of the rim farther than 3 px from the silhouette: hair, clothes or misfit">outliers</th>
                    <th class="num"
                      title="Pixels in which silhouette and starting head differ">difference before, px</th>
                    <th class="num" title="The same of the fitted head">after, px</th>
                    <th>Use</th>
                  </tr>
                </thead>
                <tbody>
                  <tr v-for="c in state.detail.cameras" :key="c.name">
                    <td>{{ c.name }}</td>
                    <td class="num">{{ fixed(c.iou, 3) }}</td>
                    <td class="num" :class="{ warn: c.contour_rms_px > poor
                      && c.excluded_share < mostly }">{{ fixed(c.contour_rms_px,
                      2) }}</td>
                    <td class="num">{{ c.excluded_share === null ? '-'
                      : (100 * c.excluded_share).toFixed(0) + ' %' }}</td>
                    <td class="num">{{ fixed(c.xor_cost_start, 0) }}</td>
                    <td class="num">{{ fixed(c.xor_cost, 0) }}</td>
                    <td :class="{ warn: !c.used }">{{ c.used ? '' : say('left out') }}</td>
                  </tr>
                </tbody>
              </table>
            </div>
              <div v-else-if="active" class="stack">
                <div class="line wrap">
                  <strong class="grow"
                    style="flex-basis: 12rem">{{ job.state === 'running' ? stageWords(job.stage) : waiting }}</strong>
                  <span v-if="job.frames_done !== null" class="num" id="frames">{{ say('{done} of {all} frames',
                    { done: job.frames_done, all: job.frames }) }}</span>
                  <span class="num">{{ Math.round(100 * job.progress) }} %</span>
                  <span v-if="job.state === 'running' && job.eta_s !== null"
                    class="num muted">{{ say('about {time} left', { time: span(job.eta_s) }) }}</span>
                </div>
                <div class="bar" aria-hidden="true"><i :style="{ width: 100 * job.progress + '%' }"></i></div>
                <p
                  class="muted small">Residuals by camera, silhouettes and overlays stand here when the job is done.</p>
              </div>
              <p v-else-if="!job.frames" class="muted">The job left no report.</p>
              <div class="stack">
                <h3>Log</h3>
                <table class="small log">
                  <tbody>
                    <tr v-for="(l, i) in state.detail.log" :key="i">
                      <td class="num muted">{{ fixed(l.at_s, 1) }} s</td>
                      <td>{{ stageWords(l.text) }}</td>
                    </tr>
                  </tbody>
                </table>
                <p v-if="state.detail.stopped_because"
                  class="small muted">{{ say('{count} evaluation, {time} | {count} evaluations, {time}',
                    { count: state.detail.evaluations, time: span(state.detail.seconds.total) }) }}</p>
              </div>
            </div>
            <template v-if="state.detail.pictures">
              <div class="line"><h3>Silhouette difference before and after</h3></div>
              <a :href="sheet" target="_blank" rel="noopener" aria-label="Open the contact sheet">
                <img :src="sheet"
                  alt="Contact sheet: input, silhouette difference before and after the fit, and the head from new views"
                  style="width: 100%; border-radius: 3px; display: block" @error="$event.target.style.display = 'none'">
              </a>
              <h3>Outlines: input and fitted head</h3>
              <div class="thumbs">
                <a v-for="c in state.detail.cameras" :key="c.name" class="thumb" :href="overlay(c.name)" target="_blank"
                  rel="noopener" :aria-label="say('Overlay of {name}', { name: c.name })">
                  <img :src="overlay(c.name)" :alt="say('Outlines in {name}', { name: c.name })" loading="lazy">
                  <span>{{ c.name }}</span>
                </a>
              </div>
            </template>
          </template>
          <div v-else-if="!state.loading" class="empty">
            <h2>{{ say(jobs.length ? 'Choose a job' : 'No jobs yet') }}</h2>
            <template v-if="!jobs.length">
              <p>Choose a capture and press Reconstruct.</p>
              <a class="b main-action" href="/captures">Go to captures</a>
            </template>
          </div>
        </div>
      </div>
    </section>`,
  created() {
    Object.assign(this, {
      clock,
      fixed,
      levels: LEVELS,
      methods: METHODS,
      methodWords,
      span,
      stageWords,
      poor: POOR_PX,
      mostly: MOSTLY,
    });
  },
  methods: {
    captureOf(j) {
      return j.captured ? j.capture || clock(j.captured) : say("removed capture");
    },
    kind(j) {
      return j.state === "failed" ? "fault" : j.state === "running" || j.state === "succeeded" ? "accent" : "";
    },
    took(j) {
      return j.started && j.finished ? span((new Date(j.finished) - new Date(j.started)) / 1000) : "";
    },
    overlay(name) {
      return `/console/jobs/${this.job.id}/overlays/${name}.png`;
    },
    act(name) {
      this.busy = name;
      this.$emit("act", { name, id: this.job.id });
    },
    acted(name, done) {
      this.busy = "";
      if (name === "restart" && done) {
        this.form = null;
        this.chosen = this.state.job?.id || "";
      }
      if (name === "bulk") this.picked = [];
    },
    place(j) {
      return j.ahead ? say("{count} before it", { count: j.ahead }) : say("next");
    },
    fields() {
      return { job: this.job?.id, find: this.sought, state: this.only, sort: this.sort, batch: this.batch };
    },
    question() {
      return {
        find: this.sought,
        state: this.only,
        sort: this.sort,
        batch: this.batch,
        job: this.chosen,
        after: this.behind.at(-1) || "",
      };
    },
    bulk(action) {
      this.busy = "bulk";
      this.$emit("act", { name: "bulk", action, ids: [...this.picked] });
    },
    open() {
      const { method = "", detail = "", front = "", ...more } = this.job.settings;
      this.form = {
        job: this.job.id,
        method,
        model: "",
        detail: detail || "",
        front: front || "",
        more: Object.keys(more).length ? JSON.stringify(more, null, 1) : "",
      };
    },
    restart() {
      this.busy = "restart";
      this.$emit("act", { name: "restart", id: this.job.id, ...this.form });
    },
  },
});
