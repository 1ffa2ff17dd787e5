import assert from "node:assert/strict";
import test from "node:test";
import { english, number, sentence, told, toldFaults } from "/console/static/messages.js";

const POINT = [".", ","];
const COMMA = [",", "."];

test("numbers are written as Python's format writes them, with the language's marks", () => {
  const cases = [
    [1.25, ".1f", POINT, "1.3"],
    [0.1234, ".1%", COMMA, "12,3%"],
    [2, "+.2f", COMMA, "+2,00"],
    [-2, "+.2f", POINT, "-2.00"],
    [1234567, ",", COMMA, "1.234.567"],
    [1234567, ",", POINT, "1,234,567"],
    [0.00012345, ".3g", POINT, "0.000123"],
    [7, "", POINT, "7"],
  ];
  for (const [value, specification, marks, text] of cases) assert.equal(number(value, specification, marks), text);
});

test("a message is filled in by its code, parts and lists within it too", () => {
  const templates = { outer: "{where}: {parts}", inner: "{count} Bild | {count} Bilder" };
  const message = (code, parameters) => ({ code, message: "English", parameters });
  const parts = [message("inner", { count: 1 }), message("inner", { count: 2 })];
  assert.equal(sentence(message("outer", { where: "cam00", parts }), templates, {}, COMMA), "cam00: 1 Bild; 2 Bilder");
});

test("a code or a parameter that is not there leaves the English", () => {
  const shown = (code, parameters) => sentence({ code, message: "English", parameters }, { known: "{a}" }, {}, COMMA);
  assert.equal(shown("unknown", {}), "English");
  assert.equal(shown("known", {}), "English");
  assert.equal(shown("known", { a: 1 }), "1");
  assert.equal(sentence("text", {}, {}, COMMA), "text");
});

test("a problem of an earlier version is told by its texts", () => {
  assert.equal(told({ detail: "old" }), "old");
  assert.deepEqual(told({ detail: "old", detail_message: { code: "c" } }), { code: "c" });
  assert.deepEqual(toldFaults({}), []);
  assert.deepEqual(toldFaults({ errors: ["a"], error_messages: [{ code: "c" }] }), [{ code: "c" }]);
  assert.deepEqual([english({ message: "m" }), english("t"), english(null)], ["m", "t", null]);
});
