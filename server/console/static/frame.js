// Navigation, the service's state, messages in the corner, and the keys that work on every page.
import { LANGUAGES, language, say, speak, spoken } from "/console/static/language.js";
import { english } from "/console/static/messages.js";
import { started } from "/console/static/started.js";
import { Tour } from "/console/static/tour.js";
import { typing } from "/console/static/words.js";

const MESSAGE_MS = 6000;
const MESSAGES_MOST = 4;
const SCROLL_BACK_MS = 3000;

export default spoken({
  mixins: [started],
  components: { Tour },
  props: { links: Array, current: String, status: Object, removed: Array, followed: Array },
  emits: ["undo", "follow"],
  data: () => ({ messages: [], next: 1, help: false, look: document.documentElement.dataset.look, lost: false }),
  watch: {
    look(look) {
      document.documentElement.dataset.look = look;
      localStorage.setItem("eigenhead-look", look);
    },
  },
  computed: {
    known() {
      return !!this.status && "jobs" in this.status;
    },
    starting() {
      return (this.status?.starting || []).map((name) => this.part(name));
    },
    faults() {
      return Object.entries(this.status?.faults || {});
    },
  },
  template: `
    <div class="frame">
      <nav class="rail" aria-label="Pages">
        <div class="brand">
          <i v-if="faults.length" class="dot warn alarm"></i>
          <svg viewBox="0 0 32 32" aria-hidden="true">
            <path
              d="M16 4c-5.4 0-9 4-9 9.3 0 3.2.6 5.2 1.8 7.700C10.2 24 12.7 28 16 28s5.8-4 7.2-7c1.2-2.5 1.8-4.5 1.8-7.700C25 8 21.4 4 16 4z"
              fill="none" stroke="currentColor" stroke-width="1.8"/>
            <path d="M16 4v24M7.5 14h17" stroke="var(--accent)" stroke-width="1.8"/>
          </svg>eigenhead</div>
        <a v-for="(link, i) in links" :key="link.name" :href="link.path"
          :aria-current="link.name === current ? 'page' : null">
          <span>{{ say(link.title) }}</span><kbd v-if="current !== 'features'" aria-hidden="true">{{ i + 1 }}</kbd></a>
        <div class="foot" role="status">
          <div class="line">
            <i
              :class="['dot', lost || faults.length ? 'warn' : starting.length || !known ? '' : 'good']"></i>{{ lost
                ? say('Connection lost.') : starting.length && known && !faults.length
                ? say('Starting: {parts}', { parts: starting.join(', ') })
                : say(!known ? 'Connecting ...' : faults.length ? 'Needs a look' : 'Ready') }}</div>
          <div v-for="[name, detail] in faults" :key="name" class="warn">{{ part(name) }}: {{ say(detail) }}</div>
          <div>{{ say('{count} job under way | {count} jobs under way', { count: status.jobs || 0 }) }}</div>
          <div>{{ say(status.disk) || '\\u00a0' }}</div>
          <a v-if="status.local === false" href="/sign-in" style="padding: 0">Other API key</a>
          <button class="b quiet small" id="sound" style="padding-left: 0; justify-self: start"
            title="A quiet sound when a head that was begun in this tab is ready" :aria-pressed="sound"
            @click="turnSound">{{ say(sound ? 'Sound on' : 'Sound off') }}</button>
          <div class="line">
            <button class="b quiet small" id="keys" style="padding-left: 0" :aria-expanded="help" @click="help = !help">
              <kbd>?</kbd> keys</button>
            <button class="b quiet small push" id="look" :aria-pressed="look === 'light'"
              @click="turn">{{ look === 'light' ? say('Dark') : say('Light', { context: 'look' }) }}</button>
          </div>
          <button v-for="(name, tag) in otherLanguages" :key="tag" class="b quiet small language" :lang="tag"
            style="padding-left: 0; justify-self: start" @click="speak(tag)">{{ name }}</button>
        </div>
      </nav>
      <div class="main"><slot></slot></div>
      <div class="messages" role="log" aria-live="polite" aria-label="Messages">
        <div v-for="r in removed" :key="r.id" class="message line">
          <span class="grow">{{ say('Removed: {thing}', { thing: say(r.title) }) }}</span>
          <button class="b" @click="$emit('undo', r.id)">Undo</button>
        </div>
        <div v-for="m in messages" :key="m.id" :class="['message', m.kind]">
          <div class="grow"><div>{{ m.text }} <a v-if="m.link" :href="m.link">Open it</a></div>
            <ul v-if="m.faults.length" class="faults small muted">
              <li v-for="(f, i) in m.faults" :key="i">{{ f }}</li>
            </ul>
          </div>
          <button class="b quiet" aria-label="Close message" @click="drop(m.id)">&times;</button>
        </div>
      </div>
      <tour v-if="known" ref="tour" :links="links" :current="current" :empty="!!status.empty"></tour>
      <div v-if="help" class="keys" role="dialog" aria-label="Keys" @click="help = false">
        <div class="panel pad stack"><h2>Keys</h2>
          <table>
            <tbody>
              <tr v-for="[k, what] in keys" :key="k"><td><kbd>{{ say(k) }}</kbd></td><td>{{ say(what) }}</td></tr>
            </tbody>
          </table>
          <div v-if="known" class="line">
            <button class="b" id="tour-again" @click="$refs.tour.again()">Show the tour</button>
          </div>
        </div>
      </div>
    </div>`,
  created() {
    this.speak = speak;
    this.otherLanguages = Object.fromEntries(Object.entries(LANGUAGES).filter(([tag]) => tag !== language));
    this.keys = [
      ["1 - 9", "go to a page"],
      ["Space", "Rig: capture"],
      ["B", "Rig: clean plates"],
      ["K R Enter", "Rig, after a shot: keep, retake, reconstruct"],
      ["H", "Rig: open the head that is ready"],
      ["Esc", "stop a countdown, close"],
      ["1 - 7", "Features: choose a point"],
      ["Arrows", "Features: move it by 0.25 px (Shift: 2 px)"],
      ["Tab", "Features: next view"],
      ["Enter", "Features: take the suggested place"],
      ["Del", "Features: take the point back"],
      ["S", "Features: save"],
      ["H B", "Result: head, bust"],
      ["T G U P", "Result: texture, clay, uncertainty, parts"],
      ["W M", "Result: wireframe, measure"],
      ["V F", "Result: next view, full screen"],
      ["?", "this list"],
    ];
    window.eigenheadSay = (kind, text, faults) => this.announce(kind, text, faults || []);
  },
  mounted() {
    window.addEventListener("keydown", this.key);
    document.addEventListener("scroll", this.scrolled, true);
    this.scrollBack();
    this.translatePopups();
    setTimeout(() => {
      // the page's root, mounted after this, makes the socket
      for (const [event, lost] of [
        ["disconnect", true],
        ["connect", false],
      ])
        window.socket?.on(event, () => {
          this.lost = lost;
        });
    });
    this.$el.querySelector(".rail [aria-current]")?.scrollIntoView({ block: "nearest", inline: "center" });
  },
  unmounted() {
    window.removeEventListener("keydown", this.key);
    document.removeEventListener("scroll", this.scrolled, true);
    clearInterval(this.scrolling);
  },
  methods: {
    announce(kind, text, faults, link) {
      const id = this.next++,
        further = faults.filter((fault) => !english(text).includes(english(fault))).map((fault) => say(fault));
      this.messages = [...this.messages, { id, kind, text: say(text), link, faults: further }].slice(-MESSAGES_MOST);
      // What went wrong stays until it was read.
      if (kind === "done" && !link) setTimeout(() => this.drop(id), MESSAGE_MS);
    },
    part(name) {
      return say(name === "egl" ? "graphics" : name);
    },
    turn() {
      this.look = this.look === "light" ? "dark" : "light";
    },
    translatePopups() {
      document.querySelectorAll(".nicegui-error-popup span").forEach((words) => {
        words.textContent = say(words.textContent);
      });
    }, // NiceGUI's own
    place(name) {
      return `eigenhead scroll ${location.pathname} ${name}`;
    },
    scrolled(event) {
      const name = event.target.dataset?.scroll;
      if (name && !this.scrolling) sessionStorage.setItem(this.place(name), event.target.scrollTop);
    },
    scrollBack() {
      // to where the lists were before a reload, as soon as they are long enough again
      const began = Date.now(),
        wanted = (list) => Number(sessionStorage.getItem(this.place(list.dataset.scroll)) || 0);
      this.scrolling = setInterval(() => {
        const lists = [...document.querySelectorAll("[data-scroll]")],
          back = lists.filter((list) => list.scrollHeight - list.clientHeight >= wanted(list));
        back.forEach((list) => {
          list.scrollTop = wanted(list);
        });
        if ((lists.length && back.length === lists.length) || Date.now() - began > SCROLL_BACK_MS) {
          clearInterval(this.scrolling);
          this.scrolling = 0;
        }
      }, 100);
    },
    drop(id) {
      this.messages = this.messages.filter((m) => m.id !== id);
    },
    key(event) {
      if (typing(event)) return;
      if (event.key === "?") this.help = !this.help;
      else if (event.key === "Escape") this.help = false;
      else if (/^[1-9]$/.test(event.key) && !document.querySelector(`[data-digits~="${event.key}"]`))
        window.location.href = this.links[event.key - 1].path;
    },
  },
});
