// API keys at the left; retention and storage at the right.
import { say, spoken } from "/console/static/language.js";
import { clock, size } from "/console/static/words.js";

const MAY = {
  read: "look and fetch",
  capture: "capture, upload, calibrate",
  submit: "start and end jobs",
  erase: "erase captures with their heads",
  admin: "everything, keys and storage too",
};
const HOLDS = {
  captures: "photographs and clean plates",
  results: "heads with their overlays, logs of jobs",
  caches: "silhouettes and thumbnails, made anew when asked for",
  calibrations: "board pictures and reports",
  unfinished: "uploads under way and what is being removed",
  "set aside": "damaged records, for a person to look at",
  rig: "clean plates and the rig's calibration",
  other: "the database, models, sign-ins",
};

export default spoken({
  props: { state: Object },
  emits: ["act", "choose"],
  data: () => ({ form: null, secret: "", copied: false, revoking: "", busy: "", clearing: false }),
  computed: {
    keys() {
      return this.state.keys || [];
    },
    kinds() {
      return this.state.storage?.kinds || [];
    },
    held() {
      return this.kinds.reduce((sum, kind) => sum + kind.bytes, 0);
    },
    most() {
      return Math.max(1, ...this.kinds.map((kind) => kind.bytes));
    },
    kept() {
      return this.state.retention || [];
    },
  },
  template: `
    <section class="page" aria-label="Service">
      <header>
        <h1>Service</h1>
        <span class="lead">{{ say(state.loading ? 'Reading' : state.open
          ? 'Open to whoever sits at this machine: no key exists' : state.admin
          ? 'Signed in with a key of the scope admin' : 'Keys and storage need a key of the scope admin') }}</span>
      </header>
      <div v-if="secret" class="panel pad stack" role="alertdialog" aria-label="The new key" id="secret"
        style="border-color: var(--warn); flex: none">
        <p>
          <strong
            class="warn">This key is shown this once.</strong> The service keeps its hash alone: put it where you keep
              passwords.</p>
        <div class="line wrap">
          <input :value="secret" readonly ref="secret" aria-label="The key" class="mono grow"
            @focus="$event.target.select()">
          <button class="b" @click="copy">{{ say(copied ? 'Copied' : 'Copy') }}</button>
          <button class="b main-action" @click="secret = ''; copied = false">I have it</button>
        </div>
      </div>
      <div v-if="!state.loading" class="columns wide" style="grid-template-columns: minmax(0, 1fr) minmax(0, 1fr)">
        <div class="panel pad scroll stack" tabindex="0" role="region" aria-label="API keys">
          <div class="line">
            <h2 class="grow">API keys</h2>
            <button v-if="state.admin && !state.open" class="b main-action" id="new-key"
              @click="form = { label: '', scopes: ['read'] }">New key</button>
          </div>
          <p v-if="state.open" class="small warn">Without keys nobody but the people at this machine reaches the
            service. The first key is made by eigenhead keys add NAME at the machine; it closes the service to whoever
            has none, in the browser, too.</p>
          <p v-else-if="!state.admin" class="small muted">Your key has no scope admin. Sign in with one that has, or use
            <code>eigenhead keys</code> at the machine.</p>
          <form v-if="form" class="panel pad stack" style="background: var(--raised)" aria-label="New key"
            @submit.prevent="act('add_key', form)">
            <label class="field">Name<input v-model="form.label" id="key-name" maxlength="200" required
              placeholder="who or what uses it">
            </label>
            <fieldset class="stack" style="gap: .3rem">
              <legend class="small muted">May</legend>
              <label v-for="s in state.scopes" :key="s" class="check small">
                <input type="checkbox" :value="s" v-model="form.scopes">
                <span><strong>{{ s }}</strong> {{ say(may[s]) }}</span>
              </label>
            </fieldset>
            <div class="line wrap">
              <button class="b main-action" :disabled="!!busy">Make the key</button>
              <button type="button" class="b quiet" @click="form = null">Cancel</button>
            </div>
          </form>
          <table v-if="keys.length" class="small">
            <thead><tr><th>Name</th><th>May</th><th>Made</th><th><span class="unseen">Revoke</span></th></tr></thead>
            <tbody>
              <tr v-for="k in keys" :key="k.id" :data-key="k.id">
                <td><strong>{{ k.name }}</strong> <span class="muted mono">{{ k.id }}</span></td>
                <td>{{ k.scopes.join(', ') }}</td>
                <td class="muted">{{ clock(k.created) }}</td>
              <td class="num">
                <span v-if="k.is_yours" class="muted">yours</span>
                <button v-else-if="revoking !== k.id" class="b quiet"
                  :aria-label="say('Revoke {name}', { name: k.name })" @click="revoking = k.id">Revoke ...</button>
                <span v-else class="line wrap" role="alertdialog" :aria-label="say('Revoke {name}', { name: k.name })">
                  <button class="b danger" :disabled="!!busy"
                    @click="act('revoke', { id: k.id })">Revoke for good</button>
                  <button class="b quiet" @click="revoking = ''">Keep</button>
                </span>
              </td>
            </tr>
          </tbody>
        </table>
          <p v-else-if="state.admin && !state.open" class="small muted">No keys.</p>
        </div>
        <div class="panel pad scroll stack" tabindex="0" role="region" aria-label="Retention and storage">
          <div class="line">
            <h2 class="grow">Storage</h2>
            <button class="b quiet" id="count" :disabled="!!busy" @click="act('count')">Count again</button>
          </div>
          <p class="small" id="disk">{{ say('{free} free of {total}',
            { free: size(state.storage.free), total: size(state.storage.total) }) }}<span
            class="muted">{{ say('; uploads and jobs leave {spare}.', { spare: size(state.storage.spare) }) }} <span
            class="mono">{{ state.storage.data }}</span>
            </span>
          </p>
          <p v-if="!kinds.length" class="small muted" role="status">Looking through the data folder ...</p>
          <table v-else class="small" aria-label="Bytes by kind">
            <tbody>
              <tr v-for="k in kinds" :key="k.kind">
                <td style="width: 40%">{{ say(k.kind, { context: 'kind' }) }}<br>
                  <span class="muted">{{ say(holds[k.kind]) }}</span>
                </td>
                <td style="width: 32%">
                  <div class="bar" aria-hidden="true"><i :style="{ width: 100 * k.bytes / most + '%' }"></i></div>
                </td>
                <td class="num">{{ size(k.bytes) }}</td>
                <td class="num muted">{{ k.things }}</td>
              </tr>
            <tr>
              <td><strong>together</strong></td>
              <td></td>
              <td class="num"><strong>{{ size(held) }}</strong></td>
              <td></td>
            </tr>
          </tbody>
        </table>
          <h3>What can go</h3>
          <div class="line wrap">
            <a class="b" href="/captures?sort=-bytes">Largest captures</a>
            <button class="b" id="clear" :disabled="!state.admin || !!busy"
              title="Silhouettes and thumbnails; they are made anew when asked for"
              @click="act('clear')">Clear caches</button>
            <button class="b" id="remove-failed" :disabled="!state.admin || !!busy || !state.storage.failed"
              title="It can be taken back for 10 s"
              @click="act('remove_failed')">{{ say('Remove {count} failed or cancelled job | Remove {count} failed or cancelled jobs',
                { count: state.storage.failed }) }}</button>
          </div>
          <div class="line" style="margin-top: .5rem">
            <h2 class="grow">Retention</h2>
            <button class="b quiet" id="sweep" :disabled="!state.admin || !!busy"
              title="What is due goes at every sweep anyhow" @click="act('sweep')">Sweep now</button>
          </div>
          <table class="small">
            <tbody>
              <tr v-for="s in kept" :key="s.name">
                <td>{{ say(s.means) }}<br><span class="muted mono">{{ s.variable }}</span></td>
                <td class="num">{{ say(s.value) }}</td>
              </tr>
            </tbody>
          </table>
          <h3>Goes next</h3>
          <p v-if="!state.upcoming.length" class="small muted" id="nothing-goes">Nothing goes by itself: captures and
            heads are kept for ever. Set the variables above where the service is started to change that.</p>
          <table v-else class="small" id="goes-next">
            <tbody>
              <tr v-for="u in state.upcoming" :key="u.id">
                <td>{{ say(u.kind) }}</td>
                <td>
                  <a :href="u.kind === 'job' ? '/jobs?job=' + u.id : '/captures?capture=' + u.id">{{ u.label
                    || u.id.slice(-6) }}</a>
                </td>
                <td class="num">{{ when(u) }}</td>
              </tr>
            </tbody>
          </table>
        </div>
      </div>
    </section>`,
  created() {
    Object.assign(this, { clock, size, may: MAY, holds: HOLDS });
  },
  methods: {
    act(name, more) {
      this.busy = name;
      this.$emit("act", { name, ...more });
    },
    acted(name, done) {
      this.busy = "";
      if (name === "add_key" && done) this.form = null;
      if (name === "revoke") this.revoking = "";
    },
    async show_key(key) {
      this.secret = key;
      await this.$nextTick();
      this.$refs.secret.focus();
    },
    async copy() {
      this.$refs.secret.select();
      try {
        await navigator.clipboard.writeText(this.secret);
        this.copied = true;
      } catch {
        this.copied = document.execCommand("copy");
      } // without https there is no clipboard
    },
    when(u) {
      return u.goes === null
        ? say(u.why === "make_room" ? "when the disk is full" : "when more come")
        : new Date(u.goes) <= new Date()
          ? say("at the next sweep")
          : clock(u.goes);
    },
  },
});
