// A list that the service pages, searches and sorts: what is sought stands in the address, and the arrows walk in it.
// A page that uses it has fields() for the address, question() for the service, and listed, the rows with their ids.
import { spoken } from "/console/static/language.js";
import { keepAddress } from "/console/static/words.js";

const TYPING_MS = 250;

export const Pager = spoken({
  props: { behind: Number, next: String, size: Number, total: Number },
  emits: ["back", "forward"],
  template: `
    <div v-if="behind || next" class="line small pager">
      <button class="b" :disabled="!behind" @click="$emit('back')">Newer page</button>
      <span class="muted grow" style="text-align: center"
        role="status">{{ say('page {number}, {total} in all', { number: behind + 1, total }) }}</span>
      <button class="b" :disabled="!next" @click="$emit('forward')">Next page</button>
    </div>`,
});

export const paged = {
  data: () => ({
    chosen: "",
    sought: new URLSearchParams(location.search).get("find") || "",
    behind: [],
    picking: false,
    picked: [],
  }),
  watch: {
    sought() {
      clearTimeout(this.waiting);
      this.waiting = setTimeout(() => this.first(), TYPING_MS);
    },
  },
  mounted() {
    if (Object.values(this.question()).some(Boolean)) this.$emit("choose", this.question());
  },
  methods: {
    keepAddress() {
      keepAddress(this.fields());
    },
    ask() {
      this.keepAddress();
      this.$emit("choose", this.question());
    },
    first() {
      this.behind = [];
      this.picked = [];
      this.ask();
    },
    forward() {
      if (this.state.next) {
        this.behind = [...this.behind, this.state.next];
        this.ask();
        this.top();
      }
    },
    back() {
      this.behind = this.behind.slice(0, -1);
      this.ask();
      this.top();
    },
    top() {
      this.$el.querySelector("[data-scroll]")?.scrollTo(0, 0);
    },
    choose(id) {
      this.chosen = id;
      this.ask();
    },
    pickMany() {
      this.picking = !this.picking;
      this.picked = [];
    },
    pickAll() {
      this.picked = this.listed.map((one) => one.id);
    },
    walk(event) {
      // arrows go from row to row
      const by = { ArrowDown: 1, ArrowUp: -1 }[event.key],
        rows = [...event.currentTarget.querySelectorAll(".row-button")];
      if (!by || !rows.length) return;
      event.preventDefault();
      const at = rows.indexOf(document.activeElement),
        to = rows[Math.min(rows.length - 1, Math.max(0, at < 0 ? 0 : at + by))];
      to.focus();
      to.click();
      to.scrollIntoView({ block: "nearest" });
    },
  },
};
