// The live head: lamps of each camera, what is to do, a small head that turns as the subject does, and a shot that is
// taken by itself when the head is steady. The page mixes it in beside liveView, whose `head` is the newest look.
import { say } from "/console/static/language.js";

const LAMPS = { face: "face", sharp: "sharp", exposed: "light", centred: "middle", looking: "looks" };
const KINDS = { true: "good", false: "warn", null: "" };
const QUIET = new Set(["looking"]); // no face looks into all cameras
const SIZE_MM = 330; // of the picture of the head
const SUN = [0.35, -0.5, -0.79]; // towards the light: right, down, away

export const liveHead = {
  data: () => ({ auto: false }),
  computed: {
    words() {
      return this.head?.words || [];
    },
    state_of_head() {
      if (!this.head?.head) return "";
      if (this.head.ready) return say("Steady, eyes open: ready");
      return say(this.head.steady ? "Steady" : "Moving");
    },
  },
  watch: {
    head() {
      this.drawHead();
      this.takeWhenReady();
    },
  },
  methods: {
    lamps(name) {
      const seen = this.head?.cameras?.[name] || {};
      return Object.entries(LAMPS).map(([lamp, text]) => {
        const lit = seen[lamp] ?? null;
        return {
          lamp,
          kind: lit === false && QUIET.has(lamp) ? "" : KINDS[lit],
          text: say(text),
          told: lit === null ? "-" : say(lit ? "yes" : "no"),
        };
      });
    },
    takeWhenReady() {
      if (!this.auto || !this.head?.ready || this.busy || this.count || this.asking || this.shot) return;
      this.auto = false;
      if (this.state.ask_consent && !this.open?.consent) this.start();
      else this.act("capture");
    },
    drawHead() {
      const canvas = this.$refs.head;
      if (!canvas) return;
      const context = canvas.getContext("2d");
      context.clearRect(0, 0, canvas.width, canvas.height);
      const { vertices, triangles } = this.head?.head || { vertices: [], triangles: [] };
      const scale = canvas.width / SIZE_MM;
      const faces = triangles.map((corners) => {
        const [a, b, c] = corners.map((k) => vertices[k]);
        const u = b.map((x, k) => x - a[k]),
          v = c.map((x, k) => x - a[k]);
        const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        const length = Math.hypot(...normal) || 1;
        return { corners: [a, b, c], normal: normal.map((x) => x / length), away: a[2] + b[2] + c[2] };
      });
      faces.sort((one, other) => other.away - one.away);
      for (const { corners, normal } of faces) {
        if (normal[2] > 0) continue; // it faces away
        const light = Math.max(
          0,
          normal.reduce((sum, x, k) => sum + x * SUN[k], 0),
        );
        const grey = Math.round(60 + 165 * light);
        context.fillStyle = context.strokeStyle = `rgb(${grey}, ${grey}, ${Math.min(255, grey + 8)})`;
        context.beginPath();
        for (const [right, down] of corners)
          context.lineTo(canvas.width / 2 + scale * right, canvas.height / 2 + scale * down);
        context.closePath();
        context.fill();
        context.stroke();
      }
    },
  },
};

// Draws landmarks, shares of width and height, over a live picture.
export function mark(context, points, width, height) {
  context.fillStyle = "#6cb2ff";
  for (const [x, y] of points || []) context.fillRect(x * width - 1, y * height - 1, 2, 2);
}
