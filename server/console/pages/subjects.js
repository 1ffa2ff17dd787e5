// People as cards: the newest head, shots, heads; the way to each.
import { say, spoken } from "/console/static/language.js";
import { Pager, paged } from "/console/static/list.js";
import { clock, keepDraft, keepSession, kept } from "/console/static/words.js";

export default spoken({
  mixins: [paged],
  components: { Pager },
  props: { state: Object },
  emits: ["act", "choose"],
  data: () => ({
    sort: new URLSearchParams(location.search).get("sort") || "",
    tag: new URLSearchParams(location.search).get("tag") || "",
    form: kept("subjects form"),
    busy: "",
    plain: {},
  }),
  watch: {
    sort() {
      this.first();
    },
    tag() {
      this.first();
    },
    form: {
      handler(form) {
        keepDraft("subjects form", form);
      },
      deep: true,
    },
  },
  computed: {
    listed() {
      return this.state.subjects || [];
    },
  },
  template: `
    <section class="page" aria-label="Subjects">
      <header class="wraps">
        <h1>Subjects</h1>
        <span class="lead">{{ state.loading ? say('Reading')
          : say('{count} person | {count} people', { count: state.total }) }}</span>
        <input v-model="sought" id="find" type="search" maxlength="200" placeholder="Find: name, consent note, id"
          aria-label="Find subjects" style="width: 15rem">
        <select v-if="tag || (state.tags || []).length" v-model="tag" id="tag" aria-label="Tag">
          <option value="">every tag</option>
          <option v-if="tag && !state.tags?.includes(tag)" :value="tag">{{ tag }}</option>
          <option v-for="t in state.tags" :key="t" :value="t">{{ t }}</option>
        </select>
        <select v-model="sort" id="sort" aria-label="Order">
          <option value="">newest first</option>
          <option value="created">oldest first</option>
          <option value="label">by name</option>
        </select>
        <button class="b main-action" id="new-subject" @click="openForm">New subject</button></header>
      <form v-if="form" class="panel pad line wrap" style="align-items: end" aria-label="New subject"
        @submit.prevent="busy = 'new'; $emit('act', { name: 'new_session', ...form })">
        <label class="field grow">Subject<input ref="subject" v-model="form.label" maxlength="500" required
          placeholder="name or number">
        </label>
        <label class="field grow">Consent<input v-model="form.consent" maxlength="500"
          placeholder="who signed what, when">
        </label>
        <button class="b main-action" :disabled="!!busy">Begin</button>
        <button type="button" class="b quiet" @click="form = null">Cancel</button>
      </form>
      <div class="scroll grow" tabindex="0" role="region" aria-label="People" data-scroll="subjects">
        <div v-if="!state.loading && !listed.length" class="empty">
          <h2>{{ say(sought || tag ? 'Nobody matches' : 'Nobody yet') }}</h2>
          <p>A subject holds one person's shots and heads, so that they are found, compared and erased together.
            Captures without a subject are on the page Captures.</p>
          <a class="b" href="/captures">Go to captures</a>
        </div>
        <div class="cards">
          <article v-for="s in listed" :key="s.id" class="panel card" :data-subject="s.id" :aria-label="title(s)">
          <a v-if="picture(s)" :href="s.head ? '/result/' + s.head : '/captures?session=' + s.id" class="portrait">
            <img :src="picture(s)" :alt="say(s.head ? 'Head of {name}' : 'Picture of {name}', { name: title(s) })"
              loading="lazy" @error="plain[s.id] = true">
          </a>
          <a v-else class="portrait none muted small" :href="'/captures?session=' + s.id">no head yet</a>
          <div class="stack pad" style="gap: .3rem"><h2 class="cut">{{ title(s) }}</h2>
            <p class="small muted">{{ clock(s.created) }} &middot;
              {{ say('{count} shot | {count} shots', { count: s.captures }) }} &middot;
              {{ say('{count} head | {count} heads', { count: s.heads }) }}<template
              v-if="s.sessions.length > 1"> &middot;
                {{ say('{count} session | {count} sessions', { count: s.sessions.length }) }}</template>
            </p>
            <p v-if="s.tags.length" class="line wrap" style="gap: .3rem">
              <button v-for="t in s.tags" :key="t" class="tag"
                style="background: none; font: inherit; font-size: .76rem; cursor: pointer"
                :aria-label="say('Only with the tag {tag}', { tag: t })" @click="tag = t">{{ t }}</button>
            </p>
            <p v-if="!s.consent" class="small warn">no note of consent</p>
            <p v-else class="small muted">consent noted</p>
            <p v-if="s.running"
              class="small accent">{{ say('{count} job under way | {count} jobs under way', { count: s.running }) }}</p>
            <div class="line wrap" style="gap: .3rem">
              <a class="b" :href="'/captures?session=' + s.id" @click="open(s)">Shots</a>
              <a class="b" href="/" @click="open(s)">Shoot</a>
              <a v-if="s.head" class="b push" :href="'/result/' + s.head">Head</a>
            </div>
          </div>
        </article>
      </div>
        <pager :behind="behind.length" :next="state.next" :size="listed.length" :total="state.total" @back="back"
          @forward="forward"></pager>
      </div>
    </section>`,
  created() {
    this.clock = clock;
  },
  methods: {
    async openForm() {
      this.form = { label: "", consent: "" };
      await this.$nextTick();
      this.$refs.subject.focus();
    },
    title(s) {
      return s.label || say("without a name, {time}", { time: clock(s.created) });
    },
    picture(s) {
      return this.plain[s.id]
        ? ""
        : s.head
          ? `/console/jobs/${s.head}/portrait.jpg`
          : s.capture
            ? `/console/captures/${s.capture}/front`
            : "";
    },
    open(s) {
      keepSession(s.id);
    },
    fields() {
      return { find: this.sought, tag: this.tag, sort: this.sort };
    },
    question() {
      return { ...this.fields(), after: this.behind.at(-1) || "" };
    },
    acted(name, done) {
      this.busy = "";
      if (done && name === "new_session") this.form = null;
    },
  },
});
