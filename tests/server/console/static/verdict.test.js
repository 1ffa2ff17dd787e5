import assert from "node:assert/strict";
import test from "node:test";
import { faultsOf, Outline, Verdict, verdictTag } from "/console/static/verdict.js";

const fault = (code, camera, detail) => ({ code, camera, detail, remedy: `mend ${code}` });
const FAULTS = [
  fault("blurred", "cam01", "edges of 3.1 px"),
  fault("blurred", "cam02", "edges of 3.1 px"),
  fault("lights-off", null, "dark"),
];
const computed = (name, capture) => Verdict.computed[name].call({ capture });

test("the same fault of several cameras is one line, its details once", () => {
  const [blurred, dark] = computed("lines", { faults: FAULTS });
  assert.deepEqual(blurred.cameras, ["cam01", "cam02"]);
  assert.deepEqual(blurred.details, ["edges of 3.1 px"]);
  assert.equal(blurred.title, "out of focus");
  assert.equal(blurred.remedy, "mend blurred");
  assert.deepEqual(dark.cameras, ["all cameras"]);
});

test("a camera has its own faults and those of all", () => {
  assert.deepEqual(faultsOf({ faults: FAULTS }, "cam02"), ["out of focus", "lamps off"]);
  assert.deepEqual(faultsOf({}, "cam02"), []);
});

test("the sentence counts cameras without a fault, each camera once", () => {
  const capture = (verdict, faults) => ({ verdict, faults, cameras: ["cam00", "cam01", "cam02"] });
  assert.match(
    computed("sentence", capture("usable", [...FAULTS.slice(0, 1), fault("moved", "cam01", "x")])),
    /^2 of 3 cameras/,
  );
  assert.match(computed("sentence", capture("poor", FAULTS.slice(0, 2))), /^1 of 3 cameras .*shoot again/);
  assert.match(computed("sentence", capture("poor", FAULTS)), /^Something is wrong with all pictures/);
  assert.match(computed("sentence", capture("good", [])), /^All 3 pictures/);
  assert.match(computed("sentence", capture(null, [])), /before pictures were judged/);
});

test("a capture that was not judged says so", () => {
  assert.deepEqual(verdictTag({ verdict: null }), { text: "not judged", kind: "" });
  assert.deepEqual(verdictTag({ verdict: "poor" }), { text: "Poor", kind: "fault" });
});

test("an outline is the polygon's corners", () => {
  const points = (view) => Outline.computed.points.call({ view });
  assert.equal(
    points({
      subject: {
        outline: [
          [1, 2],
          [3.5, 4],
        ],
      },
    }),
    "1,2 3.5,4",
  );
  assert.equal(points(undefined), "");
});
