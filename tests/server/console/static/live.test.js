import assert from "node:assert/strict";
import test from "node:test";
import { liveView } from "/console/static/live.js";

function framed(document, body) {
  const header = new TextEncoder().encode(JSON.stringify(document));
  const bytes = new Uint8Array(8 + header.length + body.length);
  new DataView(bytes.buffer).setUint32(0, header.length);
  new DataView(bytes.buffer).setUint32(4, body.length);
  bytes.set(header, 8);
  bytes.set(body, 8 + header.length);
  return bytes;
}

async function read(pieces) {
  const shown = [];
  const page = { show: async (document, body) => shown.push([document.n, [...body]]) };
  const values = [...pieces];
  await liveView.methods.read.call(page, {
    read: async () => (values.length ? { value: values.shift() } : { done: true }),
  });
  return shown;
}

test("documents and pictures are whole, however the network cuts them", async () => {
  const bytes = [
    framed({ n: 1 }, Uint8Array.of(7, 8, 9)),
    framed({ n: 2, ä: "ö" }, Uint8Array.of()),
    framed({ n: 3 }, Uint8Array.of(255)),
  ];
  const whole = Uint8Array.from(bytes.flatMap((part) => [...part]));
  const expected = [
    [1, [7, 8, 9]],
    [2, []],
    [3, [255]],
  ];
  for (const step of [1, 2, 7, 8, 9, whole.length]) {
    const pieces = [];
    for (let start = 0; start < whole.length; start += step) pieces.push(whole.slice(start, start + step));
    assert.deepEqual(await read(pieces), expected, `pieces of ${step} bytes`);
  }
});

test("each camera gets its share of a body, and one without a new picture keeps its count", async () => {
  const page = { live: { a: { frames: 4 } }, canvas: {} };
  const cameras = [
    { name: "a", bytes: 0 },
    { name: "b", bytes: 2 },
  ];
  await liveView.methods.show.call(page, { fault: "f", cameras }, Uint8Array.of(1, 2));
  assert.equal(page.fault, "f");
  assert.deepEqual([page.live.a.frames, page.live.b.frames], [4, 1]);
});
