// What the service tells is data: {code, message, parameters}. Its sentence is looked up by the code and filled in with
// the parameters, as rig/messages/templates.py fills in the English one; a code that the language lacks, a parameter that
// is not there (of an earlier version) and a plain text are shown as they came. Nothing of a browser is used here.
const FIELD = /\{(\w+)(?::([^{}]+))?\}/g,
  NUMBER = /^(\+?)\.(\d)([f%g])$/,
  FORMS = " | ";

// `templates` by code; `words` of the language by their English; `marks`: of decimals and of thousands.
export function sentence(told, templates, words, marks) {
  if (!told || typeof told !== "object") return told;
  const template = templates[told.code],
    given = told.parameters || {};
  if (typeof template !== "string") return told.message;
  const forms = template.split(FORMS),
    form = forms.length > 1 && given.count === 1 ? forms[0] : forms[forms.length - 1];
  if ([...form.matchAll(FIELD)].some(([, name]) => !(name in given))) return told.message;
  return form.replace(FIELD, (_, name, specification) =>
    written(given[name], specification || "", templates, words, marks),
  );
}

function written(value, specification, ...language) {
  if (Array.isArray(value))
    return value
      .map((one) => written(one, specification, ...language))
      .join(value.some((one) => typeof one === "object") ? "; " : ", ");
  if (value && typeof value === "object") return sentence(value, ...language);
  const [, words, marks] = language;
  if (specification === "word") return words[value] ?? String(value);
  return typeof value === "number" ? number(value, specification, marks) : String(value);
}

// As Python formats it, with the language's marks.
export function number(value, specification, [decimal, thousands]) {
  if (specification === ",") return String(value).replace(/\B(?=(\d{3})+$)/g, thousands);
  const [, sign, digits, kind] = NUMBER.exec(specification) || ["", "", "", specification];
  const text =
    kind === "f"
      ? value.toFixed(digits)
      : kind === "%"
        ? `${(100 * value).toFixed(digits)}%`
        : kind === "g"
          ? String(Number(value.toPrecision(digits || 6)))
          : String(value);
  return (sign && value >= 0 ? "+" : "") + text.replace(".", decimal);
}

// The English of a message, or of a text.
export function english(told) {
  return told && typeof told === "object" ? told.message : told;
}

// What a refusal, a problem document, tells, and every fault in it.
export function told(problem) {
  return problem.detail_message ?? problem.detail;
}
export function toldFaults(problem) {
  return problem.error_messages ?? problem.errors ?? [];
}
