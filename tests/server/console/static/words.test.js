import assert from "node:assert/strict";
import test from "node:test";
import { fixed, keepDraft, kept, sessionName, size, span, typing } from "/console/static/words.js";

test("a span has seconds, minutes or hours, and a decimal below ten seconds", () => {
  const cases = [
    [null, ""],
    [undefined, ""],
    [-3, "0.0 s"],
    [9.96, "10 s"],
    [10, "10 s"],
    [59.4, "59 s"],
    [59.7, "1 min 0 s"],
    [61, "1 min 1 s"],
    [3599.6, "1 h 0 min"],
    [7325, "2 h 2 min"],
  ];
  for (const [seconds, text] of cases) assert.equal(span(seconds), text);
});

test("a minute is never written as sixty of the smaller unit", () => {
  for (let seconds = 0; seconds < 8000; seconds += 0.5)
    assert.doesNotMatch(span(seconds), /\b60 (s|min)\b/, String(seconds));
});

test("sizes are decimal, and no file is nothing", () => {
  assert.deepEqual([1, 999, 1500, 2.5e6, 7.25e9].map(size), ["1 kB", "1 kB", "2 kB", "2.5 MB", "7.3 GB"]);
});

test("a number that is not there is a dash", () => {
  assert.deepEqual([fixed(null, 2), fixed(undefined, 2), fixed(0, 2), fixed("1.005", 1)], ["-", "-", "0.00", "1.0"]);
});

test("a draft comes back until it is sent, and a damaged one is none", () => {
  keepDraft("captures name", { label: "Änne" });
  assert.deepEqual(kept("captures name"), { label: "Änne" });
  keepDraft("captures name", null);
  assert.equal(kept("captures name"), null);
  sessionStorage.setItem("eigenhead captures name", "{");
  assert.equal(kept("captures name"), null);
});

test("sessions of one name are told apart by when they began", () => {
  const anna = { id: "a", label: "Anna", created: "2026-01-02T08:00:00Z" };
  const again = { ...anna, id: "b" };
  assert.equal(sessionName(anna, [anna]), "Anna");
  assert.match(sessionName(anna, [anna, again]), /^Anna, begun .*\d\d:\d\d:\d\d$/);
  assert.match(sessionName({ ...anna, label: "" }, [anna]), /2 Jan/);
  assert.equal(sessionName(null, []), "");
});

test("keys of fields and shortcuts of the browser are no keys of the page", () => {
  const event = (tagName, more = {}) => ({
    key: "r",
    target: { tagName, isContentEditable: false, type: more.type },
    ...more,
  });
  assert.ok(typing(event("INPUT", { type: "text" })));
  assert.ok(typing(event("BODY", { ctrlKey: true })));
  assert.ok(!typing(event("BODY")));
  assert.ok(!typing(event("INPUT", { type: "checkbox" })), "a ticked box takes the space bar alone");
  assert.ok(typing(event("INPUT", { type: "checkbox", key: " " })));
});
