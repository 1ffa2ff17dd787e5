// What a capture is worth, in words: every fault with its camera and remedy, and the subject's outline in its picture.
import { say, spoken } from "/console/static/language.js";
import { fixed } from "/console/static/words.js";

const WORDS = { good: "Good", usable: "Usable", poor: "Poor" };
const KINDS = { good: "good", usable: "warn", poor: "fault" };
const CODES = {
  moved: "moved",
  overexposed: "burnt out",
  blurred: "out of focus",
  setting: "setting not taken",
  plates: "no clean plates",
  empty: "nobody there",
  "cut-off": "head cut off",
  dark: "dark",
  "lights-off": "lamps off",
  view: "another view",
  swapped: "swapped",
};

// Warnings for which an operator wants another shot, though the pictures as such are good.
const LOOK = ["eyes-closed", "moments-differ", "face-nowhere", "face-missing", "face-turned"];

export function verdictTag(capture) {
  if (capture.verdict === "good" && (capture.warnings || []).some((told) => LOOK.includes(told.code)))
    return { text: say("Look again"), kind: "warn" };
  return capture.verdict
    ? { text: say(WORDS[capture.verdict]), kind: KINDS[capture.verdict] }
    : { text: say("not judged"), kind: "" };
}

// One line a fault; the same fault of several cameras is one line.
function faultLines(faults) {
  const lines = new Map();
  for (const fault of faults || []) {
    const line = lines.get(fault.code) || {
      code: fault.code,
      title: say(CODES[fault.code] || fault.code),
      cameras: [],
      details: [],
      remedy: say({ code: `remedy-${fault.code}`, message: fault.remedy }),
    };
    line.cameras.push(fault.camera || say("all cameras"));
    line.details.push(say(fault.detail_message ?? fault.detail));
    lines.set(fault.code, line);
  }
  return [...lines.values()].map((line) => ({ ...line, details: [...new Set(line.details)] }));
}

export function faultsOf(capture, camera) {
  return (capture.faults || [])
    .filter((fault) => fault.camera === camera || fault.camera === null)
    .map((fault) => say(CODES[fault.code] || fault.code));
}

export const Verdict = spoken({
  props: { capture: Object },
  computed: {
    tag() {
      return verdictTag(this.capture);
    },
    lines() {
      return faultLines(this.capture.faults);
    },
    sentence() {
      const named = new Set((this.capture.faults || []).map((fault) => fault.camera)),
        all = this.capture.cameras.length;
      if (!this.capture.verdict) return say("This capture was made before pictures were judged.");
      if (this.capture.verdict === "good")
        return Object.keys(this.capture.inputs || {}).some((name) => name.startsWith("background/"))
          ? say("All {all} pictures are exposed, sharp and framed, and no camera moved.", { all })
          : say(
              "All {all} pictures are exposed and sharp. Whether a camera moved was not checked: there are no clean plates.",
              { all },
            );
      if (named.has(null)) return say("Something is wrong with all pictures: shoot again.");
      const sound = say("{sound} of {all} cameras are without a fault.", { sound: all - named.size, all });
      return this.capture.verdict === "usable"
        ? `${sound} ${say("Enough for a head; better ones are had by mending what is listed.")}`
        : `${sound} ${say("Too few for a sound head: mend what is listed and shoot again.")}`;
    },
  },
  template: `
    <div class="stack verdict" role="region" aria-label="Verdict" :data-verdict="capture.verdict || 'none'"
      style="gap: .35rem">
      <div class="line wrap">
        <span class="tag" :class="tag.kind">{{ tag.text }}</span>
        <span>{{ sentence }}</span>
        <span v-if="capture.sync" class="muted small push"
          :class="{ warn: !capture.sync.good }">{{ say(capture.sync.message) }}</span>
      </div>
      <ul v-if="lines.length" class="faults small">
        <li v-for="line in lines" :key="line.code" :data-fault="line.code">
          <strong class="warn">{{ line.cameras.join(', ') }}: {{ line.title }}.</strong>
            {{ line.details.slice(0, 3).join('; ') }}{{ line.details.length > 3 ? ' ...' : '' }}.
            <span>{{ say('To do: {remedy}.', { remedy: line.remedy }) }}</span>
        </li>
      </ul>
      <ul v-if="capture.warnings?.length" class="faults small" aria-label="Warnings">
        <li v-for="told in capture.warnings" :key="told.message" :data-warning="told.code"
          class="warn">{{ say(told) }}</li>
      </ul>
    </div>`,
});

export const Outline = {
  props: { view: Object, size: Array },
  computed: {
    points() {
      return (this.view?.subject?.outline || []).map((corner) => corner.join(",")).join(" ");
    },
  },
  template: `
    <svg v-if="points" class="outline" :viewBox="'-0.5 -0.5 ' + size[0] + ' ' + size[1]"
      preserveAspectRatio="xMidYMid meet" aria-hidden="true">
      <polygon :points="points" vector-effect="non-scaling-stroke"></polygon>
    </svg>`,
};

// Keeps checks[id] of captures: a capture's measures never change.
export const checksOf = {
  data: () => ({ checks: {} }),
  methods: {
    async readChecks(id) {
      if (!id || this.checks[id]) return;
      const answer = await fetch(`/console/captures/${id}/checks`);
      if (answer.ok) this.checks[id] = await answer.json();
    },
    view(id, camera) {
      return this.checks[id]?.[camera];
    },
    measures(id, camera) {
      const view = this.view(id, camera);
      if (!view) return "";
      const parts = [
        view.subject && say("subject {share} %", { share: Math.round(100 * view.subject.share) }),
        view.mean !== undefined && say("exp {mean}", { mean: Math.round(view.mean) }),
        view.blur_px !== undefined && view.blur_px !== null && say("blur {blur} px", { blur: fixed(view.blur_px, 1) }),
      ];
      return parts.filter(Boolean).join(" · ");
    },
  },
};
