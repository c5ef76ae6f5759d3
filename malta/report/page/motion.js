// The bodies of a machine as they move in a run: turned by dragging, gone through by a scrubber, small motion magnified.
"use strict";
const data = JSON.parse(document.getElementById("motion-data").textContent);
const $ = (id) => document.getElementById(id);
const canvas = $("view"), traces = $("traces"), time = $("time"), factor = $("factor"), play = $("play"), state = $("state"), forces = $("forces");
let run = data.runs[0], frame = 0, turn = data.view[0], height = data.view[1], last = 0, running = false, hidden = new Set();
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// R_RI of Cardan angles: from the stator's frame to the body's.
function rotation([a, b, g]) {
  const [sa, ca, sb, cb, sg, cg] = [Math.sin(a), Math.cos(a), Math.sin(b), Math.cos(b), Math.sin(g), Math.cos(g)];
  return [[cg * cb, sg * ca + cg * sb * sa, sg * sa - cg * sb * ca], [-sg * cb, cg * ca - sg * sb * sa, cg * sa + sg * sb * ca], [sb, -cb * sa, cb * ca]];
}
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };

function camera() {
  const { up, across, along } = data, c = Math.cos(height);
  const eye = up.map((u, k) => c * (Math.cos(turn) * across[k] + Math.sin(turn) * along[k]) + Math.sin(height) * u);
  const right = unit(cross(up, eye));
  return [right, cross(eye, right), eye];
}

function poseOf(of) {
  const at = of.poses[Math.min(frame, of.poses.length - 1)];
  return at.map((v, j) => (of.small[j] ? of.mean[j] + magnified() * (v - of.mean[j]) : v));
}

function placed(body, of) {
  const pose = poseOf(of);
  const R = rotation(pose.slice(3));
  return body.points.map((p) => [0, 1, 2].map((j) => R[0][j] * p[0] + R[1][j] * p[1] + R[2][j] * p[2] + pose[j]));
}
const magnified = () => 10 ** Number(factor.value);

function pen(node) {
  const box = node.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
  node.width = Math.round(box.width * ratio);
  node.height = Math.round(box.height * ratio);
  const to = node.getContext("2d");
  to.scale(ratio, ratio);
  return [to, box.width, box.height];
}

function drawBodies() {
  const [to, width, tall] = pen(canvas), view = camera(), faces = [];
  const scale = Math.min(width, tall * 1.35) / (1.15 * data.reach);
  for (const [n, body] of data.bodies.entries()) {
    const points = placed(body, run.bodies[n]).map((p) => view.map((row) => dot(row, p)));
    for (const face of body.faces) {
      const [a, b, c] = face.map((n) => points[n]);
      const normal = unit(cross(b.map((v, j) => v - a[j]), c.map((v, j) => v - a[j])));
      const depth = face.reduce((sum, n) => sum + points[n][2], 0) / face.length;
      const layer = body.moves ? 1 : normal[2] > 0 ? 2 : 0;
      if (layer !== 1 || normal[2] > 0) faces.push({ layer, depth, normal, outline: face.map((n) => points[n]) });
    }
  }
  faces.sort((one, other) => one.layer - other.layer || one.depth - other.depth);
  for (const { layer, normal, outline } of faces) {
    to.beginPath();
    outline.forEach(([x, y], n) => to[n ? "lineTo" : "moveTo"](width / 2 + scale * x, tall / 2 - scale * y));
    to.closePath();
    if (layer === 1) {
      const light = 0.62 + 0.38 * Math.max(0, dot(normal, [0.25, 0.6, 0.75]));
      to.fillStyle = to.strokeStyle = `rgb(${[86, 143, 196].map((part) => Math.round(part * light)).join(" ")})`;
      to.fill();
      to.lineWidth = 0.5;
    } else { to.strokeStyle = css(layer ? "--soft" : "--line"); to.lineWidth = 1; }
    to.stroke();
  }
  if (forces.getAttribute("aria-pressed") === "true")
    drawArrows(to, view, scale, ([x, y]) => [width / 2 + scale * x, tall / 2 - scale * y], tall);
}

// Forces and torques of the actuators, each from the middle of its body, and the arrow of each unit's scale.
function drawArrows(to, view, scale, toPixels, tall) {
  for (const one of run.arrows) {
    const start = poseOf(run.bodies[one.body]).slice(0, 3), end = start.map((v, j) => v + (one.scale && (data.arrow * one.values[frame][j]) / one.scale));
    const [from, tip] = [start, end].map((p) => toPixels(view.map((row) => dot(row, p))));
    drawArrow(to, from, tip, one.unit);
  }
  const scales = new Map(run.arrows.filter((one) => one.scale).map((one) => [one.unit, one.scale]));
  [...scales].forEach(([name, size], row) => {
    const y = tall - 14 - 20 * row, length = scale * data.arrow;
    drawArrow(to, [12, y], [12 + length, y], name);
    to.font = "12px system-ui, sans-serif";
    to.textAlign = "left";
    to.fillText(`${digits(size)} ${name}`, 20 + length, y + 4);
  });
}

const HEAD = 9; // px
function drawArrow(to, [x, y], [u, v], name) {
  const length = Math.hypot(u - x, v - y), torque = name !== "N";
  to.fillStyle = css(torque ? "--c2" : "--c1");
  if (length < 2) return;
  const [a, b] = [(u - x) / length, (v - y) / length], head = Math.min(HEAD, length);
  to.beginPath();
  to.moveTo(x, y);
  to.lineTo(u - (a * head) / 2, v - (b * head) / 2);
  for (const [ink, wide] of [[css("--page"), 6], [to.fillStyle, 3]]) { to.strokeStyle = ink; to.lineWidth = wide; to.stroke(); }
  for (const back of torque ? [0, head] : [0]) {
    const [p, q] = [u - a * back, v - b * back];
    to.beginPath();
    to.moveTo(p, q);
    to.lineTo(p - a * head - 0.45 * b * head, q - b * head + 0.45 * a * head);
    to.lineTo(p - a * head + 0.45 * b * head, q - b * head - 0.45 * a * head);
    to.fill();
  }
}

// Traces of all signals of one unit above each other, with a line at the frame.
function drawTraces() {
  const [to, width, tall] = pen(traces), left = 70, right = width - 8, end = run.t[run.t.length - 1], start = run.t[0];
  const units = [...new Set(run.signals.map((one) => one.unit))], each = tall / units.length;
  const toX = (t) => left + ((right - left) * (t - start)) / (end - start || 1);
  to.font = "12px system-ui, sans-serif";
  units.forEach((name, row) => {
    const shown = run.signals.filter((one) => one.unit === name && !hidden.has(one.name));
    const values = shown.flatMap((one) => one.values);
    let low = Math.min(0, ...values), high = Math.max(0, ...values);
    if (low === high) high = low + 1;
    const toY = (v) => (row + 1) * each - 8 - ((each - 22) * (v - low)) / (high - low);
    to.fillStyle = css("--soft");
    to.textAlign = "right";
    to.fillText(digits(high), left - 6, toY(high) + 8);
    to.fillText(digits(low), left - 6, toY(low));
    to.textAlign = "left";
    to.fillText(name, 2, toY((low + high) / 2) + 4);
    to.strokeStyle = css("--line");
    to.strokeRect(left, toY(high), right - left, toY(low) - toY(high));
    for (const one of shown) {
      to.beginPath();
      one.values.forEach((v, k) => to[k ? "lineTo" : "moveTo"](toX(run.t[k]), toY(v)));
      to.strokeStyle = css(`--c${one.k % 4}`);
      to.setLineDash([[], [7, 3], [2, 3], [9, 3, 2, 3]][one.k % 4]);
      to.lineWidth = 1.5;
      to.stroke();
      to.setLineDash([]);
    }
  });
  to.strokeStyle = css("--text");
  to.beginPath();
  to.moveTo(toX(run.t[frame]), 0);
  to.lineTo(toX(run.t[frame]), tall);
  to.stroke();
}
const digits = (v) => (Math.abs(v) >= 1e5 || (v && Math.abs(v) < 1e-3) ? v.toExponential(2) : String(Number(v.toPrecision(4)))).replace("-", "−");

function draw() {
  time.value = frame;
  time.setAttribute("aria-valuetext", `${digits(1e3 * run.t[frame])} ms`);
  state.textContent = `${digits(1e3 * run.t[frame])} ms, small motion × ${digits(Number(magnified().toPrecision(2)))}`;
  for (const one of run.signals) one.cell.textContent = digits(one.values[frame]);
  drawBodies();
  drawTraces();
}

function step(now) {
  if (!running) return;
  if (now - last > 40) { last = now; frame = (frame + 1) % run.t.length; draw(); }
  requestAnimationFrame(step);
}

function signalButton(one) {
  const button = document.createElement("button"), pressed = () => button.setAttribute("aria-pressed", String(!hidden.has(one.name)));
  one.cell = document.createElement("b");
  button.type = "button";
  button.title = "show or hide";
  button.style.borderLeft = `4px solid var(--c${one.k % 4})`;
  button.append(`${one.name} `, one.cell, ` ${one.unit}`);
  button.addEventListener("click", () => { if (!hidden.delete(one.name)) hidden.add(one.name); pressed(); draw(); });
  pressed();
  return button;
}

// Show a run from its beginning, small motion magnified as its size asks.
function show(chosen) {
  run = chosen;
  frame = 0;
  time.max = run.t.length - 1;
  factor.max = Math.log10(Math.max(10, 10 * run.factor));
  factor.value = Math.log10(run.factor);
  $("signals").replaceChildren(...run.signals.map(signalButton));
  for (const [k, button] of [...$("runs").children].entries()) button.setAttribute("aria-pressed", String(data.runs[k] === run));
  $("ended").textContent = run.ended ? `${run.name}: ${run.ended}` : run.name;
  draw();
}

if (data.runs.length > 1)
  $("runs").replaceChildren(...data.runs.map((one) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = one.name;
    button.addEventListener("click", () => show(one));
    return button;
  }));
time.addEventListener("input", () => { frame = Number(time.value); draw(); });
factor.addEventListener("input", draw);
forces.hidden = !data.runs.some((one) => one.arrows.length);
forces.addEventListener("click", () => { forces.setAttribute("aria-pressed", String(forces.getAttribute("aria-pressed") !== "true")); draw(); });
play.addEventListener("click", () => { running = !running; play.textContent = running ? "Pause" : "Play"; if (running) requestAnimationFrame(step); });
canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons) return;
  turn -= event.movementX / 150;
  height = Math.max(-1.5, Math.min(1.5, height + event.movementY / 150));
  draw();
});
traces.addEventListener("pointermove", (event) => {
  const box = traces.getBoundingClientRect(), share = (event.clientX - box.left - 70) / (box.width - 78);
  if (event.buttons || event.pointerType === "mouse") { frame = Math.max(0, Math.min(run.t.length - 1, Math.round(share * (run.t.length - 1)))); draw(); }
});
for (const media of ["(prefers-color-scheme: dark)", "print"]) matchMedia(media).addEventListener("change", draw);
window.addEventListener("resize", draw);
show(run);
