// The language of the pages. English is the text in the code and the key of the table; `de.js` has the German.
// A page is `spoken({ ... })`: what stands between its tags, and in the attributes that are read out, is translated as it
// is; words in an expression are said: `say("{count} shot | {count} shots", { count })`.
export const LANGUAGES = { en: "English", de: "Deutsch" };
const KEPT = "eigenhead-language";

const known = (tag) => Object.keys(LANGUAGES).find((language) => tag?.toLowerCase().split("-")[0] === language);
export const language = known(localStorage.getItem(KEPT)) || navigator.languages.map(known).find(Boolean) || "en";
// Times are written as this reader of the language is used to: en-GB and en-US differ.
export const locale = navigator.languages.find((tag) => known(tag) === language) || language;
export function speak(chosen) { localStorage.setItem(KEPT, chosen); location.reload(); }

const table = language === "en" ? {} : (await import(`./${language}.js`)).default;

// Sentences that come ready-made from the service are known by the words around their values: "{1} of {2} GB are free".
const OPEN = /\{(#?)(\d)\}/g, VALUE = "([^]*?)", NUMBER = "([\\d.,]+)", literal = (text) => text.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");
const heard = Object.keys(table).filter((key) => key.match(OPEN)).sort((a, b) => b.replace(OPEN, "").length - a.replace(OPEN, "").length)
  .map((key) => ({ key, of: new RegExp(`^${literal(key).replace(/\\\{(#?)\d\\\}/g, (_, number) => (number ? NUMBER : VALUE))}$`) }));
const remembered = new Map(); // a page says the same sentences twice a second
const REMEMBERED_MOST = 2000;

function hear(sentence) {
  if (!heard.length || typeof sentence !== "string" || !sentence.includes(" ")) return sentence;
  if (remembered.size >= REMEMBERED_MOST) remembered.clear();
  if (!remembered.has(sentence)) remembered.set(sentence, understood(sentence));
  return remembered.get(sentence);
}

function understood(sentence) {
  const one = heard.find(({ of }) => of.test(sentence));
  if (one) {
    const values = one.of.exec(sentence).slice(1).map((value) => decimal(say(value)));
    return table[one.key].replace(OPEN, (_, __, number) => values[number - 1]);
  }
  const parts = sentence.split("; ");
  if (parts.length > 1) return parts.map((part) => say(part)).join("; ");
  const named = /^([\w./-]+(?:, [\w./-]+)*): ([^]+)$/.exec(sentence); // "cam03, cam04: moved", "images/cam03.png: is damaged"
  return named ? `${named[1]}: ${say(named[2])}` : sentence;
}

// "one | several" are the forms of a sentence with a `count`; `context` tells two meanings of one English word apart.
export function say(text, values = {}) {
  const found = (values.context && table[`${text} (${values.context})`]) ?? table[text] ?? hear(text);
  if (typeof found !== "string") return found;
  const forms = "count" in values ? found.split(" | ") : [found];
  return forms[values.count === 1 ? 0 : forms.length - 1].replace(/\{(\w+)\}/g, (whole, name) => (name in values ? values[name] : whole));
}

// A number that is written with a point, as the language writes it.
export function decimal(text) { return language === "de" && /^[+-]?\d+\.\d+( [A-Za-z%]+)?$/.test(text) ? text.replace(".", ",") : text; }

// Tags, whose quoted values may hold ">", and the text between them.
const PARTS = /(<[^!](?:"[^"]*"|[^">])*>)|([^<]+)/g, READ_OUT = /(\s(?:aria-label|title|placeholder|alt|label)=")([^"]+)(?=")/g;
const key = (words) => words.trim().replace(/\s+/g, " ");

function inLanguage(markup) {
  return markup.replace(PARTS, (_, tag, words) => (tag ? tag.replace(READ_OUT, (_, before, read) => before + (table[read] ?? read)) : words.replace(/\S(?:[^]*\S)?/, (said) => table[key(said)] ?? said)));
}

export function spoken(component) {
  return { ...component, template: language === "en" ? component.template : inLanguage(component.template),
    beforeCreate() { document.documentElement.lang = language; }, // Quasar has set its own
    methods: { ...component.methods, say } };
}
