// A chart in SVG: axes with ticks, lines, points, shapes; a readout that follows the pointer or the arrow keys; handles
// that are pulled; a range that is zoomed into with the pointer or with + - 0.

import { linearTicks, logTicks, tickLabel } from "./numbers.js";

const NAMESPACE = "http://www.w3.org/2000/svg";
const MARGIN = { left: 56, right: 12, top: 8, bottom: 34 };
const BESIDE = { right: 44, top: 21 }; // of an axis that stands in Hz at the other side of the frame
const TURN = 2 * Math.PI;
const LETTER = 6; // px of a letter of a bound's name, at most
let charts = 0;

export function svg(name, attributes = {}, text = "") {
  const node = document.createElementNS(NAMESPACE, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text) node.textContent = text;
  return node;
}

// A short piece of a line, for a legend.
export function stroke(dash) {
  const node = svg("svg", { width: 24, height: 6 });
  node.append(svg("path", { d: "M0 3H24", "stroke-width": 2.6, ...(dash ? { "stroke-dasharray": dash } : {}) }));
  return node;
}

// Positions on an axis: value -> pixels.
function axisScale(axis, from, to) {
  const [low, high] = axis.log ? [Math.log(axis.min), Math.log(axis.max)] : [axis.min, axis.max];
  const slope = (to - from) / (high - low);
  return (value) => from + ((axis.log ? Math.log(Math.max(value, 1e-300)) : value) - low) * slope;
}

// The same step along both axes: the range of one is widened about its middle.
function equalAxes(x, y, width, height) {
  const perPixel = Math.max((x.max - x.min) / width, (y.max - y.min) / height);
  const widen = (axis, size) => {
    const middle = (axis.min + axis.max) / 2, half = (perPixel * size) / 2;
    return { ...axis, min: middle - half, max: middle + half };
  };
  return [widen(x, width), widen(y, height)];
}

function pathOf(xs, ys, toX, toY) {
  let text = "", pen = false;
  for (let k = 0; k < xs.length; k++) {
    if (xs[k] === null || ys[k] === null) { pen = false; continue; }
    const px = toX(xs[k]), py = toY(ys[k]);
    if (!Number.isFinite(px) || !Number.isFinite(py) || Math.abs(py) > 1e5 || Math.abs(px) > 1e5) { pen = false; continue; }
    text += `${pen ? "L" : "M"}${px.toFixed(1)} ${py.toFixed(1)}`;
    pen = true;
  }
  return text;
}

const MARKS = {
  x: (s) => `M${-s} ${-s}L${s} ${s}M${-s} ${s}L${s} ${-s}`,
  "+": (s) => `M${-s} 0L${s} 0M0 ${-s}L0 ${s}`,
  o: (s) => `M${-s} 0A${s} ${s} 0 1 0 ${s} 0A${s} ${s} 0 1 0 ${-s} 0`,
  s: (s) => `M${-s} ${-s}L${s} ${-s}L${s} ${s}L${-s} ${s}L${-s} ${-s}`,
};

// A chart that fills its node. draw(view) draws
//   x, y: {label, min, max, log, hertz}; equal: one scale for both; hertz: of an axis in rad/s, Hz at the other side as well
//   lines: {name, xs, ys, color, dash, width, faint}; points: {name, xs, ys, mark, color, faint}
//   handles: {key, x, y, color, label, value, pull(x, y, done)}: dots that can be dragged, or moved by arrow keys
//   shapes: {kind: "circle" | "band" | "line" | "ray" | "text" | "area" | "region", ...}; pick(x, y): what a click does
//   read(line, k): rows of the readout; nearest: "x" along the axis, "xy" the nearest point
export function createChart(label) {
  const node = document.createElement("div");
  node.className = "chart";
  node.tabIndex = 0;
  node.setAttribute("role", "group");
  const picture = svg("svg", { "aria-hidden": "true" });
  const readout = document.createElement("div");
  readout.className = "readout";
  readout.hidden = true;
  readout.setAttribute("role", "status");
  node.append(picture, readout);
  const clip = `malta-clip-${++charts}`;
  let view = null, shown = null, at = null;
  let zoom = null; // {words, x: [low, high], y: [low, high]}: what is looked at of the axes with these words
  let held = null; // what the pointer holds: {handle, left, top} or the corner of a box {from, left, top}
  const handles = new Map(); // buttons by key: they keep the focus while the curves move

  function layout() {
    const width = node.clientWidth, height = node.clientHeight;
    let { x, y } = view;
    const right = width - (y.hertz ? BESIDE : MARGIN).right, bottom = height - MARGIN.bottom, top = (x.hertz ? BESIDE : MARGIN).top;
    if (zoom && zoom.words !== x.label + y.label) zoom = null;
    if (zoom) [x, y] = [{ ...x, min: zoom.x[0], max: zoom.x[1] }, { ...y, min: zoom.y[0], max: zoom.y[1] }];
    if (view.equal) [x, y] = equalAxes(x, y, right - MARGIN.left, bottom - top);
    return {
      width, height, right, bottom, top, x, y, named: [],
      toX: axisScale(x, MARGIN.left, right),
      toY: axisScale(y, bottom, top),
    };
  }

  function drawAxes(group, s) {
    const { x, y, toX, toY, right, bottom, top } = s;
    const ticksOf = (axis, most) => (axis.log ? logTicks(axis.min, axis.max) : { major: linearTicks(axis.min, axis.max, most), minor: [] });
    const across = ticksOf(x, Math.max(3, (right - MARGIN.left) / 60)), up = ticksOf(y, Math.max(3, (bottom - top) / 36));
    let fine = "", grid = "";
    for (const t of across.minor) fine += `M${toX(t).toFixed(1)} ${top}V${bottom}`;
    for (const t of up.minor) fine += `M${MARGIN.left} ${toY(t).toFixed(1)}H${right}`;
    for (const t of across.major) grid += `M${toX(t).toFixed(1)} ${top}V${bottom}`;
    for (const t of up.major) grid += `M${MARGIN.left} ${toY(t).toFixed(1)}H${right}`;
    group.append(svg("path", { class: "grid fine", d: fine }), svg("path", { class: "grid", d: grid }));
    for (const t of across.major) group.append(svg("text", { class: "tick", x: toX(t), y: bottom + 14, "text-anchor": "middle" }, tickLabel(t, x.log)));
    for (const t of up.major) group.append(svg("text", { class: "tick", x: MARGIN.left - 5, y: toY(t) + 3.5, "text-anchor": "end" }, tickLabel(t, y.log)));
    group.append(svg("rect", { class: "frame", x: MARGIN.left, y: top, width: Math.max(0, right - MARGIN.left), height: Math.max(0, bottom - top) }));
    const inHertz = (axis, most) => ticksOf({ ...axis, min: axis.min / TURN, max: axis.max / TURN }, most).major;
    const tick = (t, log, place, d) => group.append(svg("text", { class: "tick", ...place }, tickLabel(t, log)), svg("path", { class: "frame", d }));
    if (x.hertz) {
      for (const t of inHertz(x, (right - MARGIN.left) / 60)) tick(t, x.log, { x: toX(TURN * t), y: top - 6, "text-anchor": "middle" }, `M${toX(TURN * t)} ${top}v4`);
      group.append(svg("text", { class: "axis", x: MARGIN.left - 20, y: top - 6, "text-anchor": "end" }, "Hz"));
    }
    if (y.hertz) {
      for (const t of inHertz(y, (bottom - top) / 36)) tick(t, y.log, { x: right + 4, y: toY(TURN * t) + 3.5, "text-anchor": "start" }, `M${right} ${toY(TURN * t)}h-4`);
      group.append(svg("text", { class: "axis", x: right + 4, y: bottom + 14, "text-anchor": "start" }, "Hz"));
    }
    group.append(svg("text", { class: "axis", x: (MARGIN.left + right) / 2, y: bottom + 29, "text-anchor": "middle" }, x.label));
    group.append(svg("text", { class: "axis", transform: `translate(11 ${(top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, y.label));
  }

  // A region that a requirement excludes is hatched where a curve enters it.
  const look = (shape) => (shape.fails ? { class: `${shape.class} hatched`, fill: `url(#${clip}-hatch)` } : { class: shape.class });

  function drawShape(group, shape, s) {
    const { toX, toY, right, bottom, x, y } = s;
    if (shape.kind === "area") { // rings of points, the first outside, others holes
      const d = shape.rings.map(([xs, ys]) => `${pathOf(xs, ys, toX, toY)}Z`).join("");
      group.append(svg("path", { class: shape.class, d, "fill-rule": "evenodd" }));
      return;
    }
    if (shape.kind === "region") { // x, y: [from, to], null: to the edge; what lies outside is cut off
      const ends = (side, axis) => [Math.max(side[0] ?? axis.min, axis.min), Math.min(side[1] ?? axis.max, axis.max)];
      const [[left, to], [low, high]] = [ends(shape.x, x), ends(shape.y, y)];
      if (left < to && low < high) {
        const words = shape.text ? `${shape.text}${shape.fails ? " FAILS" : ""}` : "";
        const place = shape.row === undefined ? { x: right - 4, y: toY(low) - 4, "text-anchor": "end" } : { ...(toX(left) + LETTER * words.length > right ? { x: right - 4, "text-anchor": "end" } : { x: toX(left) + 4 }), y: Math.max(shown.top + 12 + 11 * shape.row, toY(low) - toY(high) > 18 ? toY(high) + 16 : 0) };
        group.append(svg("rect", { ...look(shape), x: toX(left), y: toY(high), width: toX(to) - toX(left), height: toY(low) - toY(high) }));
        group.append(svg("text", { class: `zone asked${shape.fails ? " fails" : ""}`, ...place }, words));
        s.named.push({ left: place.x - LETTER * words.length, y: place.y });
      }
      return;
    }
    if (shape.kind === "circle") {
      const rx = Math.abs(toX(shape.x + shape.r) - toX(shape.x)), ry = Math.abs(toY(shape.y + shape.r) - toY(shape.y));
      group.append(svg("ellipse", { ...look(shape), cx: toX(shape.x), cy: toY(shape.y), rx, ry }));
    } else if (shape.kind === "band") {
      const top = toY(Math.min(shape.to, y.max)), low = toY(Math.max(shape.from, y.min));
      if (low > top) group.append(svg("rect", { class: shape.class, x: MARGIN.left, y: top, width: right - MARGIN.left, height: low - top }));
    } else if (shape.kind === "line") {
      const d = shape.x !== undefined ? `M${toX(shape.x)} ${shown.top}V${bottom}` : `M${MARGIN.left} ${toY(shape.y)}H${right}`;
      group.append(svg("path", { class: shape.class ?? "zero", d }));
    } else if (shape.kind === "ray") {
      const far = 2 * Math.max(Math.abs(x.min), Math.abs(x.max), Math.abs(y.min), Math.abs(y.max));
      group.append(svg("path", { class: shape.class, d: `M${toX(0)} ${toY(0)}L${toX(shape.dx * far)} ${toY(shape.dy * far)}` }));
    } else if (shape.kind === "text") {
      group.append(svg("text", { class: shape.class ?? "zone", x: toX(shape.x) + (shape.shift ?? 0), y: toY(shape.y) + (shape.drop ?? 0), "text-anchor": shape.anchor ?? "middle" }, shape.text));
    }
  }

  function draw(next) {
    if (next) view = next;
    if (!view || node.clientWidth < 20 || node.clientHeight < 20) return;
    const s = (shown = layout());
    picture.setAttribute("width", s.width);
    picture.setAttribute("height", s.height);
    picture.setAttribute("viewBox", `0 0 ${s.width} ${s.height}`);
    const definitions = svg("defs"), cut = svg("clipPath", { id: clip });
    cut.append(svg("rect", { x: MARGIN.left, y: shown.top, width: Math.max(0, s.right - MARGIN.left), height: Math.max(0, s.bottom - shown.top) }));
    const hatch = svg("pattern", { id: `${clip}-hatch`, width: 7, height: 7, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" });
    hatch.append(svg("rect", { class: "hatch-ground", width: 7, height: 7 }), svg("path", { class: "hatch", d: "M0 0V7" }));
    definitions.append(cut, hatch);
    const axes = svg("g"), inside = svg("g", { "clip-path": `url(#${clip})` });
    for (const shape of (view.shapes ?? []).filter((one) => one.kind === "band")) drawShape(inside, shape, s);
    const front = svg("g", { "clip-path": `url(#${clip})` });
    drawAxes(axes, s);
    for (const shape of view.shapes ?? []) if (shape.kind !== "band") drawShape(front, shape, s);
    for (const shape of view.shapes ?? []) {
      if (shape.kind !== "band") continue;
      const place = { x: MARGIN.left + 4, y: s.toY(Math.min(shape.to, s.y.max)) + 10 };
      const hides = s.named.some((one) => Math.abs(one.y - place.y) < 11 && one.left < place.x + LETTER * shape.text.length);
      if (!hides && s.toY(shape.from) - place.y > 1) front.append(svg("text", { class: "zone", ...place }, shape.text));
    }
    for (const line of view.lines ?? []) {
      const mark = { class: `line${line.faint ? " faint" : ""}`, d: pathOf(line.xs, line.ys, s.toX, s.toY), stroke: line.color };
      if (line.dash) mark["stroke-dasharray"] = line.dash;
      if (line.width) mark["stroke-width"] = line.width;
      front.append(svg("path", mark));
    }
    for (const set of view.points ?? []) {
      let d = "";
      set.xs.forEach((px, k) => {
        const left = s.toX(px), top = s.toY(set.ys[k]);
        if (left > -50 && left < s.width + 50 && top > -50 && top < s.height + 50) d += MARKS[set.mark](set.size ?? 4).replace(/([ML])(-?[\d.]+) (-?[\d.]+)/g, (_, c, a, b) => `${c}${(left + +a).toFixed(1)} ${(top + +b).toFixed(1)}`).replace(/A([\d.]+) ([\d.]+) 0 1 0 (-?[\d.]+) 0/g, (_, a, b, c) => `A${a} ${b} 0 1 0 ${(left + +c).toFixed(1)} ${top.toFixed(1)}`);
      });
      front.append(svg("path", { class: `mark${set.faint ? " faint" : ""}`, d, stroke: set.color }));
    }
    const cursor = svg("g", { class: "cursor" });
    picture.replaceChildren(definitions, inside, axes, front, cursor);
    node.setAttribute("aria-label", `${label}. ${view.summary ?? ""}`);
    drawHandles(s);
    if (at) point(at);
  }

  function drawHandles(s) {
    const wanted = new Map((view.handles ?? []).map((one) => [one.key, one]));
    for (const [key, button] of handles) if (!wanted.has(key)) { button.remove(); handles.delete(key); }
    for (const [key, handle] of wanted) {
      const button = handles.get(key) ?? makeHandle(key), pulled = held?.key === key;
      const left = pulled ? held.left : s.toX(handle.x), top = pulled ? held.top : s.toY(handle.y);
      button.hidden = !(left >= MARGIN.left - 1 && left <= s.right + 1 && top >= shown.top - 1 && top <= s.bottom + 1);
      button.style.cssText = `left:${left}px;top:${top}px;--swatch:${handle.color}`;
      button.title = `pull: ${handle.label}, ${handle.value}`;
      for (const [name, value] of [["label", handle.label], ["valuetext", handle.value], ["valuenow", handle.y]]) button.setAttribute(`aria-${name}`, value);
    }
  }

  const handleOf = (key) => view.handles?.find((one) => one.key === key);

  function makeHandle(key) {
    const button = document.createElement("span");
    button.tabIndex = 0;
    button.className = "handle";
    button.setAttribute("role", "slider");
    button.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      button.setPointerCapture(event.pointerId);
      held = { key, ...placeOf(event) };
    });
    button.addEventListener("pointermove", (event) => {
      event.stopPropagation();
      if (held?.key === key) pullHandle(placeOf(event), false);
    });
    const end = (event) => { if (held?.key === key) { const place = placeOf(event); pullHandle(place, true); held = null; draw(); } };
    button.addEventListener("pointerup", end);
    button.addEventListener("pointercancel", () => { held = null; draw(); });
    button.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!step || !shown) return;
      event.preventDefault();
      event.stopPropagation();
      const handle = handleOf(key), size = event.shiftKey ? 20 : 5;
      handle.pull(...valuesAt(shown.toX(handle.x) + size * step[0], shown.toY(handle.y) + size * step[1]), true);
    });
    handles.set(key, button);
    node.append(button);
    return button;
  }

  function pullHandle(place, done) {
    const moved = Math.hypot(place.left - held.left, place.top - held.top) > 0 || held.moved;
    held = { ...held, ...place, moved };
    if (moved) handleOf(held.key)?.pull(...valuesAt(place.left, place.top), done);
    draw();
  }

  const placeOf = (event) => { const box = node.getBoundingClientRect(); return { left: event.clientX - box.left, top: event.clientY - box.top }; };
  function valuesAt(left, top) {
    const back = (axis, from, to, place) => {
      const share = (place - from) / (to - from);
      return axis.log ? axis.min * (axis.max / axis.min) ** share : axis.min + share * (axis.max - axis.min);
    };
    return [back(shown.x, MARGIN.left, shown.right, left), back(shown.y, shown.bottom, shown.top, top)];
  }

  // Look at the part between two corners of the figure, in pixels; without them at the whole.
  function zoomTo(from, to) {
    if (!shown || !view) return;
    if (from) {
      const [a, b] = [valuesAt(from.left, from.top), valuesAt(to.left, to.top)];
      const sides = [0, 1].map((k) => [Math.min(a[k], b[k]), Math.max(a[k], b[k])]);
      zoom = { words: view.x.label + view.y.label, x: sides[0], y: sides[1] };
    } else zoom = null;
    node.classList.toggle("zoomed", Boolean(zoom));
    draw();
  }
  // The middle stays; factor: of the range that is seen.
  function zoomBy(factor) {
    if (!shown) return;
    const x = (MARGIN.left + shown.right) / 2, y = (shown.top + shown.bottom) / 2, dx = (factor * (shown.right - MARGIN.left)) / 2, dy = (factor * (shown.bottom - shown.top)) / 2;
    zoomTo({ left: x - dx, top: y - dy }, { left: x + dx, top: y + dy });
  }

  // Lines and points that can be read, in the order of the readout.
  const readable = () => [...(view?.lines ?? []), ...(view?.points ?? [])].filter((one) => !one.silent);

  function nearest(left, top) {
    let best = null;
    for (const set of readable()) {
      for (let k = 0; k < set.xs.length; k++) {
        if (set.xs[k] === null || set.ys[k] === null) continue;
        const dx = shown.toX(set.xs[k]) - left, dy = shown.toY(set.ys[k]) - top;
        const distance = view.nearest === "xy" ? dx * dx + dy * dy : Math.abs(dx) + 1e-3 * Math.abs(dy);
        if (best === null || distance < best.distance) best = { distance, set, k };
      }
    }
    return best;
  }

  function point(place) {
    at = place;
    const cursor = picture.querySelector(".cursor");
    if (!cursor || !shown) return;
    cursor.replaceChildren();
    const found = place && nearest(place.left, place.top);
    if (!found) { readout.hidden = true; return; }
    const { set, k } = found, left = shown.toX(set.xs[k]), top = shown.toY(set.ys[k]);
    if (view.nearest !== "xy") cursor.append(svg("path", { class: "hair", d: `M${left} ${shown.top}V${shown.bottom}` }));
    cursor.append(svg("circle", { class: "dot", cx: left, cy: top, r: 4, stroke: set.color }));
    const rows = view.read(set, k);
    readout.replaceChildren(...rows.map((row) => {
      const line = document.createElement("div");
      if (row.color) {
        const swatch = document.createElement("i");
        swatch.style.background = row.color;
        line.append(swatch);
      }
      line.append(row.text);
      if (row.strong) line.className = "strong";
      return line;
    }));
    readout.hidden = false;
    const beside = left + 12 + readout.offsetWidth > shown.width ? left - 12 - readout.offsetWidth : left + 12;
    readout.style.left = `${Math.max(2, beside)}px`;
    readout.style.top = `${Math.max(2, Math.min(place.top - 10, shown.height - readout.offsetHeight - 4))}px`;
  }

  const isInside = ({ left, top }) => shown && left >= MARGIN.left && left <= shown.right && top >= shown.top && top <= shown.bottom;
  node.addEventListener("pointerdown", (event) => {
    const place = placeOf(event);
    if (view && event.button === 0 && event.pointerType !== "touch" && isInside(place)) held = { from: place };
  });
  node.addEventListener("pointermove", (event) => {
    const place = placeOf(event);
    if (held?.from) drawBox(place);
    else if (view && !held) point(place);
  });
  function drawBox(place) {
    const { from } = held, cursor = picture.querySelector(".cursor");
    held.box = Math.abs(place.left - from.left) > 6 && Math.abs(place.top - from.top) > 6 ? place : null;
    readout.hidden = true;
    cursor.replaceChildren(...(held.box ? [svg("rect", { class: "zoom-box", x: Math.min(from.left, place.left), y: Math.min(from.top, place.top), width: Math.abs(place.left - from.left), height: Math.abs(place.top - from.top) })] : []));
  }
  node.addEventListener("pointerup", (event) => {
    const place = placeOf(event), box = held?.from && held.box;
    if (!held?.from) return;
    const { from } = held;
    held = null;
    if (box) zoomTo(from, box);
    else if (view?.pick && isInside(place)) view.pick(...valuesAt(place.left, place.top));
  });
  node.addEventListener("click", (event) => { // of a finger, which draws no box
    const place = placeOf(event);
    if (event.pointerType === "touch" && view?.pick && isInside(place)) view.pick(...valuesAt(place.left, place.top));
  });
  node.addEventListener("dblclick", () => zoomTo());
  node.addEventListener("pointerleave", () => { if (held?.from) held = null; point(null); });
  node.addEventListener("blur", () => point(null));
  node.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], zooms = { "+": () => zoomBy(0.6), "-": () => zoomBy(1 / 0.6), 0: () => zoomTo() }[event.key];
    if (event.key === "Escape") point(null);
    if (zooms && !event.ctrlKey && !event.metaKey) zooms();
    if (!step || !view || !shown) return;
    event.preventDefault();
    const found = nearest(at?.left ?? (MARGIN.left + shown.right) / 2, at?.top ?? (shown.top + shown.bottom) / 2);
    if (!found) return;
    const k = Math.max(0, Math.min(found.set.xs.length - 1, found.k + step * (event.shiftKey ? 10 : 1)));
    point({ left: shown.toX(found.set.xs[k]), top: shown.toY(found.set.ys[k]) });
  });
  new ResizeObserver(() => draw()).observe(node);
  return { node, draw, zoomBy, zoomTo, picture, current: () => view };
}

// The range of values with some room; `zero`: whether 0 has to be in it.
export function rangeOf(series, { zero = false, log = false, room = 0.06 } = {}) {
  let low = Infinity, high = -Infinity;
  for (const values of series) {
    for (const value of values) {
      if (value === null || !Number.isFinite(value) || (log && value <= 0)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  if (low > high) return log ? [0.1, 10] : [-1, 1];
  if (zero) [low, high] = [Math.min(low, 0), Math.max(high, 0)];
  if (log) return [10 ** (Math.log10(low) - 0.1), 10 ** (Math.log10(high) + 0.1)];
  const gap = (high - low || Math.abs(high) || 1) * room;
  return [low - gap, high + gap];
}

