// Jobs that were begun in this tab: how far they are stands in the tab's title; a head that is ready opens on the page
// where its job was begun, unless somebody types or decides something there, and is told of everywhere else.
import { say } from "/console/static/language.js";

const KEPT = "eigenhead started",
  OPENED = "eigenhead opened",
  LEFT = "eigenhead left";
const TONES_HZ = [660, 880],
  TONE_S = 0.22,
  LOUDNESS = 0.04;
const BUSY = "[role=dialog], [role=alertdialog], [data-shot], [data-holds]";

const read = () => JSON.parse(sessionStorage.getItem(KEPT) || "[]");
// The newest job that was begun on this page and is not done; a page that was left and comes back shows it again.
export const begunHere = () =>
  read().findLast((job) => job.opens && job.path === location.pathname && job.id !== sessionStorage.getItem(LEFT))?.id;
export const leaveBegun = (id) => sessionStorage.setItem(LEFT, id);
const written = (field) =>
  field.matches?.("textarea, input:not([type=checkbox], [type=radio], [type=range], [type=file])");

function chime() {
  // a browser that lets pages sound only after a click leaves it silent
  const context = new AudioContext(),
    gain = context.createGain();
  gain.gain.value = LOUDNESS;
  gain.connect(context.destination);
  TONES_HZ.forEach((hz, i) => {
    const tone = context.createOscillator();
    tone.frequency.value = hz;
    tone.connect(gain);
    tone.start(context.currentTime + i * TONE_S);
    tone.stop(context.currentTime + (i + 1) * TONE_S);
  });
  setTimeout(() => context.close(), 2000 * TONE_S * TONES_HZ.length);
}

export const started = {
  data: () => ({ mine: read(), typed: [], news: "", sound: localStorage.getItem("eigenhead-sound") !== "off" }),
  watch: {
    mine: {
      handler(jobs) {
        sessionStorage.setItem(KEPT, JSON.stringify(jobs));
        this.$emit(
          "follow",
          jobs.map((job) => job.id),
        );
        this.entitle();
      },
      deep: true,
    },
    followed(jobs) {
      for (const job of jobs) if (!["queued", "running"].includes(job.state)) this.ended(job);
      this.entitle();
    },
    news() {
      this.entitle();
    },
  },
  mounted() {
    document.addEventListener("input", this.note, true);
    document.addEventListener("visibilitychange", this.seen);
    window.addEventListener("pointerdown", this.seen);
    window.addEventListener("keydown", this.seen);
    const opened = sessionStorage.getItem(OPENED);
    if (opened && location.pathname.endsWith(opened)) {
      this.tell();
      this.announce("done", "This head was finished just now.", []);
    }
    sessionStorage.removeItem(OPENED);
    this.entitle();
    if (this.mine.length)
      this.$emit(
        "follow",
        this.mine.map((job) => job.id),
      );
  },
  unmounted() {
    document.removeEventListener("input", this.note, true);
    document.removeEventListener("visibilitychange", this.seen);
    window.removeEventListener("pointerdown", this.seen);
    window.removeEventListener("keydown", this.seen);
  },
  methods: {
    began(jobs, opens) {
      this.typed = []; // what stands in a form since before is sent, or kept for a reload
      this.mine = [...this.mine, ...jobs.map((id) => ({ id, path: location.pathname, opens }))];
    },
    ended({ id, state, frames }) {
      const job = this.mine.find((one) => one.id === id);
      if (!job) return;
      this.mine = this.mine.filter((one) => one.id !== id);
      if (state === "failed") {
        this.tell("Job failed");
        this.announce("fault", say("Job {id} failed.", { id: id.slice(-6) }), [], `/jobs?job=${id}`);
      }
      if (state !== "succeeded") return;
      if (job.opens && job.path === location.pathname && !this.occupied()) {
        sessionStorage.setItem(KEPT, JSON.stringify(this.mine));
        sessionStorage.setItem(OPENED, id);
        location.href = `/result/${id}`;
      } else {
        this.tell();
        if (frames) this.announce("done", "A film is tracked.", [], `/jobs?job=${id}`);
        else this.announce("done", "A head is ready.", [], `/result/${id}`);
      }
    },
    occupied() {
      const at = document.activeElement;
      return (
        !!document.querySelector(BUSY) ||
        (at && (written(at) || at.tagName === "SELECT")) ||
        this.typed.some((field) => field.isConnected && field.value)
      );
    },
    note(event) {
      if (written(event.target) && !this.typed.includes(event.target)) this.typed = [...this.typed, event.target];
    },
    tell(news = "Head ready") {
      this.news = news;
      if (this.sound) chime();
    },
    seen() {
      if (!document.hidden) this.news = "";
    },
    entitle() {
      const running = (this.followed || []).filter((job) => this.mine.some((one) => one.id === job.id)),
        page = this.links.find((link) => link.name === this.current)?.title;
      const share = running.length && running.reduce((sum, job) => sum + job.progress, 0) / running.length;
      if (page)
        document.title = [
          this.news ? say(this.news) : running.length ? `${Math.round(100 * share)} % ${say(page)}` : say(page),
          "eigenhead",
        ].join(" - ");
    },
    turnSound() {
      this.sound = !this.sound;
      localStorage.setItem("eigenhead-sound", this.sound ? "on" : "off");
      if (this.sound) chime();
    },
  },
};
