// Runs label.js with a fake page and a fake server of four pictures, presses keys, and prints what
// the server received and what the page shows, as JSON.
// Usage: node fake_page.js LABEL_JS LABELLED KEYS
// LABELLED: numbers of the labelled pictures, with commas between them; "0-": the label has no lane;
// "0s": its class "straight" follows from its lines.
// KEYS: names of keys with commas between them; they are pressed without a pause. "." waits until
// all requests are answered, "fail" makes the next request fail, "show N" opens picture N, "drag"
// edits the picture, "other N" is another page that labels picture N or removes its label, "type
// FIELD TEXT" types into a field, "reload" loads the page again. The labels at the start have the
// drive "old".
"use strict";
const fs = require("fs"), vm = require("vm");
const [file, labelled, keys] = process.argv.slice(2);
const labels = [0, 1, 2, 3].map((n) => labelled.split(",").find((one) => one[0] === String(n)) || null);
const versions = labels.map(() => 0);
const earlier = labels.map(() => []); // for each picture the labels before each change
const drives = labels.map((one) => (one ? "old" : null));
const received = [], stored = {};
let elements = {}, onKey = [], page = null;
let changes = 0, pending = 0, failing = false;

const ink = new Proxy({}, { get: (of, name) => of[name] ?? (() => {}), set: () => true });
const element = (id) => (elements[id] ||= {
  id, value: "", textContent: "", style: {}, dataset: {}, width: 8, height: 6, on: {},
  addEventListener(name, work) { this.on[name] = work; },
  getContext: () => ink, getBoundingClientRect: () => ({ left: 0, top: 0 }), setPointerCapture() {},
});
const pair = (value) => ({ left: structuredClone(value), right: structuredClone(value) });
const row = (n) => (labels[n] ? {
  file: `${n}.png`, heading: labels[n].endsWith("s") ? "straight" : "left", drive: drives[n],
} : null);
const picture = (n) => ({
  file: `${n}.png`, width: 100, height: 75, camera_pitch_deg: 0, note: "",
  heading: labels[n]?.endsWith("s") ? "" : row(n)?.heading ?? "",
  row: row(n), version: String(versions[n]), source: labels[n] && !labels[n].endsWith("-") ? "label" : "model",
  markings: { ml: -1 - n / 10, mr: 2, angle: 0, curvature: 0, pitch_deg: 0 },
  lines: pair([[0, 0], [1, 75]]), handles: pair([[1, 70], [2, 60], [3, 50]]),
});

function change(n, label) {
  earlier[n].push([labels[n], versions[n]]);
  labels[n] = label;
  versions[n] = ++changes;
}

function answer(path, method, body) {
  const n = Number(/pictures\/(\d+)/.exec(path)?.[1]);
  const version = /\?version=(.*)/.exec(path)?.[1];
  if (path === "api/pictures") return {
    folder: "mine", pictures: labels.map((one, i) => ({ file: `${i}.png`, labelled: Boolean(one) })),
  };
  if (path.endsWith("fit")) return { ...picture(n), markings: { ...picture(n).markings, ml: -1.77 } };
  if (method === "GET") return picture(n);
  if (version !== String(versions[n])) return null;
  if (path.includes("undo")) {
    received.push(`UNDO ${n}`);
    [labels[n], versions[n]] = earlier[n].pop();
  } else if (labels[n] || method === "PUT") {
    received.push(method === "PUT" ? `PUT ${n} ${body.ml} ${body.heading}` : `DELETE ${n}`);
    change(n, method === "PUT" ? String(n) : null);
    drives[n] = body?.drive;
  }
  return { row: row(n), version: String(versions[n]) };
}

async function fetch(path, { method, body }) {
  const ok = !failing;
  failing = false;
  pending++;
  await new Promise((done) => setTimeout(done, 1));
  pending--;
  const told = ok ? answer(path, method, body && JSON.parse(body)) : { detail: "no answer" };
  if (!told) return { ok: false, status: 409, json: async () => ({ detail: "changed since it was shown" }) };
  return { ok, status: ok ? 200 : 500, json: async () => told, blob: async () => ({}) };
}

const source = fs.readFileSync(file, "utf8");
function load() {
  elements = {};
  onKey = [];
  page = vm.createContext({
    document: { getElementById: element, body: { dataset: {}, clientWidth: 800 } },
    window: { innerHeight: 600, addEventListener: (name, work) => { if (name === "keydown") onKey.push(work); } },
    location: { hash: "" }, sessionStorage: { getItem: () => null }, fetch, structuredClone,
    localStorage: { getItem: (name) => stored[name] ?? null, setItem: (name, text) => { stored[name] = text; } },
    createImageBitmap: async () => ({ width: 100, height: 75 }),
  });
  vm.runInContext(`${source}; this.found = () => ({ number, labelled: pictures.map((one) => one.labelled), shown: shown && shown.file }); this.show = open;`, page);
}

const press = (key) => onKey.forEach((work) => work({ key, target: { tagName: "BODY" }, preventDefault() {} }));
async function settle() {
  for (let idle = 0; idle < 3; idle = pending ? 0 : idle + 1) await new Promise((done) => setTimeout(done, 2));
}
function drag() {
  const { on, style } = elements.picture, scale = parseFloat(style.width) / 100;
  const at = (u, v) => ({ clientX: (u + 0.5) * scale, clientY: (v + 0.5) * scale, pointerId: 1 });
  on.pointerdown(at(1, 70)); on.pointermove(at(5, 70)); on.pointerup(at(5, 70));
}

function type(field, text) {
  element(field).value = text;
  element(field).on.input?.();
}

(async () => {
  load();
  if (!keys.startsWith("type")) await settle(); // a field can be used before the first picture is shown
  for (const key of keys.split(",")) {
    if (key === ".") await settle();
    else if (key === "fail") failing = true;
    else if (key === "drag") drag();
    else if (key.startsWith("other ")) change(Number(key.slice(6)), labels[key.slice(6)] ? null : key.slice(6));
    else if (key.startsWith("show ")) await page.show(Number(key.slice(5)));
    else if (key === "reload") load();
    else if (key.startsWith("type ")) type(...key.split(" ").slice(1));
    else press(key);
  }
  await settle();
  console.log(JSON.stringify({ ...page.found(), received, status: elements.status.textContent, stored: labels.map(Boolean), drives, drive: element("drive").value }));
})();
