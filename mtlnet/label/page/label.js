// Labels pictures. The server computes the geometry (POST fit), the page draws the markings and
// lets the user drag them. Points are in pixels of the whole picture; `view.scale` is the number
// of canvas pixels for each picture pixel.

const $ = (id) => document.getElementById(id);
const canvas = $("picture"), ink = canvas.getContext("2d");
const FIELDS = ["drive", "light"];
const SIDES = ["left", "right"], NEAR = 0, BEND = 1, FAR = 2;
const REACH = 34; // CSS px from a handle within which a touch takes it
const COLOURS = { left: "#ffd23e", right: "#5ad1ff" };

let token = decodeURIComponent(location.hash.slice(1)) || sessionStorage.getItem("token") || "";
let pictures = [], number = 0, shown = null, image = null, view = { scale: 1 };
let drag = null, steps = [], saves = [], busy = false, again = false;
let working = false; // while a save, an undo or a removal runs, keys and buttons are ignored
const ahead = new Map(); // pictures that were fetched in advance
const typed = {}; // drive and light as typed for pictures without a label
let folder = null; // name of the folder, under which `typed` is stored

async function call(path, method = "GET", body) {
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  if (body !== undefined) headers["Content-Type"] = "application/json";
  const answer = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  if (answer.status === 401) $("locked").hidden = false;
  if (!answer.ok) {
    const told = await answer.json().catch(() => ({}));
    const text = typeof told.detail === "string" ? told.detail : `the server answered ${answer.status}`;
    throw Object.assign(new Error(text), { status: answer.status });
  }
  return answer;
}

function say(text) { $("status").textContent = text; }

async function start() {
  try {
    const listing = await (await call("api/pictures")).json();
    ({ pictures, folder } = listing);
    for (const id of FIELDS) remember(id, typed[id] ?? localStorage.getItem(`${folder}/${id}`) ?? "");
    $("locked").hidden = true;
    const first = pictures.findIndex((one) => !one.labelled);
    await open(first < 0 ? 0 : first);
  } catch (error) { say(error.message); }
}

function fetched(n) {
  if (!ahead.has(n)) {
    const both = Promise.all([
      call(`api/pictures/${n}`).then((answer) => answer.json()),
      call(`api/pictures/${n}/image`).then((answer) => answer.blob()).then((blob) => createImageBitmap(blob)),
    ]);
    both.catch(() => ahead.delete(n));
    ahead.set(n, both);
  }
  return ahead.get(n);
}

// Shows the drive and light of the picture's label; without a label those that were typed last.
function fill() {
  for (const id of FIELDS) $(id).value = (shown?.row ? shown.row[id] : typed[id]) ?? "";
}

function remember(id, text) {
  typed[id] = text;
  if (folder !== null) localStorage.setItem(`${folder}/${id}`, text);
}

function keep(id) {
  if (!shown?.row) remember(id, $(id).value); // otherwise the field belongs to the picture's label
}

async function open(n) {
  number = n;
  shown = image = drag = null; // nothing of the picture before can be saved for this picture
  steps = [];
  fill();
  document.body.dataset.ready = "";
  say("");
  try {
    const [data, bitmap] = await fetched(n);
    if (n !== number) return;
    shown = structuredClone(data);
    pictures[n].labelled = shown.row !== null; // another page may have changed it
    image = bitmap;
    $("heading").value = shown.heading;
    fill();
    say(shown.note);
  } catch (error) {
    if (n !== number) return;
    say(error.message);
  }
  resize();
  if (n + 1 < pictures.length) fetched(n + 1).catch(() => {});
  for (const old of ahead.keys()) if (Math.abs(old - n) > 2) ahead.delete(old);
  document.body.dataset.ready = String(n);
}

function resize() {
  const width = document.body.clientWidth - 4, height = window.innerHeight * 0.72;
  const size = shown || { width: 4, height: 3 };
  const css = Math.min(width / size.width, height / size.height);
  const dense = window.devicePixelRatio || 1;
  canvas.style.width = `${size.width * css}px`;
  canvas.style.height = `${size.height * css}px`;
  canvas.width = Math.round(size.width * css * dense);
  canvas.height = Math.round(size.height * css * dense);
  view = { scale: canvas.width / size.width, css };
  draw();
}

// A picture's pixel centres are whole numbers: its left edge is at -0.5.
const place = ([u, v]) => [(u + 0.5) * view.scale, (v + 0.5) * view.scale];
const pixel = (event) => {
  const box = canvas.getBoundingClientRect();
  return [(event.clientX - box.left) / view.css - 0.5, (event.clientY - box.top) / view.css - 0.5];
};

function draw() {
  ink.clearRect(0, 0, canvas.width, canvas.height);
  const done = pictures.filter((one) => one.labelled).length;
  $("progress").textContent = pictures.length ? `${number + 1} of ${pictures.length}, ${done} labelled` : "";
  $("name").textContent = pictures.length ? pictures[number].file + (pictures[number].labelled ? " ✓" : "") : "";
  if (!shown) { $("numbers").textContent = ""; return; }
  ink.drawImage(image, 0, 0, canvas.width, canvas.height);
  const dense = window.devicePixelRatio || 1;
  for (const side of SIDES) {
    ink.strokeStyle = COLOURS[side];
    ink.lineWidth = 2 * dense;
    ink.beginPath();
    shown.lines[side].forEach((point, i) => (i ? ink.lineTo(...place(point)) : ink.moveTo(...place(point))));
    ink.stroke();
    shown.handles[side].forEach((point, which) => {
      const [x, y] = place(point), r = (which === BEND ? 6 : 9) * dense;
      ink.beginPath();
      if (which === BEND) ink.rect(x - r, y - r, 2 * r, 2 * r); else ink.arc(x, y, r, 0, 2 * Math.PI);
      ink.fillStyle = "rgba(0, 0, 0, .25)";
      ink.fill();
      ink.stroke();
    });
  }
  canvas.dataset.handles = JSON.stringify(shown.handles); // for programs that drive the page
  if (drag) magnify(shown.handles[drag.side][drag.which]);
  const m = shown.markings, sign = (x, digits) => (x < 0 ? "" : "+") + x.toFixed(digits);
  $("numbers").textContent =
    `left ${sign(m.ml, 2)} m, right ${sign(m.mr, 2)} m, width ${(m.mr - m.ml).toFixed(2)} m, ` +
    `heading ${sign(m.angle, 4)} rad, pitch ${sign(m.pitch_deg, 2)}°, ` +
    (Math.abs(m.curvature) < 1e-4 ? "straight" : `radius ${Math.round(1 / Math.abs(m.curvature))} m ${m.curvature > 0 ? "left" : "right"}`);
}

function magnify([u, v]) {
  const side = Math.min(canvas.width, canvas.height) * 0.36, zoom = 3;
  const left = place([u, v])[0] > canvas.width / 2 ? 0 : canvas.width - side;
  const fx = image.width / shown.width, half = side / zoom / 2 / view.scale;
  ink.drawImage(image, (u + 0.5 - half) * fx, (v + 0.5 - half) * fx, 2 * half * fx, 2 * half * fx, left, 0, side, side);
  ink.strokeStyle = COLOURS[drag.side];
  ink.lineWidth = 1;
  ink.strokeRect(left, 0, side, side);
  ink.beginPath();
  ink.moveTo(left + side / 2, side * 0.3); ink.lineTo(left + side / 2, side * 0.7);
  ink.moveTo(left + side * 0.3, side / 2); ink.lineTo(left + side * 0.7, side / 2);
  ink.stroke();
}

function nearest(point) {
  let best = null, least = REACH / view.css;
  for (const side of SIDES) shown.handles[side].forEach((at, which) => {
    const away = Math.hypot(at[0] - point[0], at[1] - point[1]);
    if (away < least) { least = away; best = { side, which, from: [at[0] - point[0], at[1] - point[1]] }; }
  });
  return best;
}

canvas.addEventListener("pointerdown", (event) => {
  if (!shown || working) return;
  const point = pixel(event);
  drag = nearest(point);
  if (!drag) return;
  canvas.setPointerCapture(event.pointerId);
  steps.push(structuredClone({ markings: shown.markings, lines: shown.lines, handles: shown.handles }));
  draw();
});

canvas.addEventListener("pointermove", (event) => {
  if (!drag) return;
  const [u, v] = pixel(event);
  const inside = (x, size) => Math.min(Math.max(x, 0), size - 1);
  shown.handles[drag.side][drag.which] = [inside(u + drag.from[0], shown.width), inside(v + drag.from[1], shown.height)];
  draw();
  fit();
});

for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, async () => {
  const held = drag;
  if (!held) return;
  await fit();
  if (drag === held) drag = null; // otherwise the next drag has begun
  draw();
});

// Sends one request at a time; of the positions that are dragged in the meantime, the last is sent.
async function fit() {
  if (busy) { again = true; return waiting; }
  busy = true;
  document.body.dataset.busy = "1";
  waiting = (async () => {
    try {
      do { again = false; await fitOnce(); } while (again);
    } finally { busy = false; document.body.dataset.busy = ""; }
  })();
  return waiting;
}
let waiting = Promise.resolve();

async function fitOnce() {
  if (!shown) return;
  const held = drag, of = shown;
  const body = { curvature: of.markings.curvature, pitch_deg: $("fixed").checked ? of.camera_pitch_deg : null };
  for (const side of SIDES) {
    const [near, bend, far] = of.handles[side];
    body[side] = held && held.which === BEND && held.side === side ? [near, bend, far] : [near, far];
  }
  if (held && held.which === BEND) body.curvature = null;
  try {
    const found = await (await call(`api/pictures/${number}/fit`, "POST", body)).json();
    if (of !== shown) return;
    of.markings = found.markings;
    of.lines = found.lines;
    for (const side of SIDES) of.handles[side] = of.handles[side].map((at, which) => {
      if (drag && drag.side === side && drag.which === which) return at;
      const u = across(found.lines[side], at[1]);
      return u === null || u < 0 || u > of.width - 1 ? found.handles[side][which] : [u, at[1]];
    });
    say("");
  } catch (error) { if (of === shown) say(error.message); }
  if (of === shown) draw();
}

function across(line, row) {
  for (let i = 1; i < line.length; i++) {
    const [a, b] = [line[i - 1], line[i]];
    if ((a[1] - row) * (b[1] - row) <= 0 && a[1] !== b[1]) return a[0] + ((row - a[1]) / (b[1] - a[1])) * (b[0] - a[0]);
  }
  return null;
}

const label = (markings, heading, drive, light) => ({ ...markings, heading, drive, light });

// Runs a save, an undo or a removal.
async function alone(work) {
  working = true;
  try { await work(); } catch (error) { say(error.message); } finally { working = false; }
}

async function save() {
  if (!shown) return;
  const of = number, texts = ["heading", ...FIELDS].map((id) => $(id).value);
  FIELDS.forEach(keep);
  await waiting;
  const { row, version } = await change(of, shown.version, "label", "PUT", label(shown.markings, ...texts));
  saves.push({ of, version });
  document.body.dataset.saved = row.file;
  await open(Math.min(of + 1, pictures.length - 1));
  if (of === number) say("this was the last picture");
}

// Changes the label of picture `of`. The server answers 409 if the label does not have the version
// `version` any more, because another page or program has changed it; then the picture is shown again.
async function change(of, version, path, method, body) {
  try {
    const answer = await (await call(`api/pictures/${of}/${path}?version=${version}`, method, body)).json();
    pictures[of].labelled = answer.row !== null;
    ahead.delete(of);
    return answer;
  } catch (error) {
    if (error.status === 409) {
      saves = saves.filter((one) => one.of !== of); // the server refuses to undo these too
      ahead.delete(of);
      await open(of);
    }
    throw error;
  }
}

async function undo() {
  await waiting;
  if (steps.length) { Object.assign(shown, steps.pop()); draw(); return; }
  if (!saves.length) { say("nothing to take back"); return; }
  const { of, version } = saves.at(-1);
  await change(of, version, "label/undo", "POST", {}); // the server keeps the earlier rows
  saves.pop();
  await open(of);
}

async function remove() {
  const of = number, labelled = pictures[of].labelled;
  // Without a label, the request checks that another page has not saved one.
  if (shown) {
    const { version } = await change(of, shown.version, "label", "DELETE");
    if (labelled) saves.push({ of, version });
  }
  if (!labelled) await go(1); else if (shown) await open(of);
}

async function go(by) {
  const n = number + by;
  if (n >= 0 && n < pictures.length) await open(n); else say(by < 0 ? "this is the first picture" : "this is the last picture");
}

function act(work) { if (!working) work(); }

const KEYS = {
  ArrowLeft: () => go(-1), ArrowRight: () => go(1),
  0: () => { $("heading").value = "?"; }, 1: () => { $("heading").value = "left"; },
  2: () => { $("heading").value = "straight"; }, 3: () => { $("heading").value = "right"; },
};
for (const [keys, work] of [[["Enter", "n", "N"], save], [["u", "U"], undo], [["x", "X"], remove]])
  for (const key of keys) KEYS[key] = () => alone(work);
window.addEventListener("keydown", (event) => {
  if (/^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.target.type !== "checkbox") return;
  if ((event.ctrlKey || event.metaKey) && event.key === "z") { event.preventDefault(); act(KEYS.u); return; }
  if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in KEYS)) return;
  if (event.key === "Enter" && event.target.tagName === "BUTTON") return;
  event.preventDefault();
  act(KEYS[event.key]);
});
for (const [id, key] of [["next", "n"], ["undo", "u"], ["remove", "x"], ["previous", "ArrowLeft"], ["skip", "ArrowRight"]])
  $(id).addEventListener("click", (event) => { event.currentTarget.blur(); act(KEYS[key]); });
for (const id of FIELDS) $(id).addEventListener("input", () => keep(id));
$("fixed").addEventListener("change", () => { if (shown) fit(); });
$("token").addEventListener("change", () => { token = $("token").value.trim(); sessionStorage.setItem("token", token); start(); });
window.addEventListener("resize", resize);
if (location.hash) { sessionStorage.setItem("token", token); history.replaceState(null, "", location.pathname); }
start();
