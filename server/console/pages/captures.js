// Sessions and captures at the left, the pictures of the chosen one at the right.
import { Pager, paged } from "/console/static/list.js";
import { say, spoken } from "/console/static/language.js";
import { FaceMarks, facesOf } from "/console/static/faces.js";
import { english, told, toldFaults } from "/console/static/messages.js";
import { Outline, Verdict, checksOf, faultsOf, verdictTag } from "/console/static/verdict.js";
import {
  clock,
  keepDraft,
  keepSession,
  kept,
  openSession,
  send,
  sessionName,
  size,
  typing,
} from "/console/static/words.js";

const asked = new URLSearchParams(location.search);

export default spoken({
  mixins: [checksOf, facesOf, paged],
  components: { FaceMarks, Outline, Pager, Verdict },
  props: { state: Object },
  emits: ["act", "choose"],
  data: () => ({
    labels: kept("captures form tags") || "",
    chosen: asked.get("capture") || "",
    verdict: asked.get("verdict") || "",
    tag: asked.get("tag") || "",
    tagging: "",
    sort: asked.get("sort") || "",
    outlines: false,
    drawing: 0,
    large: null,
    removal: null,
    sure: false,
    over: false,
    uploads: [],
    busy: "",
    session: asked.get("session") || openSession(),
    form: kept("captures form"),
    erasing: false,
    renaming: {},
    draft: {},
    writing: false,
    method: "",
    model: "",
    template: "",
  }),
  computed: {
    sessions() {
      return this.state.sessions || [];
    },
    open() {
      return this.sessions.find((s) => s.id === this.session) || null;
    },
    captures() {
      return this.state.captures || [];
    },
    listed() {
      return this.captures;
    },
    models() {
      return this.state.models || [];
    },
    current() {
      return this.state.chosen || null;
    },
    templates() {
      return (this.state.templates || []).filter((t) => t.models.includes(this.model || "default")).map((t) => t.name);
    },
    preset() {
      return (this.state.presets || []).find((p) => p.id === this.method);
    },
    narrowed() {
      return !!(this.sought || this.verdict || this.tag);
    },
  },
  watch: {
    sessions: {
      handler(all) {
        const made = this.begun && all.find((s) => s.label === this.begun.label && !this.begun.known.includes(s.id));
        if (made) {
          this.session = made.id;
          this.begun = null;
        } else if (this.state.sessions && this.session && !this.open) this.session = ""; // it was erased, perhaps on another page
      },
      immediate: true,
    },
    session(id) {
      keepSession(id);
      this.erasing = false;
      this.large = null;
      this.chosen = "";
      this.first();
    },
    "current.id": {
      handler(id) {
        this.readChecks(id);
        if (this.withFaces && this.current?.kind === "shot") this.readFaces(id);
        this.removal = null;
        if (!this.state.loading) this.keepAddress();
      },
      immediate: true,
    },
    templates(names) {
      if (!names.includes(this.template)) this.template = "";
    }, // of another model
    labels(text) {
      keepDraft("captures form tags", text || null);
    },
    verdict() {
      this.first();
    },
    tag() {
      this.first();
    },
    sort() {
      this.first();
    },
    form: {
      handler(form) {
        keepDraft("captures form", form);
      },
      deep: true,
    },
    current: {
      handler(c) {
        if (this.writing) return;
        const mine = kept("capture draft"); // typed before a reload, and not sent
        this.draft = !c
          ? {}
          : mine?.id === c.id
            ? mine
            : { label: c.label, expression: c.expression, tags: c.tags.join(", "), session: c.session || "" };
      },
      immediate: true,
    },
  },
  template: `
    <section class="page" aria-label="Captures" @dragover.prevent="over = true" @dragleave="over = false"
      @drop.prevent="drop">
      <header>
        <h1>Captures</h1>
        <span class="lead">{{ state.loading ? say('Reading') : narrowed ? say('Found: {count}', { count: state.total })
          : say('{count} capture | {count} captures', { count: state.total }) }}</span>
        <template v-if="current">
          <button v-if="current.kind === 'film'" class="b main-action" id="track" :disabled="!!busy"
            @click="act('reconstruct', current.id, { model })">Track the head</button>
          <template v-if="current.kind === 'shot'">
            <button class="b" :aria-pressed="outlines" @click="outlines = !outlines">Silhouettes</button>
            <button class="b" id="faces" :aria-pressed="withFaces" :aria-busy="!!finding"
              @click="showFaces(current.id)">{{ say(finding ? 'Looking for faces ...' : 'Faces') }}</button>
            <a class="b" :href="'/features/' + current.id">Pick features</a>
            <button class="b main-action" id="reconstruct" :disabled="!!busy"
              @click="act('reconstruct', current.id, { method, model, template })">Reconstruct</button>
          </template>
          <button class="b" id="remove" :disabled="!!busy" @click="askRemoval">Remove ...</button>
        </template>
      </header>
      <div class="columns" style="grid-template-columns: 19rem minmax(0, 1fr)">
        <div class="stack" style="min-height: 0">
          <div class="panel pad stack small" role="region" aria-label="Session">
            <div class="line" style="align-items: end">
              <label class="field grow">Session<select v-model="session" id="session">
                  <option value="">all captures</option>
                  <option v-for="s in sessions" :key="s.id" :value="s.id">{{ name(s) }} ({{ count(s.id) }})</option>
                </select>
              </label>
              <button class="b" id="new-session" @click="openForm">New</button></div>
            <form v-if="form" class="stack" style="gap: .4rem" @submit.prevent="begin" aria-label="New session">
              <label class="field">Subject<input v-model="form.label" maxlength="500" required ref="subject"
                placeholder="name or number">
              </label>
              <label class="field">Consent<input v-model="form.consent" maxlength="500"
                placeholder="who signed what, when">
              </label>
              <div class="line">
                <button class="b main-action" :disabled="!!busy">Begin</button>
                <button type="button" class="b quiet" @click="form = null">Cancel</button>
              </div>
            </form>
            <template v-else-if="open">
              <label class="field">Subject<input :value="renaming.label ?? open.label" maxlength="500" id="rename"
                @input="renaming.label = $event.target.value" @blur="renaming = {}"
                @change="act('edit_session', open.id, { label: $event.target.value })">
              </label>
              <label class="field">Consent<input :value="renaming.consent ?? open.consent" maxlength="500"
                placeholder="no note" @input="renaming.consent = $event.target.value" @blur="renaming = {}"
                @change="act('edit_session', open.id, { consent: $event.target.value })">
              </label>
              <div v-if="erasing" class="stack" style="gap: .4rem" role="alertdialog" aria-label="Erase the session">
                <p
                  class="warn">{{ say('Erase {name}: {count} capture, heads, jobs and caches? It cannot be taken back. | Erase {name}: {count} captures, heads, jobs and caches? It cannot be taken back.',
                    { name: name(open), count: count(open.id) }) }}</p>
                <div class="line">
                  <button class="b danger" id="erase-for-good" :disabled="!!busy"
                    @click="act('erase', open.id); erasing = false">Erase for good</button>
                  <button class="b quiet" @click="erasing = false">Keep</button>
                </div>
              </div>
              <div v-else class="line">
                <button class="b" id="reconstruct-all" :disabled="!!busy || !count(open.id)"
                  @click="act('reconstruct_session', open.id, { method, model, template })">Reconstruct all</button>
                <button class="b quiet push" id="erase" :disabled="!!busy" @click="erasing = true">Erase ...</button>
              </div>
            </template>
          </div>
          <div :class="['drop', { over }]">Drop an archive here (.zip, .tar, .tar.gz)
            <div style="margin-top: .4rem"><button class="b" @click="$refs.file.click()">Choose a file</button>
            <input ref="file" type="file" hidden multiple accept=".zip,.tar,.gz,.tgz" aria-label="Archive of a capture"
              @change="take($event.target.files); $event.target.value = ''">
          </div>
            <input v-model="labels" id="upload-tags" class="small" style="margin-top: .4rem; width: 100%"
              maxlength="1000" list="known-tags" placeholder="tags for these files: tag, tag"
              aria-label="Tags for what is uploaded, with commas between">
          </div>
          <div v-for="u in uploads" :key="u.id" class="panel pad small stack" style="gap: .3rem" role="status">
            <div class="line">
              <span class="cut grow">{{ u.name }}</span>
              <span class="num">{{ say(u.state) }}</span>
              <button v-if="u.done" class="b quiet" aria-label="Close"
                @click="uploads = uploads.filter(o => o.id !== u.id)">&times;</button>
            </div>
            <div v-if="!u.done" class="bar" role="progressbar" :aria-valuenow="Math.round(100 * u.share)"
              aria-valuemin="0" aria-valuemax="100" :aria-label="say('Upload of {name}', { name: u.name })">
              <i :style="{ width: 100 * u.share + '%' }"></i>
            </div>
            <template v-if="u.detail">
              <p class="fault">{{ say(u.detail) }}</p>
              <ul class="faults scroll" style="max-height: 14rem">
                <li v-for="(f, i) in u.errors" :key="i">{{ say(f) }}</li>
              </ul>
            </template>
          </div>
          <div class="line">
            <input v-model="sought" id="find" class="grow" type="search" maxlength="200"
              placeholder="Find: label, session, tag, id" aria-label="Find captures">
            <button class="b" id="pick" :aria-pressed="picking" @click="pickMany">Select</button>
          </div>
          <div class="line">
            <select v-model="verdict" id="verdict" class="grow" aria-label="Verdict">
              <option value="">every verdict</option>
              <option value="good">good</option>
              <option value="usable">usable</option>
              <option value="poor">poor</option>
              <option value="none">not judged</option>
            </select>
            <select v-model="sort" id="sort" class="grow" aria-label="Order">
              <option value="">newest first</option>
              <option value="created">oldest first</option>
              <option value="label">by label</option>
              <option value="verdict">by verdict</option>
              <option value="-bytes">largest first</option>
            </select>
          </div>
          <select v-if="tag || (state.tags || []).length" v-model="tag" id="tag" aria-label="Tag">
            <option value="">every tag</option>
            <option v-if="tag && !state.tags?.includes(tag)" :value="tag">{{ tag }}</option>
            <option v-for="t in state.tags" :key="t" :value="t">{{ t }}</option>
          </select>
          <div v-if="picking" class="panel pad stack small" role="region" aria-label="Selected captures">
            <div class="line wrap">
              <strong>{{ say('{count} selected', { count: picked.length }) }}</strong>
              <button class="b quiet" @click="pickAll">All of this page</button>
              <button class="b quiet" @click="picked = []">None</button>
            </div>
            <div class="line wrap">
              <button class="b" id="bulk-reconstruct" :disabled="!picked.length || !!busy"
                @click="bulk('reconstruct', '', { method, model, template })">Reconstruct</button>
              <select aria-label="Move to a session" id="bulk-move" :disabled="!picked.length || !!busy"
                @change="bulk('move', $event.target.value === 'none' ? '' : $event.target.value);
                  $event.target.value = ''">
                <option value="">Move to ...</option>
                <option value="none">no session</option>
                <option v-for="s in sessions" :key="s.id" :value="s.id">{{ name(s) }}</option>
              </select>
              <button class="b" id="bulk-remove" :disabled="!picked.length || !!busy"
                @click="bulk('remove')">Remove the pictures</button>
              <button class="b danger" id="bulk-erase" :disabled="!picked.length || !!busy"
                @click="sure = true">Erase ...</button>
            </div>
            <form class="line" aria-label="Tags of the selected captures"
              @submit.prevent="bulk('tag', '', { tags: tagging })">
              <input v-model="tagging" id="tagging" class="grow" maxlength="500" list="known-tags"
                placeholder="tag, tag" aria-label="Tags, with commas between">
              <button class="b" id="bulk-tag" :disabled="!picked.length || !tagging.trim() || !!busy">Tag</button>
              <button type="button" class="b quiet" id="bulk-untag"
                :disabled="!picked.length || !tagging.trim() || !!busy"
                @click="bulk('untag', '', { tags: tagging })">Untag</button>
            </form>
            <div v-if="sure && picked.length" class="stack" style="gap: .4rem" role="alertdialog"
              aria-label="Erase the selected captures">
              <p
                class="warn">{{ say('Erase {count} capture with pictures, heads, jobs and every record of them? It cannot be taken back. | Erase {count} captures with pictures, heads, jobs and every record of them? It cannot be taken back.',
                  { count: picked.length }) }}</p>
              <div class="line">
                <button class="b danger" id="bulk-erase-for-good" :disabled="!!busy"
                  @click="bulk('erase')">Erase for good</button>
                <button class="b quiet" @click="sure = false">Keep</button>
              </div>
            </div>
          </div>
          <div class="panel scroll grow" tabindex="0" role="region" aria-label="List of captures" data-scroll="captures"
            @keydown="walk">
            <div v-for="c in captures" :key="c.id" class="row-line">
              <input v-if="picking" type="checkbox" :value="c.id" v-model="picked"
                :aria-label="say('Select {name}', { name: c.label || clock(c.created) })">
            <button class="row-button" :data-capture="c.id" :aria-current="current && c.id === current.id"
              @click="choose(c.id)">
              <span class="line">
                <strong class="cut grow">{{ c.label || clock(c.created) }}</strong>
                <span v-if="c.verdict && c.verdict !== 'good'" class="tag"
                  :class="verdictTag(c).kind">{{ verdictTag(c).text }}</span>
                <span v-if="tags(c).length === 1" class="tag" :class="tags(c)[0].kind">{{ tags(c)[0].text }}</span>
              </span>
              <span v-if="tags(c).length > 1" class="line wrap" style="gap: .3rem">
                <span v-for="t in tags(c)" :key="t.text" class="tag" :class="t.kind">{{ t.text }}</span>
              </span>
              <span class="small muted">
                <template v-if="c.label">{{ clock(c.created) }} &middot;
                  </template>{{ say(c.source === 'rig' ? 'rig' : 'upload') }} &middot;
                  <template v-if="c.frames">{{ say('film of {count} frames', { count: c.frames }) }} &middot;
                  </template>{{ say('{count} camera | {count} cameras', { count: c.cameras.length }) }} &middot;
                  {{ size(c.bytes) }}</span>
              <span v-if="c.session || c.expression || c.features || c.tags.length"
                class="small muted cut">{{ [name(sessions.find(s => s.id === c.session)), c.expression,
                  c.tags.map(t => '#' + t).join(' '),
                  c.features && say('features picked')].filter(Boolean).join(' · ') }}</span>
            </button></div>
            <pager :behind="behind.length" :next="state.next" :size="captures.length" :total="state.total" @back="back"
              @forward="forward"></pager>
          </div>
        </div>
        <div class="panel pad scroll" style="position: relative" tabindex="0" role="region" aria-label="Pictures">
          <div v-if="!state.loading && !current" class="empty" style="height: 100%; align-content: center">
            <h2>{{ say(narrowed ? 'No capture matches' : open ? 'No captures in this session yet'
              : 'No captures yet') }}</h2>
            <p v-if="narrowed">Nothing here bears all of what is sought and chosen at the left.</p>
            <p
              v-else>Take one with the rig, or drop an archive of images, clean plates and cameras.json anywhere on this
                page.</p>
            <div class="line wrap" style="justify-content: center">
              <button v-if="narrowed" class="b main-action" id="seek-all" @click="seekAll">Show all captures</button>
              <a v-else class="b main-action" href="/">Go to the rig</a>
              <button v-if="!narrowed && !open" class="b" id="sample" :disabled="!!busy" @click="act('sample',
                '')">{{ say(busy === 'sample' ? 'Drawing the studio ...' : 'Try a sample capture') }}</button>
            </div>
          </div>
          <div v-if="removal && current && removal.id === current.id" class="panel pad stack small" role="alertdialog"
            aria-label="Remove the capture" id="removal" style="border-color: var(--warn); margin-bottom: .7rem">
            <p>
              <strong>Remove</strong>
                {{ say('takes the {count} picture with clean plates and caches ({size}); it can be taken back for 10 s. | takes the {count} pictures with clean plates and caches ({size}); it can be taken back for 10 s.',
                  { count: removal.pictures, size: size(removal.bytes) }) }}
                <strong
                v-if="removal.heads.length"
                class="warn">{{ say('{count} head ({size}) with photographs of the face in the overlays would stay. | {count} heads ({size}) with photographs of the face in the overlays would stay.',
                  { count: removal.heads.length, size: size(removal.head_bytes) }) }}</strong>
              <span v-else>No head was made of it.</span>
            </p>
            <p>
              <strong>Erase for good</strong>
                {{ say('takes {things} and every record of them. It cannot be taken back.',
                  { things: [say('the pictures'),
                    removal.heads.length && say('the head | all {count} heads', { count: removal.heads.length }),
                    removal.jobs.length && say('all other jobs')].filter(Boolean).join(', ') }) }}</p>
            <div class="line wrap">
              <button class="b" id="keep-capture" @click="removal = null">Keep</button>
              <button class="b" id="remove-pictures" :disabled="!!busy || removal.active.length > 0"
                :title="removal.active.length ? say('Jobs that are queued or running need it') : ''"
                @click="act('remove', current.id); removal = null">Remove the pictures</button>
              <button class="b danger" id="erase-capture" :disabled="!!busy"
                @click="act('erase_capture', current.id); removal = null">Erase for good</button>
            </div>
          </div>
          <form v-if="current && large === null" class="line wrap" style="align-items: end; margin-bottom: .7rem"
            aria-label="About the capture" @submit.prevent @focusin="writing = true" @focusout="writing = false"
            @input="keepDraft('capture draft', { ...draft, id: current.id })"
            @change="keepDraft('capture draft', null)">
            <label class="field grow">Label<input v-model="draft.label" maxlength="500"
              :placeholder="clock(current.created)" @change="act('edit', current.id, { label: draft.label })">
            </label>
            <label class="field grow">Expression<input v-model="draft.expression" maxlength="500"
              placeholder="neutral, smile ..." @change="act('edit', current.id, { expression: draft.expression })">
            </label>
            <label class="field grow">Tags<input v-model="draft.tags" id="tags" maxlength="1000" list="known-tags"
              placeholder="tag, tag" @change="act('edit', current.id, { tags: draft.tags })">
            </label>
            <datalist id="known-tags"><option v-for="t in state.tags" :key="t" :value="t"></option></datalist>
            <label class="field">Session<select v-model="draft.session" style="max-width: 11rem"
              @change="act('edit', current.id, { session: draft.session || null })">
                <option value="">none</option>
                <option v-for="s in sessions" :key="s.id" :value="s.id">{{ name(s) }}</option>
              </select>
            </label>
            <label v-if="!current.frames" class="field" :title="say(preset?.explanation)">Settings<select
              v-model="method" id="method" aria-describedby="preset">
                <option v-for="p in state.presets" :key="p.id" :value="p.id">{{ say(p.title) }}</option>
              </select>
            </label>
            <label v-if="models.length > 1" class="field">Model<select v-model="model" id="model">
                <option value="">default</option>
                <option v-for="m in models.filter(m => m !== 'default')" :key="m">{{ m }}</option>
              </select>
            </label>
            <label v-if="templates.length && !current.frames" class="field"
              title="Write the head in the vertex order of this mesh, too">Template<select v-model="template"
              id="template">
                <option value="">none</option>
                <option v-for="t in templates" :key="t">{{ t }}</option>
              </select>
            </label>
          </form>
          <p v-if="current && large === null && current.kind === 'shot' && preset" id="preset" class="small muted"
            style="margin-bottom: .7rem">{{ say(preset.explanation) }}</p>
          <p v-if="current && large === null && current.jobs.length" class="line wrap small" id="jobs-of-capture"
            style="margin-bottom: .7rem">
            <span class="muted">Jobs</span>
            <a v-for="j in current.jobs.slice(0, 12)" :key="j.id" class="tag" :class="jobKind(j)"
              :href="j.state === 'succeeded' && !current.frames ? '/result/' + j.id : '/jobs?job=' + j.id">{{
                say(j.state !== 'succeeded' ? j.state : current.frames ? 'tracked' : 'head') }}
                {{ j.progress === null ? j.id.slice(-6) : Math.round(100 * j.progress) + ' %' }}</a>
            <a v-if="current.jobs.length > 12"
              :href="'/jobs?find=' + current.id">{{ say('all {count}', { count: current.jobs.length }) }}</a>
          </p>
          <verdict v-if="current && large === null && current.kind === 'shot'" :capture="current"
            style="margin-bottom: .7rem"></verdict>
          <p v-if="current && large === null && facesTold(current.id)" class="small muted" role="status" id="faces-told"
            style="margin-bottom: .7rem">{{ facesTold(current.id) }}</p>
          <div v-if="current && large === null" class="thumbs four">
            <button v-for="(camera, i) in current.cameras" :key="current.id + camera" class="thumb"
              style="padding: 0; border: 0; cursor: zoom-in"
              :style="{ aspectRatio: current.size.width + ' / ' + current.size.height }"
              :aria-label="say('Enlarge {name}', { name: camera })" @click="large = i">
              <img :src="address(camera, '.jpg')" :alt="say('Picture of {name}', { name: camera })" loading="lazy">
              <img v-if="outlines && current.kind === 'shot'" alt="" @error="failed"
                :src="address(camera, '.silhouette.png')">
              <outline v-else :view="view(current.id, camera)" :size="current.sizes[camera]"></outline>
              <face-marks :faces="facesIn(current.id, camera)" :size="current.sizes[camera]"></face-marks>
              <span>{{ camera }}{{ camera === current.front ? ' · ' + say('front') : '' }} <b
                v-if="faultsOf(current, camera).length" class="warn">{{ faultsOf(current, camera).join(', ') }}</b>
                <small v-else class="muted">{{ measures(current.id, camera) }}</small>
              </span>
            </button>
          </div>
          <div v-else-if="current"
            style="height: 100%; display: grid; grid-template-rows: auto minmax(0, 1fr); gap: .6rem">
            <div class="line">
              <strong>{{ current.cameras[large] }}</strong>
              <span class="push group">
                <button class="b" @click="step(-1)" aria-label="Previous camera">&larr;</button>
                <button class="b" @click="step(1)" aria-label="Next camera">&rarr;</button>
              </span>
              <button class="b" @click="large = null">All cameras <kbd>Esc</kbd></button>
            </div>
            <div class="thumb" style="aspect-ratio: auto">
              <img :src="address(current.cameras[large], '.image')"
                :alt="say('Picture of {name}', { name: current.cameras[large] })">
              <img v-if="outlines && current.kind === 'shot'" alt=""
                :src="address(current.cameras[large], '.silhouette.png')">
              <face-marks :faces="facesIn(current.id, current.cameras[large])"
                :size="current.sizes[current.cameras[large]]"></face-marks>
            </div>
          </div>
        </div>
      </div>
    </section>`,
  created() {
    Object.assign(this, { clock, size, keepDraft, faultsOf, verdictTag });
  },
  mounted() {
    window.addEventListener("keydown", this.key);
  },
  unmounted() {
    window.removeEventListener("keydown", this.key);
  },
  methods: {
    address(camera, kind) {
      return `/console/captures/${this.current.id}/${encodeURIComponent(camera)}${kind}`;
    },
    async askRemoval() {
      const id = this.current.id,
        answer = await fetch(`/console/captures/${id}/holdings`);
      if (answer.ok) this.removal = { id, ...(await answer.json()) };
    },
    act(name, id, more) {
      this.busy = name;
      this.removal = null;
      this.$emit("act", { name, id, ...more });
    },
    acted(name, done) {
      this.busy = "";
      if (name === "new_session" && done) this.form = null;
      if (name === "bulk") {
        this.sure = false;
        if (done) this.tagging = "";
        this.picked = this.picked.filter((id) => this.captures.some((c) => c.id === id));
      }
    },
    seekAll() {
      this.sought = this.verdict = this.tag = "";
    },
    async openForm() {
      this.form = { label: "", consent: "" };
      await this.$nextTick();
      this.$refs.subject.focus();
    },
    fields() {
      return { capture: this.current?.id, find: this.sought, verdict: this.verdict, tag: this.tag, sort: this.sort };
    },
    question() {
      return { ...this.fields(), capture: this.chosen, session: this.session, after: this.behind.at(-1) || "" };
    },
    bulk(action, id, more) {
      this.busy = "bulk";
      this.$emit("act", { name: "bulk", action, id: id || "", ids: [...this.picked], ...more });
    },
    name(session) {
      return sessionName(session, this.sessions);
    },
    count(id) {
      return this.sessions.find((s) => s.id === id)?.captures || 0;
    },
    begin() {
      this.begun = { label: this.form.label, known: this.sessions.map((s) => s.id) };
      this.act("new_session", "", this.form);
    },
    tags(c) {
      // all its jobs: heads, what is under way, what failed
      const of = (state) => c.jobs.filter((j) => j.state === state),
        heads = of("succeeded").length,
        running = of("running"),
        failed = of("failed").length;
      const told = [
        running.length && { text: `${Math.round(100 * (running[0].progress || 0))} %`, kind: "accent" },
        of("queued").length && { text: say("queued | {count} queued", { count: of("queued").length }), kind: "" },
        heads && { text: c.frames ? say("tracked") : say("head | {count} heads", { count: heads }), kind: "good" },
        failed && { text: say("failed | {count} failed", { count: failed }), kind: "fault" },
      ].filter(Boolean);
      return told.length ? told : [{ text: say(c.jobs.length ? "cancelled" : "new"), kind: "" }];
    },
    jobKind(j) {
      return { succeeded: "good", running: "accent", failed: "fault" }[j.state] || "";
    },
    failed() {
      if (this.outlines) {
        this.outlines = false;
        window.eigenheadSay(
          "fault",
          "No silhouettes: a camera of this capture has neither a usable clean plate nor a mask.",
        );
      }
    },
    step(by) {
      this.large = (this.large + by + this.current.cameras.length) % this.current.cameras.length;
    },
    key(event) {
      if (typing(event)) return;
      if (event.key === "Escape" && (this.removal || this.erasing || this.sure)) {
        this.removal = null;
        this.erasing = this.sure = false;
      } else if (this.large === null) return;
      else if (event.key === "Escape") this.large = null;
      else if (event.key === "ArrowLeft") this.step(-1);
      else if (event.key === "ArrowRight") this.step(1);
    },
    drop(event) {
      this.over = false;
      this.take(event.dataTransfer.files);
    },
    async take(files) {
      for (const file of files) {
        const entry = {
          id: Math.random(),
          name: file.name,
          share: 0,
          state: "0 %",
          done: false,
          detail: "",
          errors: [],
        };
        this.uploads = [entry, ...this.uploads];
        const mine = this.uploads[0];
        const { status, document } = await send(
          "/console/captures",
          file,
          {
            label: file.name.replace(/\.(zip|tar|tgz|tar\.gz)$/, ""),
            tags: this.labels,
            ...(this.open ? { session: this.open.id } : {}),
          },
          (share) => {
            mine.share = share;
            mine.state = share < 1 ? `${Math.round(100 * share)} %` : "checking";
          },
        );
        mine.done = true;
        if (status === 201) {
          this.choose(document.id);
          this.uploads = this.uploads.filter((u) => u.id !== mine.id);
          window.eigenheadSay("done", say("{name} is here.", { name: file.name }));
        } else {
          mine.state = "refused";
          mine.detail = told(document);
          mine.errors = toldFaults(document).filter((fault) => english(fault) !== document.detail);
        }
      }
    },
  },
});
