// Sliders and number fields of a design: one row an entry, in the unit of its file.

import { digits, numberIn, printedUnit } from "./numbers.js";

const STEPS = 1000; // of a slider
const DIGITS = 5; // of a number that a slider sets

// What engineers call the parameters of a machine, by unit: a search for "mass" finds m in kg.
const MEANINGS = { kg: "mass weight payload", g: "mass weight payload", "kg m^2": "inertia moment", "m/s^2": "gravity acceleration", "N/m": "stiffness attraction spring", "N/A": "force constant thrust", "N s/m": "damping friction", ohm: "resistance winding", H: "inductance winding", mH: "inductance winding", V: "voltage", A: "current", Wb: "flux linkage", mWb: "flux linkage", T: "flux density magnet remanence", "V s/m": "induced voltage back emf", Hz: "frequency", kHz: "frequency", s: "time delay period", ms: "time delay period", us: "time delay period", m: "length position", mm: "length position gap stroke", um: "length position noise gap", nm: "length noise", N: "force", "N m": "torque", rad: "angle", deg: "angle", "rad/s": "speed crossover bandwidth" };
const TABLES = { pid: "gain controller", noise: "kalman observer filter bandwidth", weights: "cost penalty q r lqr", bases: "cost scale bryson q r lqr", uncertainty: "tolerance robustness box", operating_point: "place position" };
const meaningOf = (field) => [field.key, field.tuning, field.group, field.note, MEANINGS[field.unit] ?? "", TABLES[field.key.split(".")[0]] ?? ""].join(" ").toLowerCase();

let rows = 0;

export function element(name, attributes = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "class") node.className = value;
    else if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (value === true) node.setAttribute(key, "");
    else if (value !== false && value !== undefined) node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

// A list that opens from a sign.
export const dropDown = (sign, list) => element("span", { class: "drop" }, element("span", { "aria-hidden": "true" }, sign), list);

// Slider position, 0 to STEPS, of a value, and back. With `zero` the left end of a logarithmic slider is 0.
function positionOf(field, value) {
  if (field.kind === "log") return value > 0 ? Math.max(field.zero ? 1 : 0, Math.round((STEPS * Math.log(value / field.low)) / Math.log(field.high / field.low))) : 0;
  return Math.round((STEPS * (value - field.low)) / (field.high - field.low));
}

function valueAt(field, position) {
  if (field.zero && position === 0) return 0;
  const share = position / STEPS;
  if (field.kind === "log") return Number((field.low * (field.high / field.low) ** share).toPrecision(DIGITS));
  const value = field.low + share * (field.high - field.low);
  return field.kind === "integer" ? Math.round(value) : Number(Math.abs(value) < 1e-9 * (field.high - field.low) ? 0 : value.toPrecision(DIGITS));
}

// One row. change(value, done): `done` once a slider is let go or a number is entered.
// Returns {node, show(value, changed), field}.
export function createRow(field, label, change, fail) {
  const id = `malta-row-${++rows}`, unit = printedUnit(field.unit);
  const name = element("label", { for: id, title: [field.key, field.note].filter(Boolean).join("\n") }, label);
  if (field.kind === "switch") {
    const box = element("input", { type: "checkbox", id, onchange: () => change(box.checked, true) });
    return { field, node: element("div", { class: "row wide" }, box, name), show: (value, changed) => { box.checked = value; name.classList.toggle("changed", changed); } };
  }
  if (field.kind === "choice") {
    const list = element("select", { id, onchange: () => change(list.value, true) }, ...field.choices.map((choice) => element("option", { value: choice }, choice)));
    return { field, node: element("div", { class: "row choice" }, name, list), show: (value, changed) => { list.value = value; name.classList.toggle("changed", changed); } };
  }
  let now = field.value;
  const box = element("input", { type: "text", inputmode: "decimal", id: `${id}-number`, autocomplete: "off", spellcheck: "false", "aria-label": `${label}${unit ? ` in ${unit}` : ""}` });
  const slider = field.kind === "number" ? null : element("input", {
    type: "range", id, min: field.kind === "integer" ? field.low : 0, max: field.kind === "integer" ? field.high : STEPS, step: 1, "aria-label": label,
  });
  if (!slider) name.htmlFor = box.id;
  const enter = () => {
    const value = numberIn(box.value, field.unit);
    if (box.value === box.dataset.shown) return;
    if (!Number.isFinite(value)) { fail(`${field.key}: found ${JSON.stringify(box.value)}, expected a finite number${unit ? ` in ${unit}` : ""}`); box.setAttribute("aria-invalid", "true"); return; }
    change(value, true);
  };
  box.addEventListener("change", enter);
  box.addEventListener("keydown", (event) => {
    if (event.key === "Enter") enter();
    if (event.key === "Escape") { box.value = box.dataset.shown; box.blur(); }
    const step = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const next = field.kind === "integer" ? now + step : now * (1 + 0.01 * step * (event.shiftKey ? 10 : 1));
    change(Number(next.toPrecision(DIGITS)), true);
  });
  box.addEventListener("focus", () => box.select());
  if (slider) {
    const take = () => (field.kind === "integer" ? Number(slider.value) : valueAt(field, Number(slider.value)));
    slider.addEventListener("input", () => change(take(), false));
    slider.addEventListener("change", () => change(take(), true));
  }
  const show = (value, changed) => {
    now = value;
    box.removeAttribute("aria-invalid");
    box.value = box.dataset.shown = digits(value, 6).replace("−", "-");
    name.classList.toggle("changed", changed);
    if (!slider) return;
    const position = field.kind === "integer" ? value : positionOf(field, value);
    if (Number(slider.value) !== position) slider.value = position;
    slider.setAttribute("aria-valuetext", `${digits(value, 5)} ${unit}`.trim());
    slider.style.setProperty("--filled", `${field.kind === "integer" ? (100 * value) / (field.high || 1) : (100 * Math.min(STEPS, Math.max(0, position))) / STEPS}%`);
  };
  const node = element("div", { class: `row${slider ? "" : " plain"}` }, name, box, element("span", { class: "unit" }, unit), ...(slider ? [slider] : []));
  return { field, node, show };
}

// The panel: groups of rows, those of [search] first and open.
export function createPanel(description, change, fail) {
  const groups = new Map();
  const put = (group, row) => (groups.get(group) ?? groups.set(group, []).get(group)).push(row);
  const tuned = new Set();
  for (const field of description.fields) {
    if (!field.tuning || tuned.has(field.tuning)) continue;
    tuned.add(field.tuning);
    const row = createRow(field, field.tuning.split(":")[0].replaceAll("_", " "), (value, done) => change(field, value, done), fail);
    row.node.querySelector("label").append(element("small", {}, ` ${field.linked.map((key) => key.split(".").pop()).join(" ")}`));
    put("Tuning", row);
  }
  for (const field of description.fields) put(field.group, createRow(field, field.label, (value, done) => change(field, value, done), fail));
  const open = tuned.size ? ["Tuning"] : [...groups.keys()].filter((name) => /gains|Bases of the states|Weights of the states/.test(name)).slice(0, 3);
  const nodes = [], all = [];
  for (const [name, members] of groups) {
    const box = element("details", { open: open.includes(name) }, element("summary", {}, name, element("span", { class: "count" }, String(members.length))), ...members.map((row) => row.node));
    box.dataset.group = name;
    nodes.push(box);
    all.push(...members);
  }
  const seek = element("input", { type: "search", class: "seek", placeholder: "find a number: mass, noise ( / )", "aria-label": "find a number" });
  seek.addEventListener("input", () => {
    const text = seek.value.toLowerCase();
    for (const box of nodes) {
      let seen = 0;
      for (const row of all.filter((one) => one.node.parentElement === box)) {
        row.node.hidden = !text.split(/\s+/).every((word) => meaningOf(row.field).includes(word));
        seen += row.node.hidden ? 0 : 1;
      }
      box.hidden = seen === 0;
      if (text) box.open = seen > 0;
    }
  });
  const show = (values) => { for (const row of all) row.show(values[row.field.key], values[row.field.key] !== row.field.value); };
  return { nodes, seek, show };
}
