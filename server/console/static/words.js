// What several pages share: keys, times, numbers.
import { decimal, locale, say } from "/console/static/language.js";

export function typing(event) {
  const target = event.target,
    ticked = target.type === "checkbox"; // which takes the space bar alone
  const taken = ticked ? event.key === " " : /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName);
  return target.isContentEditable || taken || event.ctrlKey || event.metaKey || event.altKey;
}

export function clock(moment) {
  if (!moment) return "";
  const date = new Date(moment);
  const today = new Date().toDateString() === date.toDateString();
  const time = date.toLocaleTimeString(locale, {
    hour: "2-digit",
    minute: "2-digit",
    second: "2-digit",
    hour12: false,
  });
  return today ? time : `${date.toLocaleDateString(locale, { day: "numeric", month: "short" })} ${time}`;
}

export function span(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 9.95) return `${fixed(Math.max(0, seconds), 1)} s`;
  const whole = Math.round(seconds),
    minutes = Math.round(whole / 60); // first rounded, then divided: never 1 min 60 s
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

export function size(bytes) {
  return bytes > 1e9
    ? `${fixed(bytes / 1e9, 1)} GB`
    : bytes > 1e6
      ? `${fixed(bytes / 1e6, 1)} MB`
      : `${Math.ceil(bytes / 1e3)} kB`;
}

export function fixed(value, digits) {
  return value === null || value === undefined ? "-" : decimal(Number(value).toFixed(digits));
}

const STAGES = {
  ingest: "taking the pictures in",
  read: "reading the pictures",
  segmentation: "finding silhouettes",
  faces: "finding the face",
  alignment: "placing the head",
  fit: "fitting the head",
  texture: "colouring the head",
  evidence: "judging the fit",
  write: "writing the files",
  parts: "telling skin, hair and clothes apart",
  "fit again": "fitting the head again",
  depth: "measuring depths in the photographs",
  fine: "drawing the head to the photographs",
  bust: "closing the surface of the bust",
  atlas: "painting the texture",
  compiling: "compiling, once on this machine",
  done: "done",
  detection: "finding the board in the pictures",
  lenses: "estimating the lenses",
  "pose graph": "placing the cameras",
  bundle: "adjusting cameras and boards together",
  checks: "checking the result",
  features: "finding distinct points in the photographs",
  matches: "finding the same points in other photographs",
  structure: "placing the cameras",
  scale: "measuring the scale",
  silhouettes: "comparing silhouettes",
  identity: "finding the person's head in the sharpest frames",
  frames: "tracking the head from frame to frame",
  preview: "drawing the preview",
};
// What decides how fine a head becomes, and who solves: what stands in settings and reports is said in words.
export const LEVELS = {
  span: "head model alone",
  kernel: "outlines of the pictures",
  photo: "photographs",
  fine: "photographs, fine",
  pores: "photographs, with pores",
};
export const METHODS = { contour: "fast", simplex: "downhill simplex, slow" };
export function levelWords(level) {
  return level ? say(LEVELS[level] || level) : "";
}
export function methodWords(method) {
  return say(METHODS[method || "contour"]);
}

export function stageWords(stage) {
  return say(STAGES[stage] || stage);
}

// The session that the operator works in, kept for the pages of this browser tab.
export function openSession() {
  return sessionStorage.getItem("eigenhead-session") || "";
}
export function keepSession(id) {
  sessionStorage.setItem("eigenhead-session", id);
}
// What was typed and not sent is kept in this browser tab: a reload brings it back.
export function kept(name) {
  try {
    return JSON.parse(sessionStorage.getItem(`eigenhead ${name}`));
  } catch {
    return null;
  }
}
export function keepDraft(name, value) {
  value
    ? sessionStorage.setItem(`eigenhead ${name}`, JSON.stringify(value))
    : sessionStorage.removeItem(`eigenhead ${name}`);
}
// What is chosen and sought stands in the address, so that a reload or a bookmark brings it back.
export function keepAddress(fields) {
  const kept = new URLSearchParams(Object.entries(fields).filter(([, value]) => value));
  history.replaceState(history.state, "", location.pathname + (kept.size ? `?${kept}` : ""));
}
// Two sessions of one name are told apart by when they began.
export function sessionName(session, all) {
  if (!session) return "";
  const twice = all.some((other) => other.id !== session.id && other.label === session.label);
  return session.label
    ? `${session.label}${twice ? `, ${say("begun {time}", { time: clock(session.created) })}` : ""}`
    : clock(session.created);
}

// Sends one file as the form part "file"; resolves with {status, document} and never rejects.
export function send(address, file, fields, progress) {
  return new Promise((resolve) => {
    const request = new XMLHttpRequest();
    request.open("POST", address);
    request.upload.onprogress = (event) => event.lengthComputable && progress(event.loaded / event.total);
    request.onload = () => {
      let document = { detail: request.statusText, errors: [] };
      try {
        document = JSON.parse(request.responseText);
      } catch {
        /* an answer without JSON has its status text */
      }
      resolve({ status: request.status, document });
    };
    request.onerror = () =>
      resolve({ status: 0, document: { detail: "The service did not answer; send it again.", errors: [] } });
    const form = new FormData();
    for (const [name, value] of Object.entries(fields)) form.append(name, value);
    form.append("file", file);
    request.send(form);
  });
}
