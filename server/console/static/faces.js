// Faces that were found, over the pictures: a box and the points on each, the subject's brighter than a passer-by's.
// Pixels are the picture's, (0, 0) being the centre of its first one.
import { say } from "/console/static/language.js";
import { told, toldFaults } from "/console/static/messages.js";

const DOT_SHARE = 0.01; // of a face's width: small pictures keep the face visible, large ones the dots

export const FaceMarks = {
  props: { faces: Array, size: Array },
  methods: {
    dots(face) {
      return face.points.map(([x, y]) => `M${x} ${y}h0`).join("");
    },
    dot(face) {
      return DOT_SHARE * (face.box_px[2] - face.box_px[0]);
    },
  },
  template: `
    <svg v-if="faces && faces.length" class="face-marks" :viewBox="'-0.5 -0.5 ' + size[0] + ' ' + size[1]"
      preserveAspectRatio="xMidYMid meet" aria-hidden="true">
      <g v-for="(face, i) in faces" :key="i" :class="{ other: !face.is_subject }">
        <rect :x="face.box_px[0]" :y="face.box_px[1]" :width="face.box_px[2] - face.box_px[0]"
          :height="face.box_px[3] - face.box_px[1]"></rect>
        <path :d="dots(face)" :stroke-width="dot(face)"></path>
      </g>
    </svg>`,
};

// Keeps faces[id] of captures, or of jobs, which never change; `withFaces` is the switch, `finding` that in which
// the service looks for them.
export const facesOf = {
  data: () => ({ faces: {}, withFaces: false, finding: "" }),
  methods: {
    showFaces(id) {
      this.withFaces = !this.withFaces;
      if (this.withFaces) this.readFaces(id);
    },
    async readFaces(id, address = `/console/captures/${id}/faces`) {
      if (!id || this.faces[id] || this.finding === id) return;
      this.finding = id;
      let document = null; // stays so where the service does not answer, or a proxy answers for it
      let found = false;
      try {
        const answer = await fetch(address);
        document = await answer.json();
        found = answer.ok;
      } catch {
        found = false;
      }
      const awaited = this.finding === id; // another capture may be looked at by now
      if (awaited) this.finding = "";
      if (found) this.faces[id] = document;
      else if (awaited) {
        this.withFaces = false;
        if (document) window.eigenheadSay("fault", told(document), toldFaults(document));
        else window.eigenheadSay("fault", say("The service does not answer."), []);
      }
    },
    facesIn(id, camera) {
      return this.withFaces ? this.faces[id]?.[camera] : null;
    },
    facesTold(id) {
      const found = this.withFaces && this.faces[id] && Object.values(this.faces[id]);
      if (!found) return "";
      const count = found.filter((faces) => faces.some((face) => face.is_subject)).length;
      return count
        ? say("The face is in {count} picture. | The face is in {count} pictures.", { count })
        : say("No picture shows a face that others confirm.");
    },
  },
};
