// A tour of four steps through an empty service, from page to page. Who skips or ends it in this browser is not shown it
// again, unless they ask for it among the keys.
import { spoken } from "/console/static/language.js";

const KEPT = "eigenhead-tour",
  OVER = "over";
const STEPS = [
  {
    name: "rig",
    title: "Take a shot",
    text: "The live view tells of every camera whether it is exposed, sharp and calibrated. Seat the subject and press the space bar: one picture of each camera after three seconds. A real rig wants clean plates of the empty studio first.",
  },
  {
    name: "captures",
    title: "Judge it",
    text: "Every shot has a verdict: good, usable or poor, with what to do about it. Keep it, retake it, or reconstruct it. Archives of pictures are dropped here, and an empty service offers a sample capture.",
  },
  {
    name: "jobs",
    title: "Wait for the head",
    text: "Reconstruct makes a job. Its step and the time that is left stand here, and the head opens by itself where it was begun.",
  },
  {
    name: "result",
    title: "Look at the head",
    text: "Turn it, look through the cameras, measure it, compare it with another, fetch its files. On the page Captures everything of a person is erased for good.",
  },
];

export const Tour = spoken({
  props: { links: Array, current: String, empty: Boolean },
  data: () => ({ kept: localStorage.getItem(KEPT) || "" }),
  computed: {
    at() {
      return STEPS.findIndex((step) => step.name === (this.kept || "rig"));
    },
    step() {
      return this.kept === OVER || (!this.kept && !this.empty) || this.at < 0 || STEPS[this.at].name !== this.current
        ? null
        : STEPS[this.at];
    },
    count: () => STEPS.length,
    last() {
      return this.at === STEPS.length - 1;
    },
  },
  template: `
    <aside v-if="step" class="panel pad stack tour" aria-label="Tour" :data-step="at + 1">
      <div class="line">
        <h2 class="grow">{{ say(step.title) }}</h2>
        <span class="small muted">{{ at + 1 }} / {{ count }}</span>
      </div>
      <p class="small">{{ say(step.text) }}</p>
      <div class="line">
        <button class="b main-action" id="tour-next" @click="go(at + 1)">{{ say(last ? 'Begin' : 'Next') }}</button>
        <button v-if="at" class="b" @click="go(at - 1)">Back</button>
        <button class="b quiet push" id="tour-skip" @click="end">Skip the tour</button>
      </div>
    </aside>`,
  methods: {
    end() {
      this.kept = OVER;
      localStorage.setItem(KEPT, OVER);
    },
    go(to) {
      const step = STEPS[to];
      if (step) localStorage.setItem(KEPT, step.name);
      else this.end();
      location.href = this.links.find((link) => link.name === (step || STEPS[0]).name).path;
    },
    again() {
      localStorage.setItem(KEPT, STEPS[0].name);
      location.href = this.links[0].path;
    },
  },
});
