import assert from "node:assert/strict";
import test from "node:test";
import { paged } from "/console/static/list.js";

function page(next = "") {
  const asked = [];
  const { methods } = paged;
  return {
    ...methods,
    behind: [],
    picked: ["x"],
    picking: false,
    state: { next },
    listed: [{ id: "1" }, { id: "2" }],
    asked,
    ask: () => asked.push("ask"),
    top: () => asked.push("top"),
  };
}

test("pages go forward as long as there is one, and back by the way they came", () => {
  const list = page("c1");
  list.forward();
  list.state.next = "c2";
  list.forward();
  assert.deepEqual(list.behind, ["c1", "c2"]);
  list.state.next = "";
  list.forward();
  assert.deepEqual(list.behind, ["c1", "c2"], "the last page has none after it");
  list.back();
  assert.deepEqual(list.behind, ["c1"]);
  assert.deepEqual(list.asked, ["ask", "top", "ask", "top", "ask", "top"]);
});

test("what is sought anew begins at the first page, with nothing ticked", () => {
  const list = { ...page(), behind: ["c1"] };
  list.first();
  assert.deepEqual([list.behind, list.picked, list.asked], [[], [], ["ask"]]);
});

test("all that is listed is ticked, and nothing once ticking ends", () => {
  const list = page();
  list.pickAll();
  assert.deepEqual(list.picked, ["1", "2"]);
  list.pickMany();
  assert.deepEqual([list.picking, list.picked], [true, []]);
});
