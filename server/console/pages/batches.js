// Batches at the left, one of them at the right.
import { say, spoken } from "/console/static/language.js";
import { Pager, paged } from "/console/static/list.js";
import { LEVELS, clock, keepDraft, kept, span } from "/console/static/words.js";

const asked = new URLSearchParams(location.search);
const DONE = ["succeeded", "failed", "cancelled", "removed"];

export default spoken({
  mixins: [paged],
  components: { Pager },
  props: { state: Object },
  emits: ["act", "choose"],
  data: () => ({
    chosen: asked.get("batch") || "",
    only: asked.get("state") || "",
    form: kept("batches form"),
    busy: "",
    cancelling: "",
  }),
  watch: {
    "batch.id"() {
      this.cancelling = "";
      this.keepAddress();
    },
    only() {
      this.first();
    },
    form: {
      handler(form) {
        keepDraft("batches form", form);
      },
      deep: true,
    },
  },
  computed: {
    listed() {
      return this.state.batches || [];
    },
    batch() {
      return this.state.batch || null;
    },
    counts() {
      return Object.entries(this.batch.counts).filter(([, count]) => count);
    },
    active() {
      return !this.batch.finished && this.batch.state !== "cancelled";
    },
  },
  template: `
    <section class="page" aria-label="Batches">
      <header class="wraps">
        <h1>Batches</h1>
        <span class="lead">{{ state.loading ? say('Reading')
          : say('{count} batch | {count} batches', { count: state.total }) }}</span>
        <template v-if="batch">
          <template v-if="active">
            <button class="b" v-if="batch.state === 'running'" id="pause" :disabled="!!busy"
              title="Lets run what runs, and begins nothing more" @click="act('pause')">Pause</button>
            <button class="b" v-else id="resume" :disabled="!!busy" @click="act('resume')">Resume</button>
            <button class="b" v-if="!cancelling" id="cancel" :disabled="!!busy"
              @click="cancelling = batch.id">Cancel ...</button>
            <button class="b" v-else id="cancel-all" :disabled="!!busy"
              @click="act('cancel')">{{ say('Cancel {count} job for good | Cancel {count} jobs for good',
                { count: undone(batch) }) }}</button>
          </template>
          <button class="b" v-else-if="batch.finished" id="remove" :disabled="!!busy" title="Its jobs and heads stay"
            @click="act('remove')">Remove</button>
          <button class="b" v-if="batch.counts.failed && batch.state !== 'cancelled'" id="retry" :disabled="!!busy"
            @click="act('retry')">Retry what failed</button>
        </template>
        <button class="b main-action" id="new-batch" @click="openForm">New batch</button></header>
      <form v-if="form" class="panel pad line wrap" style="align-items: end; flex: none" aria-label="New batch"
        @submit.prevent="busy = 'begin'; $emit('act', { name: 'begin', ...form })">
        <label class="field grow">Captures whose label begins with<input ref="prefix" v-model="form.prefix" id="prefix"
          maxlength="500" required>
        </label>
        <label class="field grow">Name<input v-model="form.label" maxlength="500"></label>
        <label class="field">Detail<select v-model="form.detail">
            <option value="">as deep as the images carry</option>
            <option v-for="(words, l) in levels" :key="l" :value="l">{{ say(words) }}</option>
          </select>
        </label>
        <button class="b main-action" :disabled="!!busy">Begin</button>
        <button type="button" class="b quiet" @click="form = null">Cancel</button>
      </form>
      <div class="columns" style="grid-template-columns: 24rem minmax(0, 1fr)">
        <div class="stack" style="min-height: 0">
          <div class="line">
            <input v-model="sought" id="find" class="grow" type="search" maxlength="200" placeholder="Find: name"
              aria-label="Find batches">
            <select v-model="only" id="state" aria-label="State">
              <option value="">every state</option>
              <option v-for="s in states" :key="s" :value="s">{{ say(s) }}</option>
            </select>
          </div>
          <div class="panel scroll grow" tabindex="0" role="region" aria-label="List of batches" data-scroll="batches"
            @keydown="walk">
            <p v-if="(sought || only) && !listed.length" class="muted small"
              style="padding: .5rem .75rem">No batch matches.</p>
            <button v-for="b in listed" :key="b.id" class="row-button" :data-batch="b.id" :data-state="b.state"
              :aria-current="batch && b.id === batch.id" @click="choose(b.id)">
              <span class="line">
                <strong class="cut grow">{{ title(b) }}</strong>
                <span v-if="b.counts.failed"
                  class="tag fault">{{ say('failed | {count} failed', { count: b.counts.failed }) }}</span>
                <span class="tag" :class="kind(b)">{{ say(b.state) }}</span>
              </span>
              <span class="bar" role="progressbar" :aria-label="say('Progress of {id}', { id: title(b) })"
                :aria-valuenow="Math.round(100 * share(b))" aria-valuemin="0" aria-valuemax="100">
                <i :style="{ width: 100 * share(b) + '%' }"></i>
              </span>
              <span class="small muted line">
                <span class="grow cut">{{ clock(b.created) }}</span>
                <span class="num">{{ say('{done} of {total}', { done: done(b), total: b.total }) }}</span>
              </span>
            </button>
            <pager :behind="behind.length" :next="state.next" :size="listed.length" :total="state.total" @back="back"
              @forward="forward"></pager>
          </div></div>
        <div class="panel pad scroll stack" tabindex="0" role="region" aria-label="The chosen batch">
          <template v-if="batch">
            <div class="line wrap">
              <h2>{{ title(batch) }}</h2>
              <span class="tag" :class="kind(batch)">{{ say(batch.state) }}</span>
              <span class="muted small mono">{{ batch.id.slice(-6) }}</span>
              <span class="muted small push">{{ batch.model || say('default model') }} &middot;
                {{ say('queue {name}', { name: batch.queue }) }} &middot;
                {{ say('priority {number}', { number: batch.priority }) }}</span>
            </div>
            <div class="line wrap">
              <strong class="num">{{ say('{done} of {total}', { done: done(batch), total: batch.total }) }}</strong>
              <span v-if="batch.eta_s !== null"
                class="muted push">{{ say('about {time} left', { time: span(batch.eta_s) }) }}</span>
            </div>
            <div class="bar" aria-hidden="true"><i :style="{ width: 100 * share(batch) + '%' }"></i></div>
            <p v-if="batch.notice_message" class="warn">{{ say(batch.notice_message) }}</p>
            <table class="small" aria-label="Captures by state" style="width: auto">
              <tbody>
                <tr v-for="[state, count] in counts" :key="state" :data-count="state">
                  <td>{{ say(state, { context: 'captures' }) }}</td>
                  <td class="num" :class="{ fault: state === 'failed' }">{{ count }}</td>
                </tr>
              </tbody>
            </table>
            <div class="line wrap">
              <a class="b" id="to-jobs" :href="'/jobs?batch=' + batch.id">Its jobs</a>
              <a class="b" id="to-table" :href="file('heads.csv')" download>Table, CSV</a>
              <a v-if="state.parquet" class="b" :href="file('heads.parquet')" download>Table, Parquet</a>
              <a class="b" id="to-sheet" :href="file('sheet.html')" target="_blank" rel="noopener">Contact sheet</a>
              <a class="b" :href="file('sheet.pdf')" target="_blank" rel="noopener">Contact sheet, PDF</a>
            </div>
            <template v-if="state.failed.length"><h3>What failed</h3>
              <ul class="faults small">
                <li v-for="j in state.failed" :key="j.id">
                  <a :href="'/jobs?job=' + j.id">{{ j.capture || j.id.slice(-6) }}</a>
                  <ul class="faults"><li v-for="(w, i) in j.why" :key="i" class="fault">{{ say(w) }}</li></ul>
                </li>
              </ul>
              <p v-if="batch.counts.failed > state.failed.length" class="muted small">
                <a :href="'/jobs?state=failed&batch=' + batch.id">{{ say('All {count} that failed',
                  { count: batch.counts.failed }) }}</a>
              </p>
            </template>
          </template>
          <div v-else-if="!state.loading" class="empty">
            <h2>No batches yet</h2>
            <p>A batch makes heads of many captures, behind the jobs of whoever shoots. Programs begin it with POST
              /v1/batches.</p>
          </div>
        </div>
      </div>
    </section>`,
  created() {
    Object.assign(this, { clock, levels: LEVELS, span, states: ["running", "paused", "finished", "cancelled"] });
  },
  methods: {
    title(b) {
      return b.label || say("without a name, {time}", { time: clock(b.created) });
    },
    kind(b) {
      return { running: "accent", finished: "good", paused: "warn" }[b.state] || "";
    },
    done(b) {
      return DONE.reduce((sum, state) => sum + b.counts[state], 0);
    },
    undone(b) {
      return b.total - this.done(b);
    },
    share(b) {
      return b.total ? this.done(b) / b.total : 0;
    },
    file(name) {
      return `/console/batches/${this.batch.id}/${name}`;
    },
    async openForm() {
      this.form = { prefix: "", label: "", detail: "" };
      await this.$nextTick();
      this.$refs.prefix.focus();
    },
    act(name) {
      this.busy = name;
      this.$emit("act", { name, id: this.batch.id });
    },
    acted(name, done) {
      this.busy = this.cancelling = "";
      if (name === "begin" && done) {
        this.form = null;
        this.chosen = this.state.batch?.id || "";
      }
      if (name === "remove" && done) this.chosen = "";
    },
    fields() {
      return { batch: this.batch?.id, find: this.sought, state: this.only };
    },
    question() {
      return { find: this.sought, state: this.only, batch: this.chosen, after: this.behind.at(-1) || "" };
    },
  },
});
