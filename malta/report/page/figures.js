// Figures of a page that answer: values under the pointer, cursors linked over all panels of one axis, zoom, channels.
"use strict";
const figures = JSON.parse(document.getElementById("panels-of-figures").textContent);
const SPACE = "http://www.w3.org/2000/svg";
const panels = []; // {svg, axes, lines, cursor, dots}
const digits = (v) => (!Number.isFinite(v) ? "" : v && (Math.abs(v) >= 1e5 || Math.abs(v) < 1e-3) ? v.toExponential(2) : String(Number(v.toPrecision(4)))).replace("-", "−");

// Positions along an axis: to the scaled value and back, as matplotlib has them.
const scales = {
  linear: () => [(v) => v, (s) => s],
  log: () => [(v) => Math.log10(v), (s) => 10 ** s],
  symlog: ({ linear, slope }) => [
    (v) => (Math.abs(v) <= linear ? v * slope : Math.sign(v) * linear * (slope + Math.log10(Math.abs(v) / linear))),
    (s) => (Math.abs(s) <= linear * slope ? s / slope : Math.sign(s) * linear * 10 ** (Math.abs(s) / linear - slope)),
  ],
};
function axis(one, from, to) {
  const [forth, back] = scales[one.scale](one), a = forth(one.low), b = forth(one.high);
  return { place: (v) => from + ((forth(v) - a) / (b - a)) * (to - from), value: (p) => back(a + ((p - from) / (to - from)) * (b - a)) };
}

// The points of a path of straight pieces, in the picture's own units.
function pointsOf(node) {
  const d = node?.querySelector("path")?.getAttribute("d") ?? "";
  return [...d.matchAll(/([ML]) ?(-?[\d.]+)[ ,](-?[\d.]+)/g)].flatMap(([, pen, x, y]) => [...(pen === "M" ? [[NaN, NaN]] : []), [Number(x), Number(y)]]);
}
const make = (name, attributes) => {
  const node = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
};

const readout = document.createElement("div");
readout.className = "readout";
readout.hidden = true;
document.body.append(readout);

// The point of a line at px, the nearest to py of several; or the nearest point of it. Straight pieces have few points.
function nearest(points, px, py, along) {
  let best = null, least = Infinity;
  for (let k = 0; k < points.length; k++) {
    const [ax, ay] = points[k], [bx, by] = points[k + 1] ?? points[k], dx = bx - ax, dy = by - ay;
    let share = along ? (dx ? (px - ax) / dx : 0) : dx || dy ? ((px - ax) * dx + (py - ay) * dy) / (dx * dx + dy * dy) : 0;
    share = Math.max(0, Math.min(1, share));
    const x = ax + share * dx, y = ay + share * dy;
    const far = along ? 1e3 * Math.abs(x - px) + Math.abs(y - py) : Math.hypot(x - px, y - py);
    if (far < least) { least = far; best = { x, y }; }
  }
  return best && { ...best, far: Math.hypot(best.x - px, best.y - py) };
}

function clear() {
  readout.hidden = true;
  for (const panel of panels) panel.marks.replaceChildren();
}

// The value of every line of a panel at a place along x; panels of another figure with the same axis follow.
function look(panel, event) {
  const box = new DOMPoint(event.clientX, event.clientY).matrixTransform(panel.svg.getScreenCTM().inverse());
  const value = panel.toX.value(box.x);
  clear();
  for (const other of panels) {
    if (other !== panel && (!other.along || other.axes.x.label !== panel.axes.x.label || !panel.along)) continue;
    const at = other.toX.place(value), { left, right, top, bottom } = other.axes;
    if (!(at >= left - 0.1 && at <= right + 0.1)) continue;
    if (other.along) other.marks.append(make("path", { d: `M${at} ${top}V${bottom}`, class: "hair" }));
    const found = other.lines.filter((line) => !line.node.classList.contains("off"))
      .map((line) => ({ line, ...nearest(line.points, other === panel || !other.along ? box.x : at, box.y, other.along) }))
      .filter((one) => one.far !== undefined && (other.along ? Math.abs(one.x - at) < 1 : one.far < 25));
    if (!other.along) found.sort((a, b) => a.far - b.far).splice(1);
    for (const one of found) other.marks.append(make("circle", { cx: one.x, cy: one.y, r: 3, class: "dot" }));
    if (other === panel) tell(panel, found, event);
  }
}

// The frequency at a place of a curve that knows it, as of a Nyquist plot.
function frequencyAt(line, x, y) {
  if (!line.told?.length) return "";
  const far = ([, re, im]) => Math.hypot(re - x, im - y), [w] = line.told.reduce((one, other) => (far(other) < far(one) ? other : one));
  return ` at ${digits(w)} rad/s (${digits(w / (2 * Math.PI))} Hz)`;
}

function tell(panel, found, event) {
  const { x, y } = panel.axes;
  const rows = found.map(({ line, x: px, y: py }) => `${line.label ? `${line.label.replace(/:/g, "")}: ` : ""}${panel.along ? "" : `${digits(panel.toX.value(px))}, `}${digits(panel.toY.value(py))}${panel.along ? "" : frequencyAt(line, panel.toX.value(px), panel.toY.value(py))}`);
  if (!rows.length) return;
  const head = panel.along ? x.label.replace(/^(\w+)(?: \[(.*)\])?$/, (_, name, unit) => `${name} ${digits(panel.toX.value(found[0].x))} ${unit ?? ""}`) : `${x.label}, ${y.label}`;
  readout.replaceChildren(...[head, ...rows, ...(panel.along ? [y.label] : [])].filter(Boolean).map((text, k) => {
    const line = document.createElement(k ? "div" : "b");
    line.textContent = text;
    return line;
  }));
  readout.hidden = false;
  const wide = readout.offsetWidth, beside = event.clientX + 16 + wide > innerWidth ? event.clientX - 16 - wide : event.clientX + 16;
  readout.style.left = `${Math.max(4, beside)}px`;
  readout.style.top = `${Math.min(event.clientY + 12, innerHeight - readout.offsetHeight - 4)}px`;
}

// A rectangle that is drawn with the pointer fills the figure; a double click shows all of it.
function zoomable(svg, own) {
  const whole = svg.getAttribute("viewBox");
  let from = null, frame = null;
  const place = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  svg.addEventListener("pointerdown", (event) => {
    if (event.button || event.pointerType === "touch" || event.target.closest(".channel")) return;
    from = place(event);
    frame = make("rect", { class: "frame" });
    svg.append(frame);
    event.preventDefault();
  });
  svg.addEventListener("pointermove", (event) => {
    const at = place(event);
    if (from) for (const [key, value] of Object.entries({ x: Math.min(from.x, at.x), y: Math.min(from.y, at.y), width: Math.abs(at.x - from.x), height: Math.abs(at.y - from.y) })) frame.setAttribute(key, value);
    const panel = own.find(({ axes: a }) => at.x >= a.left && at.x <= a.right && at.y >= a.top && at.y <= a.bottom);
    if (panel) look(panel, event);
    else clear();
  });
  const end = (event) => {
    if (!from) return;
    const at = place(event), [width, height] = [Math.abs(at.x - from.x), Math.abs(at.y - from.y)];
    if (width > 12 && height > 12) svg.setAttribute("viewBox", `${Math.min(from.x, at.x)} ${Math.min(from.y, at.y)} ${width} ${height}`);
    frame.remove();
    from = null;
  };
  svg.addEventListener("pointerup", end);
  svg.addEventListener("pointerleave", (event) => { end(event); clear(); });
  svg.addEventListener("dblclick", () => svg.setAttribute("viewBox", whole));
  addEventListener("beforeprint", () => svg.setAttribute("viewBox", whole));
}

// An entry of a legend hides and shows the lines of its name, or of its style where they bear none.
function channels(one, lines) {
  for (const entry of one.legend) {
    const node = document.getElementById(entry.id);
    const own = lines.filter((line) => line.label === entry.label);
    if (!node || !own.length) continue;
    node.classList.add("channel");
    node.closest("svg").setAttribute("role", "group"); // no picture any more: parts of it are pressed
    node.setAttribute("tabindex", "0");
    node.setAttribute("role", "button");
    node.setAttribute("aria-pressed", "true");
    const toggle = () => {
      const off = node.classList.toggle("off");
      node.setAttribute("aria-pressed", String(!off));
      for (const line of own) line.node.classList.toggle("off", off);
    };
    node.addEventListener("click", toggle);
    node.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); toggle(); } });
  }
}

document.querySelectorAll("figure svg").forEach((svg, k) => {
  const one = figures[k], lines = one.lines.map((line) => ({ ...line, told: line.points, node: document.getElementById(line.id) })).filter((line) => line.node);
  for (const line of lines) line.points = pointsOf(line.node);
  const own = one.axes.map((axes, n) => {
    const marks = make("g", { class: "marks" });
    svg.append(marks);
    return { svg, axes, marks, along: axes.along, lines: lines.filter((line) => line.axes === n), toX: axis(axes.x, axes.left, axes.right), toY: axis(axes.y, axes.bottom, axes.top) };
  });
  panels.push(...own);
  zoomable(svg, own);
  channels(one, lines);
});

// A click on the caption of a table folds it; on paper it is whole.
for (const caption of document.querySelectorAll(".caption")) {
  const table = caption.nextElementSibling;
  if (!table?.matches(".scroll")) continue;
  caption.classList.add("fold");
  caption.setAttribute("tabindex", "0");
  caption.setAttribute("role", "button");
  caption.setAttribute("aria-expanded", "true");
  const fold = () => caption.setAttribute("aria-expanded", String(!table.classList.toggle("folded")));
  caption.addEventListener("click", fold);
  caption.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); fold(); } });
}
