import assert from "node:assert/strict";
import test from "node:test";
import { FaceMarks, facesOf } from "/console/static/faces.js";

const face = (isSubject) => ({
  box_px: [10, 20, 30, 50],
  is_subject: isSubject,
  points: [
    [10, 20],
    [30.5, 50],
  ],
});
const page = () => ({ ...facesOf.data(), ...facesOf.methods });

test("each point is a dot of no length, which round ends make round", () => {
  assert.equal(FaceMarks.methods.dots(face(true)), "M10 20h0M30.5 50h0");
});

test("faces are shown while the switch is on, and counted where they are the subject's", () => {
  const shown = page();
  shown.faces.c1 = { cam00: [face(true)], cam01: [face(false)], cam02: [] };
  assert.equal(shown.facesIn("c1", "cam00"), null);
  assert.equal(shown.facesTold("c1"), "");
  shown.withFaces = true;
  assert.equal(shown.facesIn("c1", "cam00").length, 1);
  assert.equal(shown.facesIn("c1", "cam09"), undefined);
  assert.equal(shown.facesTold("c1"), "The face is in 1 picture.");
  shown.faces.c2 = { cam00: [face(false)] };
  assert.equal(shown.facesTold("c2"), "No picture shows a face that others confirm.");
  assert.equal(shown.facesTold("c3"), "");
});

test("they are asked for once, and the switch goes off where the service refuses", async () => {
  const asked = [],
    said = [],
    before = [globalThis.fetch, globalThis.window];
  globalThis.window = { eigenheadSay: (...what) => said.push(what) };
  globalThis.fetch = async (address) => {
    asked.push(address);
    return address.includes("bad")
      ? { ok: false, json: async () => ({ detail: "busy", errors: ["try again"] }) }
      : { ok: true, json: async () => ({ cam00: [] }) };
  };
  const shown = page();
  shown.withFaces = true;
  await Promise.all([shown.readFaces("c1"), shown.readFaces("c1")]);
  await shown.readFaces("c1");
  assert.deepEqual(asked, ["/console/captures/c1/faces"]);
  assert.equal(shown.finding, "");
  await shown.readFaces("bad");
  assert.equal(shown.withFaces, false);
  assert.deepEqual(said, [["fault", "busy", ["try again"]]]);
  [globalThis.fetch, globalThis.window] = before;
});
