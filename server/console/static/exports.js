// What the 3D view shows as a picture, and a whole turn of it as a video, with the legend of colours that stand for
// numbers. A page that mixes it in has renderOnce(), camera, controls, renderer, scale, gradientStops, job and fileName.
import { say } from "/console/static/language.js";
import { fixed } from "/console/static/words.js";

const FRAMES_A_SECOND = 30;
const FEW_A_SECOND = 8; // pictures: fewer are no smooth turn
const LAST_MS = 120; // until the last picture has reached the recorder
const BITS_A_SECOND = 12e6;
const GROUND = "#101318";
const TYPES = ["video/webm;codecs=vp8", "video/webm", "video/mp4"]; // VP8 is what a slow machine encodes as it draws

const videoType = () => TYPES.find((type) => window.MediaRecorder?.isTypeSupported(type));
const even = (size) => size - (size % 2); // video codecs halve the colours' resolution

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

export const exports3d = {
  data: () => ({ turning: null, turnS: 8, video: videoType() }),
  beforeUnmount() {
    this.stopTurning();
  },
  methods: {
    paper() {
      const { width, height } = this.renderer.domElement;
      return Object.assign(document.createElement("canvas"), { width: even(width), height: even(height) });
    },
    compose(paper, ground) {
      // the drawing buffer is there until the browser shows it
      const pen = paper.getContext("2d"),
        { width, height } = paper,
        rem = height / 40;
      this.renderOnce();
      pen.clearRect(0, 0, width, height);
      if (ground) {
        pen.fillStyle = ground;
        pen.fillRect(0, 0, width, height);
      }
      pen.drawImage(this.renderer.domElement, 0, 0);
      if (!this.scale) return;
      const ramp = pen.createLinearGradient(0, 11 * rem, 0, rem),
        right = width - rem;
      this.gradientStops().forEach((colour, i, all) => {
        ramp.addColorStop(i / (all.length - 1), colour);
      });
      pen.fillStyle = ramp;
      pen.fillRect(right - rem, rem, rem, 10 * rem);
      pen.fillStyle = ground ? "#e8ebf0" : "#6b7686";
      pen.font = `${rem}px sans-serif`;
      pen.textAlign = "right";
      pen.textBaseline = "middle";
      const digits = this.digits,
        end = `${this.scale.beyond ? "≥ " : ""}${fixed(this.scale.most, digits)} mm`;
      [
        [end, 1.5],
        [fixed(this.scale.most / 2, digits), 6],
        ["0", 10.5],
      ].forEach(([text, at]) => {
        pen.fillText(text, right - 1.5 * rem, at * rem);
      });
      pen.textAlign = "left";
      pen.fillText(this.scale.title, rem, 1.5 * rem);
    },
    async savePicture() {
      const paper = this.paper();
      this.compose(paper);
      save(await new Promise((done) => paper.toBlob(done, "image/png")), `${this.fileName}.png`);
    },
    async turntable() {
      // by the clock: a slow machine gives fewer pictures, not a slower turn
      const paper = this.paper(),
        start = this.camera.position.clone(),
        offset = start.clone().sub(this.controls.target),
        axis = this.camera.up,
        parts = [];
      this.compose(paper, GROUND);
      const stream = paper.captureStream(FRAMES_A_SECOND),
        recorder = new MediaRecorder(stream, { mimeType: this.video, videoBitsPerSecond: BITS_A_SECOND });
      recorder.ondataavailable = (event) => event.data.size && parts.push(event.data);
      const stopped = new Promise((done) => {
        recorder.onstop = done;
      });
      this.turning = 0;
      this.controls.enabled = false;
      recorder.start();
      const began = performance.now();
      let pictures = 0;
      const step = (now) => {
        if (this.turning === null) return recorder.stop(); // somebody stopped it
        this.turning = Math.min(1, Math.max(0, now - began) / 1000 / this.turnS);
        this.camera.position
          .copy(offset)
          .applyAxisAngle(axis, 2 * Math.PI * this.turning)
          .add(this.controls.target);
        this.camera.lookAt(this.controls.target);
        this.compose(paper, GROUND);
        pictures += 1;
        if (this.turning < 1) requestAnimationFrame(step);
        else setTimeout(() => recorder.stop(), LAST_MS);
      };
      requestAnimationFrame(step);
      await stopped;
      stream.getTracks().forEach((track) => {
        track.stop();
      });
      const whole = this.turning === 1;
      if (whole && pictures < FEW_A_SECOND * this.turnS)
        this.fault = say("This machine draws slowly: the turn has {count} pictures.", { count: pictures });
      this.turning = null;
      this.controls.enabled = true;
      this.camera.position.copy(start);
      this.controls.update();
      this.draw();
      if (whole)
        save(new Blob(parts, { type: this.video }), `${this.fileName}.${this.video.includes("mp4") ? "mp4" : "webm"}`);
    },
    stopTurning() {
      this.turning = null;
    },
  },
};
