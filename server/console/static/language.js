// The language of the pages. English is the text in the code and the key of the table; `de.js` has the German, and
// `messages_de.js` that of what the service tells, by its code.
import { sentence } from "/console/static/messages.js";

// A page is `spoken({ ... })`: what stands between its tags, and in the attributes that are read out, is translated as it
// is; words in an expression are said: `say("{count} shot | {count} shots", { count })`.
export const LANGUAGES = { en: "English", de: "Deutsch" };
const KEPT = "eigenhead-language";

const known = (tag) => Object.keys(LANGUAGES).find((language) => tag?.toLowerCase().split("-")[0] === language);
export const language = known(localStorage.getItem(KEPT)) || navigator.languages.map(known).find(Boolean) || "en";
// Times are written as this reader of the language is used to: en-GB and en-US differ.
export const locale = navigator.languages.find((tag) => known(tag) === language) || language;
export function speak(chosen) {
  localStorage.setItem(KEPT, chosen);
  location.reload();
}

const table = language === "en" ? {} : (await import(`./${language}.js`)).default;
const messages = language === "en" ? {} : (await import(`./messages_${language}.js`)).default;
const MARKS = { en: [".", ","], de: [",", "."] };

// "one | several" are the forms of a sentence with a `count`; `context` tells two meanings of one English word apart.
// What the service tells, {code, message, parameters}, has its German by its code.
export function say(text, values = {}) {
  if (text && typeof text === "object") return sentence(text, messages, table, MARKS[language]);
  const found = (values.context && table[`${text} (${values.context})`]) ?? table[text] ?? text;
  if (typeof found !== "string") return found;
  const forms = "count" in values ? found.split(" | ") : [found];
  return forms[values.count === 1 ? 0 : forms.length - 1].replace(/\{(\w+)\}/g, (whole, name) =>
    name in values ? values[name] : whole,
  );
}

// A number that is written with a point, as the language writes it.
export function decimal(text) {
  return language === "de" && /^[+-]?\d+\.\d+( [A-Za-z%]+)?$/.test(text) ? text.replace(".", ",") : text;
}

// Tags, whose quoted values may hold ">", and the text between them.
const PARTS = /(<[^!](?:"[^"]*"|[^">])*>)|([^<]+)/g,
  READ_OUT = /(\s(?:aria-label|title|placeholder|alt|label)=")([^"]+)(?=")/g;
const key = (words) => words.trim().replace(/\s+/g, " ");

function inLanguage(markup) {
  return markup.replace(PARTS, (_, tag, words) =>
    tag
      ? tag.replace(READ_OUT, (_, before, read) => before + (table[read] ?? read))
      : words.replace(/\S(?:[\s\S]*\S)?/, (said) => table[key(said)] ?? said),
  );
}

export function spoken(component) {
  return {
    ...component,
    template: language === "en" ? component.template : inLanguage(component.template),
    beforeCreate() {
      document.documentElement.lang = language;
    }, // Quasar has set its own
    methods: { ...component.methods, say },
  };
}
