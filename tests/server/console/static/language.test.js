import assert from "node:assert/strict";
import test from "node:test";

// Each query is a module of its own: the language is chosen when it is loaded.
async function spokenIn(languages, chosen = null) {
  navigator.languages = languages;
  if (chosen) localStorage.setItem("eigenhead-language", chosen);
  const module = await import(`/console/static/language.js?${languages.join()}-${chosen}`);
  localStorage.removeItem("eigenhead-language");
  return module;
}

test("the browser's first known language is spoken, unless one was chosen", async () => {
  assert.equal((await spokenIn(["fr", "de-AT", "en"])).language, "de");
  assert.equal((await spokenIn(["fr"])).language, "en");
  const chosen = await spokenIn(["de-AT", "en-GB"], "en");
  assert.deepEqual([chosen.language, chosen.locale], ["en", "en-GB"]);
});

test("German writes decimals with a comma, and leaves what is no number", async () => {
  const { decimal } = await spokenIn(["de"]);
  assert.deepEqual(["1.5", "-0.25 mm", "1.2.3", "a.b", "10"].map(decimal), ["1,5", "-0,25 mm", "1.2.3", "a.b", "10"]);
  assert.equal((await spokenIn(["en"])).decimal("1.5"), "1.5");
});

test("a count takes its form, values their places, and what is unknown stays", async () => {
  const { say } = await spokenIn(["en"]);
  assert.equal(say("{count} shot | {count} shots", { count: 1 }), "1 shot");
  assert.equal(say("{count} shot | {count} shots", { count: 0 }), "0 shots");
  assert.equal(say("{here} {gone}", { here: 3 }), "3 {gone}");
});

test("what stands in markup is translated, names of tags and attributes are not", async () => {
  const { spoken, say } = await spokenIn(["de"]);
  const page = spoken({ template: '<button title="Sign in" :class="{ a: b > 1 }">\n  Sign in\n</button>' });
  const german = say("Sign in");
  assert.notEqual(german, "Sign in");
  assert.equal(page.template, `<button title="${german}" :class="{ a: b > 1 }">\n  ${german}\n</button>`);
});
