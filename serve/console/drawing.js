// Draws the canvases: the image with its markings, the car from above, the latencies.

import { IN_LANE, ON_MARKING, onMarking, project, seenPart } from "./geometry.js";

const AHEAD_M = [3, 28]; // the lines assume a straight and level road, so they must be short

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

// The present markings: [name, distance in m, standard deviation in m or null].
function present(answer) {
  return [...IN_LANE, ...ON_MARKING]
    .filter((name) => answer.distances_m[name] != null)
    .map((name) => [name, answer.distances_m[name], answer.std?.[name] ?? null]);
}

// The table's text for an absent marking, null for a present one. The service decides which markings
// are absent: its limit of the probability differs between markings.
export function absence(answer, name) {
  if (!answer.absent || answer.distances_m[name] !== null) return null;
  return `absent, ${(100 * answer.absent[name]).toFixed(0)} %`;
}

function paintOf(name) {
  return colour(IN_LANE.includes(name) ? "lane" : "marking");
}

// `whole`: the image shows exactly the view of `camera`; otherwise the service crops its middle.
export function drawPicture(canvas, image, answer, truth, camera, whole = false) {
  const context = canvas.getContext("2d");
  canvas.height = Math.round(canvas.width * image.height / image.width);
  canvas.style.aspectRatio = `${image.width} / ${image.height}`;
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  const part = whole ? { x: 0, w: canvas.width } : seenPart(canvas.width, canvas.height, camera);
  const scale = part.w / camera.width;
  const line = (distance, angle) => {
    const points = [];
    for (let x = AHEAD_M[0]; x <= AHEAD_M[1]; x += 0.5) {
      const pixel = project(onMarking(distance, angle, x), camera);
      if (pixel) points.push([part.x + pixel[0] * scale, pixel[1] * scale]);
    }
    context.beginPath();
    points.forEach(([u, v], k) => (k ? context.lineTo(u, v) : context.moveTo(u, v)));
    context.stroke();
    return points;
  };
  context.lineCap = "round";
  context.lineWidth = 5;
  context.font = "600 26px system-ui, sans-serif";
  for (const [name, distance] of present(answer)) {
    context.strokeStyle = paintOf(name);
    const low = line(distance, answer.angle_rad).find(([, v]) => v < canvas.height - 14);
    if (low) label(context, name, Math.min(Math.max(low[0], 30), canvas.width - 50), low[1]);
  }
  if (truth) {
    context.setLineDash([3, 12]);
    context.lineWidth = 5;
    context.strokeStyle = colour("truth");
    for (const [, distance] of present(truth)) line(distance, truth.angle_rad);
    context.setLineDash([]);
  }
}

function label(context, text, u, v) {
  context.lineWidth = 6;
  const paint = context.strokeStyle;
  context.strokeStyle = "#000b";
  context.strokeText(text, u + 10, v);
  context.fillStyle = "#fff";
  context.fillText(text, u + 10, v);
  context.strokeStyle = paint;
  context.lineWidth = 5;
}

// The car points up; one metre is `scale` pixels in both directions.
export function drawAbove(canvas, answer, truth) {
  const context = canvas.getContext("2d"), scale = 26;
  const middle = canvas.width / 2, car = canvas.height - 120;
  const at = ([x, y]) => [middle - y * scale, car - x * scale];
  context.fillStyle = "#5b6066";
  context.fillRect(0, 0, canvas.width, canvas.height);
  const line = (distance, angle, dash, width, paint) => {
    context.setLineDash(dash);
    context.lineWidth = width;
    context.strokeStyle = paint;
    context.beginPath();
    context.moveTo(...at(onMarking(distance, angle, -6)));
    context.lineTo(...at(onMarking(distance, angle, 32)));
    context.stroke();
    context.setLineDash([]);
  };
  const all = present(answer);
  for (const [name, distance, sigma] of all) {
    if (sigma) line(distance, answer.angle_rad, [], 2 * sigma * scale, paintOf(name) + "44");
  }
  context.font = "600 20px system-ui, sans-serif";
  for (const [name, distance] of all) {
    line(distance, answer.angle_rad, [], 4, paintOf(name));
    const [u] = at(onMarking(distance, answer.angle_rad, 0));
    const left = distance < 0, text = `${name} ${Math.abs(distance).toFixed(2)} m`;
    context.textAlign = left ? "right" : "left";
    context.fillStyle = "#fff";
    // in two rows, since in-lane and on-marking distances can both be present
    context.fillText(text, left ? u - 10 : u + 10, car + (IN_LANE.includes(name) ? 50 : 85));
  }
  if (truth) for (const [, d] of present(truth)) line(d, truth.angle_rad, [3, 12], 4, "#8ce99a");
  drawCar(context, middle, car, scale);
  const offset = answer.to_lane_centre_m;
  if (offset != null) {
    // `offset` is positive if the car is left of the centre: the centre is then right of the car
    const target = at(onMarking(offset, answer.angle_rad, 9));
    context.strokeStyle = context.fillStyle = "#ffe066";
    context.lineWidth = 3;
    context.beginPath();
    context.moveTo(middle, car - 2.4 * scale);
    context.lineTo(...target);
    context.stroke();
    context.beginPath();
    context.arc(...target, 6, 0, 7);
    context.fill();
  }
}

function drawCar(context, u, v, scale) {
  const wide = 1.94 * scale, long = 4.52 * scale, front = v - 2.3 * scale;
  context.fillStyle = "#e9ecef";
  context.beginPath();
  context.roundRect(u - wide / 2, front, wide, long, 12);
  context.fill();
  context.fillStyle = "#343a40";
  context.beginPath();
  context.roundRect(u - wide * 0.4, front + long * 0.27, wide * 0.8, long * 0.16, 5);
  context.roundRect(u - wide * 0.36, front + long * 0.78, wide * 0.72, long * 0.1, 4);
  context.fill();
}

// `rows`: {total, trip} in ms, the newest last. Each bar shows the service's part of the round trip.
export function drawLatency(canvas, rows, shown) {
  const context = canvas.getContext("2d"), { width, height } = canvas, foot = height - 8;
  context.clearRect(0, 0, width, height);
  const top = Math.max(5, ...rows.map((row) => row.trip)) * 1.15, step = width / shown;
  context.font = "36px system-ui, sans-serif";
  for (const share of [0.5, 1]) {
    const value = niceBelow(top * share), y = foot - (value / top) * (foot - 10);
    context.fillStyle = colour("line");
    context.fillRect(0, y, width, 1.5);
    context.fillStyle = colour("quiet");
    context.fillText(`${value} ms`, 6, y + 40);
  }
  rows.forEach((row, k) => {
    const x = width - (rows.length - k) * step;
    const bar = (ms, name) => {
      const tall = (ms / top) * (foot - 10);
      context.fillStyle = colour(name);
      context.fillRect(x, foot - tall, Math.max(step - 1.5, 1), tall);
    };
    bar(row.trip, "line");
    bar(row.total, "lane");
  });
}

function niceBelow(value) {
  const unit = 10 ** Math.floor(Math.log10(value));
  return Math.floor(value / unit) * unit;
}
