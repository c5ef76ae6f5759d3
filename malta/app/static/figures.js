// What the charts show: documents of the session as views of chart.js.

import { rangeOf } from "./chart.js";
import { decibels, digits, hertz, printedUnit, quantity, scaleFor } from "./numbers.js";

const DASHES = ["", "7 3", "2 3", "8 3 2 3", "", "7 3", "2 3", "8 3 2 3"];
export const color = (k) => `var(--c${k % 8})`;
export const dash = (k) => DASHES[k % DASHES.length];

function signalLines(names, rows, xs, hidden, { ghost = false, dashed = null } = {}) {
  return names.map((name, k) => ({
    name, xs, ys: rows[k] ?? [], k,
    color: color(k),
    dash: dashed ?? dash(k),
    faint: ghost, silent: ghost,
  })).filter((line) => !hidden.has(line.name) && line.ys.length);
}

// Handles where many curves agree: one of each place, so that none hides another.
const distinct = (handles) => handles.filter((one, k) => handles.findIndex((other) => Math.abs(other.x / one.x - 1) < 0.02 && Math.abs(other.y - one.y) < 0.02 * Math.abs(one.y)) === k);

const sizesOf = (frequency, which) => (which !== "L" ? frequency[which] : frequency.S.length ? frequency.L.map(([re, im]) => re.map((x, k) => Math.hypot(x, im[k]))) : []);

// What can be pulled of |S| and of the loop: its largest, and where it crosses 1.
function sizeHandles(frequency, which, rows, hidden, pull) {
  return distinct(frequency.sensors.flatMap((name, k) => {
    if (hidden.has(name) || !rows.length || which === "T") return [];
    const crossing = frequency.crossover[k], top = rows[k].indexOf(Math.max(...rows[k]));
    if (which === "S") return [{ key: name, x: frequency.w[top], y: rows[k][top], color: color(k), label: `largest |S| of ${name}`, value: digits(rows[k][top], 3), pull: (_, y, done) => pull("peak", name, Math.max(y, 1.02), done) }];
    return crossing ? [{ key: name, x: crossing[0], y: 1, color: color(k), label: `crossover of ${name}`, value: hertz(crossing[0]), pull: (x, _, done) => pull("crossover", name, x, done) }] : [];
  }));
}

// Regions that requirements exclude of a chart. An entry fails by its judge, or before it by the curves.
const boundHandles = (limits, place, at) => limits.filter((one) => one.pull).map((one) => ({ key: `bound ${one.entry}`, bound: true, ...at(one), color: "var(--bad)", label: `bound of ${one.words}`, value: one.text, pull: (x, y, done) => one.pull(place(x, y, one), done) }));
const failed = (limit, state, curve) => state.requirements[limit.entry]?.holds === false || (state.requirements[limit.entry]?.holds !== true && curve);

// |S| or |T| of each sensor, with the zones of ISO 14839-3 behind S; or |L|, the others closed.
export function sensitivityView(picture, pins, which, hidden, pull, state) {
  const { w, sensors } = picture.frequency;
  const rows = sizesOf(picture.frequency, which);
  const lines = [
    ...pins.flatMap((pin) => signalLines(sensors, sizesOf(pin.picture.frequency, which), pin.picture.frequency.w, hidden, { ghost: true })),
    ...signalLines(sensors, rows, w, hidden),
  ];
  const [low, top] = rangeOf(rows, { log: true });
  const zones = [[0, 3, "A"], [3, 4, "B"], [4, 5, "C"], [5, 1e9, "D"]];
  const shapes = which === "S" ? zones.map(([from, to, name]) => ({ kind: "band", from: Math.max(from, 1e-9), to, text: name === "A" ? "zone A below 3" : name, class: `zone-${name}` })) : [];
  const asked = state.limits.filter((one) => one.curve === which && which === "S");
  const regions = asked.map((one) => ({ kind: "region", x: [null, null], y: [one.limit, null], text: `${one.words} ≤ ${one.text}`, class: "asked", fails: failed(one, state, rows.some((row) => Math.max(...row) > one.limit)) }));
  const band = which === "S" ? [] : state.limits.filter((one) => one.curve === "T").flatMap((one) => {
    const fails = failed(one, state, false), lines = [{ kind: "line", x: one.high, class: "limit" }, { kind: "text", x: one.high, y: 1, shift: -4, drop: -5, anchor: "end", class: `zone asked${fails ? " fails" : ""}`, text: `${one.words} ≥ ${one.text}${fails ? " FAILS" : ""}` }];
    return which === "T" ? [{ kind: "region", x: [null, one.high], y: [null, one.limit], class: "asked", fails }, ...lines] : lines;
  });
  return {
    x: { label: "frequency [rad/s]", min: w[0], max: w[w.length - 1], log: true, hertz: true },
    y: { label: which === "L" ? "|L|, each sensor, others closed" : `|${which}|, each sensor`, min: which === "L" ? Math.max(low, 1e-3) : 0.01, max: which === "L" ? Math.min(top, 1e3) : Math.max(8, top), log: true },
    handles: [...sizeHandles(picture.frequency, which, rows, hidden, pull), ...boundHandles(asked, (_, y) => Math.max(y, 1.001), (one) => ({ x: 2 * w[0], y: one.limit }))],
    lines, shapes: [...shapes, ...regions, ...band, { kind: "line", y: 1 }], nearest: "x",
    summary: rows.length ? sensors.map((name, k) => `${name}: largest ${digits(Math.max(...rows[k]), 3)}`).join(", ") : "unstable: no sensitivity",
    empty: rows.length ? "" : "An unstable loop has no sensitivity.",
    read: (line, k) => [
      { text: hertz(line.xs[k]), strong: true },
      ...lines.filter((one) => !one.silent).map((one) => ({ color: one.color, text: `${one.name}: ${digits(one.ys[k], 3)} (${decibels(one.ys[k])})` })),
    ],
  };
}

// The loop of each sensor with the others closed, about -1; the disk inside of which |S| is above 3.
export function nyquistView(picture, pins, reach, hidden, pull, state) {
  const { w, sensors, L } = picture.frequency;
  const curves = (frequency, ghost) => frequency.sensors.map((name, k) => ({
    name, w: frequency.w, xs: frequency.L[k][0], ys: frequency.L[k][1], color: color(k),
    dash: dash(k), faint: ghost, silent: ghost,
  })).filter((line) => !hidden.has(line.name));
  // A handle stands where a loop enters the unit circle; round the circle its phase margin changes.
  const peaks = sizesOf(picture.frequency, "S");
  const circles = state.limits.filter((one) => one.curve === "S").map((one) => ({ limit: one, fails: failed(one, state, peaks.some((row) => Math.max(...row) > one.limit)) }));
  const handles = sensors.flatMap((name, k) => {
    const crossing = picture.frequency.crossover[k];
    if (hidden.has(name) || !crossing) return [];
    const angle = (x, y) => Math.min(Math.max(Math.atan2(-y, -x), 0.03), 2.6); // from -1, against the clock
    return [{ key: name, x: Math.cos(crossing[1] - Math.PI), y: Math.sin(crossing[1] - Math.PI), color: color(k), label: `phase margin of ${name}`, value: `${digits((180 / Math.PI) * crossing[1], 3)}° at ${hertz(crossing[0])}`, pull: (x, y, done) => pull("phase", name, angle(x, y), done) }];
  });
  return {
    equal: true, nearest: "xy", handles: distinct(handles),
    x: { label: "Re, loop of one sensor, others closed", min: -1 - reach, max: -1 + reach },
    y: { label: "Im", min: -reach, max: reach },
    shapes: [
      { kind: "circle", x: 0, y: 0, r: 1, class: "unit" },
      ...(circles.length ? circles.map(({ limit, fails }) => ({ kind: "circle", x: -1, y: 0, r: 1 / limit.limit, class: "asked", fails })) : [{ kind: "circle", x: -1, y: 0, r: 1 / 3, class: "forbidden" }]),
      { kind: "line", x: 0 }, { kind: "line", y: 0 },
      { kind: "text", x: -1, y: 0, text: "+", drop: 3.5 },
      // The names of circles stand in the corner, where no loop that crosses over near -1 passes.
      ...(circles.length ? circles.map(({ limit, fails }, k) => ({ kind: "text", x: -1 + reach, y: -reach, shift: -4, drop: -5 - 12 * k, anchor: "end", text: `${limit.words} ≤ ${limit.text}${fails ? " FAILS" : ""}`, class: `zone asked${fails ? " fails" : ""}` })) : [{ kind: "text", x: -1, y: 1 / 3, text: "|S| > 3", drop: -4 }]),
    ],
    lines: [...pins.flatMap((pin) => curves(pin.picture.frequency, true)), ...curves(picture.frequency, false)],
    summary: `${sensors.length} ${sensors.length > 1 ? "curves" : "curve"} from ${digits(w[0], 3)} to ${digits(w[w.length - 1], 3)} rad/s`,
    read: (line, k) => [
      { text: line.name, strong: true, color: line.color },
      { text: hertz(line.w[k]) },
      { text: `${digits(line.xs[k], 3)} ${line.ys[k] < 0 ? "−" : "+"} ${digits(Math.abs(line.ys[k]), 3)} j` },
      { text: `distance to −1: ${digits(Math.hypot(line.xs[k] + 1, line.ys[k]), 3)}` },
    ],
  };
}

const POLES = { machine: ["o", 7], "closed loop": ["x", 0], regulator: ["+", 2], filter: ["s", 4] };

// Poles in the s plane, ln z / Ts of sampled ones; rays of damping 0.1, 0.3 and 0.7.
export function poleView(picture, pins, all, hidden, there = null) {
  const sizes = picture.poles["closed loop"].map(([re, im]) => Math.hypot(re, im)).sort((a, b) => a - b);
  const wanted = 1.25 * (all ? sizes[sizes.length - 1] : sizes[Math.floor(0.6 * (sizes.length - 1))] ?? 1);
  const power = 10 ** Math.floor(Math.log10(wanted));
  const reach = [1, 1.5, 2, 3, 5, 7, 10].find((s) => s * power >= wanted) * power;
  const sets = (poles, ghost) => Object.entries(POLES).filter(([name]) => poles[name]?.length && !hidden.has(name)).map(([name, [mark, k]]) => ({
    name, mark, color: color(k), xs: poles[name].map((p) => p[0]), ys: poles[name].map((p) => p[1]), faint: ghost, silent: ghost,
    size: name === "closed loop" ? 4.5 : 3.5,
  }));
  const rays = [0.1, 0.3, 0.7].flatMap((zeta) => [1, -1].map((side) => ({ kind: "ray", dx: -zeta, dy: side * Math.sqrt(1 - zeta * zeta), class: "ray" })));
  const labels = [[0.1, 0.9], [0.3, 0.7], [0.7, 0.55]].map(([zeta, share]) => {
    const far = share * reach;
    return { kind: "text", x: -zeta * far, y: Math.sqrt(1 - zeta * zeta) * far, text: `ζ ${zeta}`, shift: -3, anchor: "end" };
  });
  const hiddenPoles = sizes.filter((size) => size > reach).length;
  return {
    equal: true, nearest: "xy",
    x: { label: "Re s [rad/s]", min: -reach, max: 0.35 * reach },
    y: { label: "Im s [rad/s]", min: -reach, max: reach, hertz: true },
    shapes: [{ kind: "line", x: 0, class: "limit" }, { kind: "line", y: 0 }, ...rays, ...labels],
    points: [...pins.flatMap((pin) => sets(pin.picture.poles, true)), ...sets(picture.poles, false), ...(there ? [{ name: "at the picked point of the map", mark: "x", color: "var(--accent)", size: 3, xs: there.poles.map((p) => p[0]), ys: there.poles.map((p) => p[1]) }] : [])],
    note: hiddenPoles ? `${hiddenPoles} faster ${hiddenPoles > 1 ? "poles" : "pole"} outside` : "",
    summary: `${sizes.length} poles of the closed loop, spectral radius ${digits(picture.radius, 6)}`,
    read: (set, k) => {
      const size = Math.hypot(set.xs[k], set.ys[k]);
      return [
        { text: set.name, strong: true, color: set.color },
        { text: `${digits(set.xs[k], 4)} ${set.ys[k] < 0 ? "−" : "+"} ${digits(Math.abs(set.ys[k]), 4)} j rad/s` },
        { text: `|s| ${hertz(size)}` },
        { text: `damping ${digits(-set.xs[k] / size, 3)}` },
      ];
    },
  };
}

// Groups of signals of one unit: [{id, text, unit, of, indices}], for the choice above a chart over time.
export function timeGroups(description, withErrors) {
  const groups = [];
  const add = (signals, what, key) => {
    for (const unit of [...new Set(signals.map((s) => s.unit))]) {
      const indices = signals.flatMap((s, k) => (s.unit === unit ? [k] : []));
      groups.push({ id: `${key} ${unit}`, text: `${what} [${printedUnit(unit)}]`, words: what, unit, of: key, indices });
    }
  };
  add(description.outputs, "outputs", "p");
  if (withErrors) {
    add(description.outputs, "errors", "error");
    add(description.inputs, "commands", "v");
  }
  return groups;
}

const seriesOf = (run, group, k) => (group.of === "error" ? run.p[k].map((value, i) => (value === null ? null : value - run.reference[k][i])) : run[group.of][k]);

// A run: the linear loop dashed, the simulation solid, the reference dotted.
export function runView(state, group, hidden, pull) {
  const { picture, simulated, pins, description } = state;
  const run = picture.run, sources = [];
  if (!run) return null;
  for (const pin of pins) if (pin.picture.run?.name === run.name) sources.push({ run: pin.picture.run, ghost: true });
  sources.push({ run, dash: simulated ? "5 3" : "", linear: true });
  if (simulated?.name === run.name && simulated.t) sources.push({ run: simulated, dash: "", solid: true });
  const signals = group.of === "v" ? description.inputs : description.outputs;
  const lines = [];
  for (const source of sources) {
    for (const k of group.indices) {
      if (hidden.has(signals[k].name)) continue;
      lines.push({
        name: signals[k].name, xs: source.run.t, ys: seriesOf(source.run, group, k), color: color(k), dash: source.dash,
        faint: source.ghost, silent: source.ghost || (source.linear && sources.some((s) => s.solid)), width: source.linear && source.dash ? 1.2 : 1.6,
      });
    }
  }
  if (group.of === "p") {
    for (const k of group.indices) {
      if (!hidden.has(signals[k].name) && Math.max(...run.reference[k].map(Math.abs)) > 0) lines.unshift({ name: `${signals[k].name} reference`, xs: run.t, ys: run.reference[k], color: "var(--soft)", dash: "2 2", silent: true, width: 2.4 });
    }
  }
  const handles = group.of === "v" ? [] : group.indices.filter((k) => !hidden.has(signals[k].name)).flatMap((k) => {
    const errors = run.p[k].map((value, i) => Math.abs(value - run.reference[k][i])), worst = errors.indexOf(Math.max(...errors)), { name } = signals[k];
    const from = group.of === "error" ? 0 : run.reference[k][worst];
    return picture.stable && errors[worst] > 0 ? [{ key: name, x: run.t[worst], y: seriesOf(run, group, k)[worst], color: color(k), label: `largest error of ${name}`, value: quantity(errors[worst], group.unit), pull: (_, y, done) => pull("run", name, Math.abs(y - from), done) }] : [];
  });
  const asked = group.of === "error" ? state.limits.filter((one) => one.curve === "error" && run.name !== "" && one.signals.some((name) => group.indices.some((k) => signals[k].name === name && !hidden.has(name)))) : [];
  return timeView(lines, group, run.t, run.name, handles, { lines: asked });
}

// The outputs under a unit of one disturbance.
export function loadView(state, group, hidden, pull) {
  const { picture, pins, description } = state, load = picture.load;
  if (!load) return null;
  const rows = (source, ghost) => group.indices.filter((k) => !hidden.has(description.outputs[k].name)).map((k) => ({
    name: description.outputs[k].name, xs: source.t, ys: source.y[k], color: color(k), dash: dash(k), faint: ghost, silent: ghost,
  }));
  const lines = [...pins.filter((pin) => pin.picture.load?.name === load.name).flatMap((pin) => rows(pin.picture.load, true)), ...rows(load, false)];
  const handles = group.indices.filter((k) => !hidden.has(description.outputs[k].name) && load.largest[k] > 0).map((k) => {
    const { name } = description.outputs[k], sizes = load.y[k].map(Math.abs), worst = sizes.indexOf(Math.max(...sizes));
    return { key: name, x: load.t[worst], y: load.y[k][worst], color: color(k), label: `most that ${load.name} moves ${name}`, value: quantity(load.largest[k], group.unit), pull: (_, y, done) => pull("load", name, Math.abs(y), done) };
  });
  const most = Math.max(0, ...handles.map((one) => Math.abs(one.y)));
  const signals = group.indices.map((k) => description.outputs[k].name).filter((name) => !hidden.has(name));
  const asked = state.limits.filter((one) => one.curve === "load" && one.load === load.name && one.signals.some((name) => signals.includes(name)) && one.low < load.t[load.t.length - 1]).sort((one, other) => other.limit - one.limit);
  const beyond = (one) => group.indices.some((k) => signals.includes(description.outputs[k].name) && one.signals.includes(description.outputs[k].name) && load.y[k].some((y, i) => load.t[i] >= one.low && Math.abs(y) > one.limit));
  return timeView(lines, group, load.t, `load ${load.name}`, handles.filter((one) => Math.abs(one.y) > 1e-3 * most), { regions: asked.map((one) => ({ ...one, fails: failed(one, state, beyond(one)) })) });
}

function timeView(lines, { unit, words }, times, title, handles, { regions = [], lines: bounds = [] } = {}) {
  let [low, high] = rangeOf(lines.map((line) => line.ys), { zero: true });
  const side = high >= -low ? 1 : -1, most = Math.max(0, ...regions.map((one) => 1.12 * one.limit));
  [low, high] = side > 0 ? [low, Math.max(high, most)] : [Math.min(low, -most), high];
  const size = Math.max(Math.abs(low), Math.abs(high)), value = scaleFor(size, unit), time = scaleFor(times[times.length - 1], "s");
  const shapes = [...regions.map((one, k) => {
    const above = Math.min(Infinity, ...regions.slice(0, k).filter((other) => other.low <= one.low).map((other) => other.limit));
    const ends = [one.limit / value.factor, above < Infinity ? above / value.factor : null];
    return { kind: "region", x: [one.low / time.factor, null], y: side > 0 ? ends : [ends[1] === null ? null : -ends[1], -ends[0]], text: `${one.words} ≤ ${one.text}`, class: "asked", fails: one.fails, row: k };
  }), ...bounds.flatMap((one) => [1, -1].map((sign) => ({ kind: "line", y: (sign * one.limit) / value.factor, class: "limit" }))), ...bounds.map((one) => ({ kind: "text", x: 0, y: one.limit / value.factor, shift: 4, drop: -3, anchor: "start", class: "zone asked", text: `${one.words} ≤ ${one.text}, of machines that differ` }))];
  const scaled = lines.map((line) => ({ ...line, xs: line.xs.map((t) => t / time.factor), ys: line.ys.map((y) => (y === null ? null : y / value.factor)) }));
  return {
    nearest: "x",
    x: { label: `time [${time.unit}]`, min: 0, max: times[times.length - 1] / time.factor },
    y: { label: `${words} [${value.unit || "1"}]`, min: low / value.factor, max: high / value.factor },
    lines: scaled, shapes: [...shapes, { kind: "line", y: 0 }],
    handles: [...distinct(handles.map((one) => ({ ...one, x: one.x / time.factor, y: one.y / value.factor, pull: (x, y, done) => one.pull(x, y * value.factor, done) }))),
      ...boundHandles(regions, (_, y, one) => Math.abs(y) * value.factor * (one.asked / one.limit), (one) => ({ x: Math.max(one.low, 0.94 * times[times.length - 1]) / time.factor, y: (side * one.limit) / value.factor }))],
    summary: `${title}: ${words}, largest ${quantity(size, unit)}`,
    read: (line, k) => [
      { text: `${digits(line.xs[k], 4)} ${time.unit}`, strong: true },
      ...scaled.filter((one) => !one.silent && one.xs === line.xs || (!one.silent && one.xs.length === line.xs.length)).map((one) => ({ color: one.color, text: `${one.name}: ${digits(one.ys[k], 4)} ${value.unit}` })),
    ],
  };
}

// The plane of two parameters, the others anywhere in the box: the proven box, the boundary by eigenvalues, the machine that is lost; a click asks
// for the poles of the worst machine there. A machine that is lost by other parameters than these two has no point in the plane.
export function mapView(state, pick) {
  const { map, proof, there, picture } = state;
  if (!map || map.error) return null;
  const [cx, cy] = map.nominal, [hx, hy] = map.half, lower = proof?.lower ?? 0;
  const box = (share) => [[[cx - share * hx, cx + share * hx, cx + share * hx, cx - share * hx], [cy - share * hy, cy - share * hy, cy + share * hy, cy + share * hy]]];
  const unit = (k) => (map.units[k] === "1" ? "" : ` [${printedUnit(map.units[k])}]`);
  const points = [{ name: "nominal", xs: [cx], ys: [cy], mark: "+", size: 6, color: "var(--ink)" }];
  const at = [proof?.at?.[map.x], proof?.at?.[map.y]], off = Math.max(Math.abs(at[0] - cx) / hx, Math.abs(at[1] - cy) / hy);
  const witness = off >= (1 - 1e-6) * (proof?.upper ?? Infinity) ? at : null;
  if (witness) points.push({ name: map.beside ? "lost, other parameters moved too" : "lost", xs: [witness[0]], ys: [witness[1]], mark: "x", size: 6, color: "var(--bad)" });
  const near = (x, y) => witness && [x, y].every((value, k) => Math.abs(value - witness[k]) < 0.015 * (map.reach[k][1] - map.reach[k][0]));
  if (there) points.push({ name: `picked: ${there.stable ? "stable" : "unstable"}`, xs: [there.at[map.x]], ys: [there.at[map.y]], mark: "o", size: 6, color: "var(--accent)" });
  const moved = there ? Object.entries(there.beside).map(([name, value]) => ` ${name} ${digits(value, 3)}`).join("") : "";
  const told = there ? `there ${there.stable ? "stable" : "UNSTABLE"}${moved ? `, worst with${moved}` : ""}, slowest pole ${digits(there.worst[0], 4)}${there.worst[1] ? ` ± ${digits(Math.abs(there.worst[1]), 4)} j` : ""} rad/s` : "click for the poles there";
  return {
    nearest: "xy", pick: (x, y) => pick(...(near(x, y) ? witness : [x, y])),
    x: { label: `${map.words[0]}${unit(0)}`, min: map.reach[0][0], max: map.reach[0][1] }, y: { label: `${map.words[1]}${unit(1)}`, min: map.reach[1][0], max: map.reach[1][1] },
    shapes: [...map.unstable.map((rings) => ({ kind: "area", rings, class: "forbidden" })), ...(lower > 0 ? [{ kind: "area", rings: box(lower), class: "proven-box" }] : []), { kind: "area", rings: box(1), class: "asked-box" }],
    lines: map.boundary.map(([xs, ys]) => ({ name: "boundary", xs, ys, color: "var(--ink)", silent: true })), points,
    note: `${[map.version !== state.version ? "of the last design" : lower > 0 ? `blue: proven, ${proof.proven} of the dashed box` : picture.margin ? "not proven (yet)" : "", map.beside].filter(Boolean).join(", ")}; ${told}`,
    summary: `${map.words[0]} and ${map.words[1]}${map.beside ? `, ${map.beside}` : ""}; ${told}`,
    read: (set, k) => [{ text: set.name, strong: true, color: set.color }, { text: `${map.x} ${digits(set.xs[k], 4)}` }, { text: `${map.y} ${digits(set.ys[k], 4)}` }],
  };
}
