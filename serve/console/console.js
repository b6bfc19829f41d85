// The console: sends images, frames of a film, or webcam pictures to the service; shows the answers.

import { IN_LANE, ON_MARKING } from "./geometry.js";
import { absence, drawAbove, drawLatency, drawPicture } from "./drawing.js";
import { createLive } from "./live.js";

const KEPT = 120, EVERY_MS = 100;
const $ = (id) => document.getElementById(id);
let model = null; // the model card
const latencies = [];
let current = null; // {body, image, truth}
let asking = false;

$("base").textContent = location.origin;

const authorization = () => ($("token").value ? { Authorization: `Bearer ${$("token").value}` } : {});

// The text of a refusal. After a 401 the token's field is visible.
function problem(reply, answer) {
  if (reply.status !== 401) return `${answer.title ?? reply.statusText}: ${answer.detail ?? ""}`;
  $("locked").hidden = false;
  return $("token").value ? "the service has another token" : "enter the service's token below the picture";
}

// Loads and shows the model card, then sends the current picture.
async function loadModel() {
  const reply = await fetch("model", { headers: authorization() });
  const answer = await reply.json();
  if (!reply.ok) {
    $("model").textContent = problem(reply, answer);
    return;
  }
  model = answer;
  $("model").textContent =
    `model ${model.model.slice(0, 12)}, ${model.engine} ${model.precision}, ` +
    `camera ${model.camera.width} × ${model.camera.height}, ${model.camera.fov_y_deg}° vertical`;
  const named = Object.keys(model.cameras ?? {}).map((name) => new Option(name, name));
  $("camera").replaceChildren($("camera").firstElementChild, ...named);
  $("cameras").hidden = !named.length;
  await ask();
}

async function ask() {
  if (!current || asking) return;
  if (!model) return refuse($("model").textContent, current.image);
  asking = true;
  const { body, image, truth } = current;
  const started = performance.now();
  try {
    const headers = { "Content-Type": body.type };
    const named = $("camera").value;
    if (named) headers["X-Camera"] = named;
    Object.assign(headers, authorization());
    const reply = await fetch("features", { method: "POST", headers, body });
    const answer = await reply.json();
    if (!reply.ok) return refuse(problem(reply, answer), image);
    latencies.push({ trip: performance.now() - started, total: answer.timing_ms.total, ...answer.timing_ms });
    latencies.splice(0, latencies.length - KEPT);
    show(image, answer, truth, named);
  } catch (error) {
    refuse(`no answer: ${error.message}`, image);
  } finally {
    asking = false;
  }
}

function refuse(text, image) {
  $("status").textContent = text;
  $("status").className = "bad";
  $("picture").getContext("2d").drawImage(image, 0, 0, $("picture").width, $("picture").height);
}

function show(image, answer, truth, named) {
  const camera = model.cameras?.[named] ?? model.camera;
  drawPicture($("picture"), image, answer, truth, camera, Boolean(named));
  drawAbove($("above"), answer, truth);
  drawLatency($("latency"), latencies, KEPT);
  const offset = answer.to_lane_centre_m;
  $("status").className = "";
  $("status").textContent = offset == null
    ? "No lane is near."
    : `${Math.abs(offset).toFixed(2)} m ${offset >= 0 ? "left" : "right"} of the lane's centre, ` +
      `pointing ${Math.abs(answer.angle_rad * 180 / Math.PI).toFixed(1)}° to the ${answer.angle_rad >= 0 ? "right" : "left"}.`;
  fillTable(answer, truth);
  fillHeading(answer.heading);
  $("foreign").hidden = !answer.out_of_distribution;
  const sorted = latencies.map((row) => row.trip).sort((a, b) => a - b);
  const at = (share) => sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))].toFixed(1);
  const last = latencies.at(-1);
  $("times").textContent =
    `service ${last.total.toFixed(1)} ms (decode ${last.decode.toFixed(1)}, forward ${last.forward.toFixed(1)}); ` +
    `with the network p50 ${at(0.5)}, p99 ${at(0.99)} ms over ${sorted.length}`;
}

function fillTable(answer, truth) {
  const rows = [...IN_LANE, ...ON_MARKING].map((name) =>
    [name, answer.distances_m[name], answer.std?.[name], truth?.distances_m[name], "m", 2]);
  rows.push(["to lane centre", answer.to_lane_centre_m, answer.std?.to_lane_centre, truth?.to_lane_centre_m, "m", 2]);
  rows.push(["angle", answer.angle_rad, answer.std?.angle, truth?.angle_rad, "rad", 4]);
  const absent = (name) => absence(answer, name);
  const text = (value, digits) => (value == null ? "–" : value.toFixed(digits));
  $("features").replaceChildren(...rows.map(([name, read, std, true_, unit, digits]) => {
    const row = document.createElement("tr");
    for (const [content, kind] of [[name], [absent(name) ?? text(read, digits)], [text(std, digits), "std"], [text(true_, digits), "truth"]]) {
      const cell = document.createElement("td");
      cell.textContent = content;
      if (kind) cell.className = kind;
      row.append(cell);
    }
    const small = document.createElement("small");
    small.textContent = ` ${unit}`;
    if (!absent(name)) row.children[1].append(small);
    return row;
  }));
  const table = $("features").parentElement;
  table.classList.toggle("no-std", !answer.std);
  table.classList.toggle("no-truth", !truth);
}

function fillHeading(heading) {
  $("heading").replaceChildren(...Object.entries(heading).flatMap(([name, share]) => {
    const [word, bar, figure] = ["span", "span", "span"].map((tag) => document.createElement(tag));
    word.textContent = name;
    bar.className = "bar";
    const fill = document.createElement("i");
    fill.style.width = `${100 * share}%`;
    bar.append(fill);
    figure.textContent = `${(100 * share).toFixed(0)} %`;
    return [word, bar, figure];
  }));
}

async function take(body, truth = null) {
  try {
    const image = await createImageBitmap(body);
    current = { body, image, truth };
    await ask();
  } catch {
    $("status").textContent = "The browser cannot read this file as an image.";
    $("status").className = "bad";
  }
}

function press(button) {
  for (const other of $("samples").children) other.setAttribute("aria-pressed", other === button);
}

function takeFile(file) {
  if (!file) return;
  press(null);
  if (file.type.startsWith("video/")) return live.film(file);
  live.stop();
  take(file);
}

const live = createLive($("video"), async (next) => {
  current = next;
  await ask();
}, (text) => {
  $("status").textContent = text;
  $("status").className = "bad";
});
for (const [event, running] of [["started", true], ["stopped", false]]) {
  $("video").addEventListener(event, () => {
    $("stop").hidden = !running;
    $("webcam").hidden = running;
  });
}
$("webcam").addEventListener("click", () => {
  press(null);
  live.webcam();
});
$("stop").addEventListener("click", live.stop);

$("file").addEventListener("change", (event) => {
  takeFile(event.target.files[0]);
  event.target.value = ""; // so that the same file can be chosen again
});
const stage = document.querySelector(".picture");
for (const kind of ["dragover", "dragleave", "drop"]) {
  stage.addEventListener(kind, (event) => {
    event.preventDefault();
    stage.classList.toggle("over", kind === "dragover");
    if (kind === "drop") takeFile(event.dataTransfer.files[0]);
  });
}
$("token").addEventListener("change", loadModel);
$("camera").addEventListener("change", ask);
setInterval(() => $("repeat").checked && ask(), EVERY_MS);

const samples = await (await fetch("console/samples.json")).json();
for (const { file, about, truth } of samples) {
  const button = document.createElement("button");
  const picture = document.createElement("img");
  picture.src = `console/${file}`;
  picture.alt = about;
  button.title = about;
  button.append(picture);
  button.addEventListener("click", async () => {
    press(button);
    live.stop();
    take(await (await fetch(picture.src)).blob(), truth);
  });
  $("samples").append(button);
}
document.documentElement.dataset.ready = "yes";
await loadModel();
$("samples").firstElementChild?.click();
