// The page of `malta app`: a design under edit, seen at every move. mount(root, transport) fills a node;
// transport: {ask(document) -> promise of a document, listen(heard)}.

import { createChart, stroke } from "./chart.js";
import { createPanel, dropDown, element } from "./controls.js";
import { exportChart } from "./export.js";
import { color, dash, loadView, mapView, nyquistView, poleView, runView, sensitivityView, timeGroups } from "./figures.js";
import { digits, hertz, quantity, sizeOf } from "./numbers.js";
import { countLights, differenceTable, figureTable, howToAsk, requirementRows } from "./tables.js";
import { createTuner } from "./tuning.js";

const MOST_PINS = 4;
const MOST_GHOSTS = 3; // candidates of a search that are drawn
const MOST_UNDO = 200;
const GONE = "malta app has ended: start it again to go on";
const WORST = "worst load"; // the run
const NEAR = 1.6, WIDE = 10; // of the Nyquist chart
const SHORTCUTS = [["Ctrl Z", "undo"], ["Ctrl Y, Ctrl Shift Z", "redo"], ["P", "pin this design"], ["R", "reset to the file"], ["Ctrl S", "save the design file"],
  ["/", "find a number"], ["?", "this list"], ["← →", "move a slider, a handle or the readout of a chart"], ["+ − 0", "zoom into a chart, out, and back; a drag draws a box"], ["Page ↑ ↓", "move a slider by a tenth"], ["↑ ↓", "a number field by 1 %, with Shift 10 %"], ["Esc", "take a number back, hide a readout"]];

export async function mount(root, { ask: send, listen }) {
  root.classList.add("malta-app");
  const tab = Math.random().toString(36).slice(2);
  const lose = (text) => { root.inert = true; root.replaceChildren(element("p", { class: "fatal", role: "alert" }, text)); };
  // Another page that opens the design takes it along: this one asks nothing any more.
  const transport = {
    ask: async (body) => {
      const answer = await send({ ...body, page: tab });
      if (answer.lost) lose(answer.lost);
      return answer.lost ? new Promise(() => {}) : answer;
    },
    listen: (heard) => listen(heard, tab),
  };
  let description;
  try {
    description = await transport.ask({ ask: "open" });
    if (description.error) throw new Error(description.error);
  } catch (problem) {
    root.replaceChildren(element("p", { class: "fatal", role: "alert" }, `The design cannot be shown: ${problem.message}`));
    return;
  }
  const state = {
    description, values: {}, redesign: true, undo: [], redo: [], pins: [], pinned: 0,
    picture: null, simulated: null, requirements: {}, proof: null, safe: null, version: 0, number: 0, failed: "",
    run: description.runs[0], load: description.loads[0]?.name ?? "", runGroup: "", loadGroup: "",
    old: new Set(), limits: [], sens: "S", reach: NEAR, poles: "slow", map: null, there: null, mapX: "", mapY: "", table: "requirements", hidden: new Set(), hiddenPoles: new Set(), ties: false,
  };
  const fresh = () => Object.fromEntries(state.description.fields.map((field) => [field.key, field.value]));
  state.values = { ...fresh(), ...description.edit.values };
  state.redesign = description.edit.redesign;

  // --- parts of the page ---
  const button = (text, title, press, attributes = {}) => element("button", { type: "button", title, onclick: press, ...attributes }, text);
  const badge = element("div", { class: "badge", role: "status", "aria-live": "polite" });
  const lights = element("button", { type: "button", class: "lights", title: "requirements", onclick: () => { state.table = "requirements"; drawTables(); tables.scrollTop = 0; tables.scrollIntoView({ block: "nearest" }); } });
  const speed = element("span", { class: "speed", "aria-hidden": "true" });
  const designs = element("select", { "aria-label": "other designs", title: "open another design", onchange: () => openDesign(designs.value) });
  const title = element("h1", {}), subtitle = element("span", { class: "soft" }), machine = element("span", { class: "machine" });
  const undo = button("↶ Undo", "Ctrl Z", () => step("undo", "redo")), redo = button("↷ Redo", "Ctrl Y", () => step("redo", "undo"));
  const reset = button("Reset", "to the numbers of the file (R)", () => commit({ values: fresh(), redesign: true }));
  const pin = button("Pin", "keep this design beside (P)", pinDesign);
  const save = button("Save…", "design file (Ctrl S)", () => openSave(), { class: "main" });
  const gains = button("Gain files", "malta design: verify, simulate, write", writeGains);
  const theme = button("◐", "light or dark", turnTheme, { "aria-label": "light or dark" });
  const help = button("?", "shortcuts", () => shortcuts.showModal(), { "aria-label": "shortcuts" });
  const message = element("div", { class: "message", role: "alert", title: "click to hide", onclick: () => say("") });
  const pins = element("div", { class: "pins" });
  const header = element("header", {}, element("div", { class: "name" }, element("div", { class: "which" }, title, dropDown("▾", designs)), subtitle), machine, badge, lights, pins, element("div", { class: "buttons" }, undo, redo, reset, pin, save, gains, theme, help));

  const ties = element("input", { type: "checkbox", onchange: () => { state.ties = ties.checked; } });
  const redesign = element("input", { type: "checkbox", onchange: () => commit({ values: state.values, redesign: redesign.checked }) });
  let panel;
  const controls = element("section", { class: "controls", "aria-label": "numbers of the design" });

  const charts = {};
  const cards = element("section", { class: "cards", "aria-label": "charts" });
  function card(key, heading, ...tools) {
    const chart = (charts[key] = createChart(heading));
    const note = element("p", { class: "note" }), legend = element("div", { class: "legend" });
    chart.note = note;
    chart.legend = legend;
    const act = (what) => {
      if (what === "in" || what === "out") chart.zoomBy(what === "in" ? 0.6 : 1 / 0.6);
      else if (what === "whole") chart.zoomTo();
      else if (chart.current()) exportChart(what, `${state.description.name}_${key}`, chart.picture, chart.current(), getComputedStyle(root).getPropertyValue("--card"));
    };
    const menu = element("select", { class: "menu", "aria-label": `${heading}: zoom and export`, title: "zoom and export", onchange: () => { act(menu.value); menu.value = ""; } },
      ...[["", "⋯"], ["in", "Zoom in"], ["out", "Zoom out"], ["whole", "Whole figure"], ["svg", "SVG"], ["png", "PNG"], ["csv", "CSV"]].map(([value, text]) => element("option", { value }, text)));
    cards.append(element("article", { class: `card ${key}` }, element("div", { class: "bar" }, element("h2", {}, heading), ...tools, dropDown("⋯", menu)), chart.node, legend, note));
  }
  const tabs = (choices, get, set) => {
    const group = element("div", { class: "tabs", role: "group" }, ...choices.map(([value, text]) => button(text, text, () => { set(value); draw(); }, { "data-value": value })));
    group.mark = () => { for (const one of group.children) one.setAttribute("aria-pressed", String(one.dataset.value === String(get()))); };
    return group;
  };
  const pick = (label, get, set) => {
    const list = element("select", { "aria-label": label, onchange: () => { set(list.value); } });
    list.fill = (options) => { list.replaceChildren(...options.map(([value, text]) => element("option", { value }, text))); list.value = get(); list.hidden = options.length < 2; };
    return list;
  };
  const sensTabs = tabs([["S", "S"], ["T", "T"], ["L", "L"]], () => state.sens, (value) => { state.sens = value; });
  const reachTabs = tabs([[NEAR, "near −1"], [WIDE, "wide"]], () => state.reach, (value) => { state.reach = Number(value); });
  const poleTabs = tabs([["slow", "slow"], ["all", "all"], ["map", "margin map"]], () => state.poles, (value) => { state.poles = value; if (value === "map") askMap(); });
  const mapXs = pick("parameter along x", () => state.mapX, (value) => { state.mapX = value; askMap(); });
  const mapYs = pick("parameter along y", () => state.mapY, (value) => { state.mapY = value; askMap(); });
  const worst = button(WORST, "the load of this size, chosen under Load, whose waveform uses most of a clearance", () => { state.run = runList.value = WORST; state.simulated = null; ask(); });
  const runList = pick("run", () => state.run, (value) => { state.run = value; state.simulated = null; ask(); });
  const runGroups = pick("signals of the run", () => state.runGroup, (value) => { state.runGroup = value; draw(); });
  const loadList = pick("load", () => state.load, (value) => { state.load = value; if (state.run === WORST) state.simulated = null; ask(); });
  const loadGroups = pick("outputs under the load", () => state.loadGroup, (value) => { state.loadGroup = value; draw(); });
  card("sensitivity", "Sensitivity", sensTabs);
  card("nyquist", "Nyquist", reachTabs);
  card("poles", "Poles", mapXs, mapYs, poleTabs);
  card("run", "Run", worst, runList, runGroups);
  card("load", "Load", loadList, loadGroups);
  const tableTabs = tabs([["requirements", "Requirements"], ["figures", "Figures"], ["changes", "Changes"]], () => state.table, (value) => { state.table = value; });
  const tables = element("div", { class: "tables", tabindex: "0", role: "region", "aria-label": "tables" });
  cards.append(element("article", { class: "card table" }, element("div", { class: "bar" }, tableTabs), tables));

  const shortcuts = element("dialog", { class: "help" }, element("h2", {}, "Keys"), element("table", {}, ...SHORTCUTS.map(([keys, what]) => element("tr", {}, element("th", { scope: "row" }, keys), element("td", {}, what)))), element("form", { method: "dialog" }, element("button", { class: "main" }, "Close")));
  const file = element("input", { type: "text", id: "malta-file", autocomplete: "off", spellcheck: "false" });
  const saveNote = element("p", { class: "soft", role: "status" }), saveButton = element("button", { class: "main", type: "submit" }, "Save");
  const cancel = button("Cancel", "Esc", () => saving.close());
  const saveForm = element("form", { onsubmit: (event) => { event.preventDefault(); saveDesign(); } },
    element("label", {}, "Design file, in the folder that malta app was started in", file), saveNote,
    element("div", { class: "buttons" }, cancel, saveButton));
  const saving = element("dialog", { class: "save" }, element("h2", {}, "Save the design"), saveForm);
  const leaving = element("dialog", { class: "leave" }, element("h2", {}, "This design has changes that are not saved"), element("p", {}),
    element("form", { method: "dialog", class: "buttons" }, element("button", { value: "", class: "main" }, "Stay"), element("button", { value: "save" }, "Save…"), element("button", { value: "discard" }, "Discard them")));
  root.replaceChildren(header, message, element("main", {}, controls, cards), shortcuts, saving, leaving);
  root.tabIndex = -1;

  const tuner = createTuner(state, {
    ask: (task) => transport.ask({ ask: "search", task, values: state.values, redesign: state.redesign, run: state.run, load: state.load }),
    place: (values, done) => place(values, done), say, redraw: () => draw(),
  });

  // --- moves ---
  const snapshot = () => ({ values: { ...state.values }, redesign: state.redesign });
  let before = null; // where a drag began
  let tied = [];

  function begin() {
    if (before) return;
    before = snapshot();
    state.ghost = state.failed ? null : state.picture;
    tied = [];
  }

  function change(field, value, done) {
    begin();
    if (!tied.length) {
      tied = field.linked.length ? [...field.linked] : [field.key];
      if (state.ties) {
        for (const other of state.description.fields) {
          if (other.group === field.group && other.unit === field.unit && before.values[other.key] === before.values[field.key] && !tied.includes(other.key)) tied.push(other.key);
        }
      }
    }
    place(Object.fromEntries(tied.map((key) => [key, inUnitOf(key, value, field)])), done);
  }

  // Other numbers at once; done: the end of a drag, which undo goes back over.
  function place(values, done) {
    begin();
    Object.assign(state.values, values);
    if (done) {
      state.ghost = null;
      if (Object.keys(state.values).some((key) => before.values[key] !== state.values[key])) remember(before);
      before = null;
    }
    refresh();
  }

  // --- pulling a curve: the server finds the numbers; one question at a time, and the newest pull wins ---
  let pulling = false, pulled = null;

  async function pull(kind, signal, asked, done) {
    pulled = { kind, signal, asked, done };
    if (pulling) return;
    pulling = true;
    begin();
    while (pulled) {
      const now = pulled;
      pulled = null;
      const answer = await transport.ask({ ask: "pull", kind: now.kind, signal: now.signal, asked: now.asked, values: before ? before.values : state.values, redesign: state.redesign, run: state.run, load: state.load }).catch(() => ({ error: GONE }));
      const text = answer.error ?? pullText(now, answer);
      place({ ...before?.values, ...answer.values }, now.done);
      state.told = { chart: { phase: "nyquist", run: "run", load: "load" }[now.kind] ?? "sensitivity", text }; // nothing moves under the pointer
      draw();
      if (now.done) say(text, answer.reached ? "note" : "error");
    }
    pulling = false;
  }

  function pullText({ kind, signal }, { what, found, asked, reached, numbers, at_end }) {
    const unit = { crossover: "rad/s", phase: "rad", peak: "1" }[kind] ?? state.description.outputs.find((one) => one.name === signal).unit;
    const text = (value) => (kind === "phase" ? `${digits((180 / Math.PI) * value, 3)}°` : kind === "crossover" ? hertz(value) : quantity(value, unit));
    const by = numbers.join(" and ");
    if (reached) return `${what}: ${text(found)}, by ${by}`;
    return `${what}: ${text(asked)} cannot be reached with ${by}${at_end.length ? `: ${at_end.join(" and ")} at the end of the slider` : " alone"}; the nearest is ${text(found)}`;
  }

  // Entries that move together may have units of their own.
  function inUnitOf(key, value, field) {
    const factor = state.description.fields.find((other) => other.key === key).factor / field.factor;
    return factor === 1 ? value : Number((value * factor).toPrecision(12));
  }

  function remember(past) {
    state.undo = [...state.undo, past].slice(-MOST_UNDO);
    state.redo = [];
  }

  function commit(next) {
    remember(snapshot());
    Object.assign(state, { values: { ...next.values }, redesign: next.redesign });
    refresh();
  }

  function step(from, to) {
    const next = state[from].pop();
    if (!next) return;
    state[to].push(snapshot());
    Object.assign(state, { values: { ...next.values }, redesign: next.redesign });
    before = state.ghost = null;
    refresh();
  }

  const changes = () => Object.fromEntries(state.description.fields.filter((field) => state.values[field.key] !== field.value).map((field) => [field.key, state.values[field.key]]));

  function refresh() {
    state.told = null;
    // Nothing that was proven or measured of the last design is shown beside the numbers of the next.
    state.past = { ...state.past, ...state.requirements, ...(state.proof?.lower ? { margin: { found: state.proof.lower, text: state.proof.proven } } : {}) };
    if (!state.moving) last = { version: state.version, proof: state.proof, safe: state.safe, requirements: state.requirements, simulated: state.simulated };
    Object.assign(state, { moving: true, proof: null, safe: null, requirements: {}, simulated: null });
    panel.show(state.values);
    redesign.checked = state.redesign;
    drawHeader();
    ask();
  }

  // --- asking: one question at a time, and the newest move wins ---
  let busy = false, again = false, skipped = false; // skipped: the rest of the last answer was
  let last = {}; // what followed the design before a move, which may come back to it

  async function ask() {
    if (busy) { again = true; return; }
    busy = true;
    const began = performance.now(), number = (state.number = Math.max(state.number + 1, Date.now())); // newer than those of a page before
   
    let answer;
    try {
      answer = await transport.ask({ ask: "evaluate", number, values: state.values, redesign: state.redesign, run: state.run, load: state.load });
    } catch {
      answer = { error: GONE };
    }
    const rest = () => transport.ask({ ask: "rest", number }).catch(() => ({ error: GONE }));
    if (answer.missing?.length && !state.picture) Object.assign(answer, await rest(), { missing: [] });
    if (answer.stale) again = true; // another page asked meanwhile: what stands here is of an older design
    else take(answer, performance.now() - began);
    if (answer.missing?.length) { // during a drag the rest is asked for at every other move at least
      skipped = again && !skipped;
      if (!skipped) takeRest(await rest());
    }
    busy = false;
    if (again) { again = false; ask(); return; }
    state.moving = false;
    drawHeader();
    for (const item of early.splice(0)) hear(item);
  }

  function take(answer, milliseconds) {
    state.failed = answer.error ?? "";
    if (answer.version !== undefined && answer.version !== state.version) {
      state.past = { ...state.past, ...state.requirements };
      Object.assign(state, { version: answer.version, requirements: {}, proof: null, safe: null, simulated: null, there: null });
    } else if (state.moving && answer.version === last.version) Object.assign(state, last);
    if (!answer.error) {
      state.description.requirements = answer.requirements;
      state.limits = answer.limits.map(withBound);
      state.old = new Set(answer.missing);
      state.picture = withOld(answer, state.picture);
      speed.textContent = `${Math.round(milliseconds)} ms`;
      speed.title = `last move: seen after ${Math.round(milliseconds)} ms, of which ${Math.round(1e3 * answer.seconds.wall)} ms to compute`;
      root.dataset.milliseconds = milliseconds.toFixed(1);
    }
    root.dataset.version = String(state.version);
    root.classList.toggle("failed", Boolean(answer.error));
    if (state.failed || message.classList.contains("error")) say(state.failed, "error");
    draw();
  }

  // A bound that is one number of the file is pulled: a move of that number, in its unit.
  function withBound(limit) {
    const field = state.description.fields.find((one) => one.key === limit.field), unit = state.description.requirements.find((one) => one.name === limit.entry).unit;
    const [size, base] = field ? sizeOf(field.unit) : [1, ""];
    const pulled = field && (base === unit || (!field.unit && unit === "1"));
    return { ...limit, text: quantity(limit.asked, unit), pull: pulled ? (asked, done) => change(field, Number((asked / size).toPrecision(3)), done) : null };
  }

  // Parts that follow stand as they were, grey; figures too. Of an unstable design the server leaves out nothing.
  function withOld(answer, past) {
    const figures = answer.missing.includes("figures") && past ? past.figures.map((one) => answer.figures.find((other) => other.label === one.label) ?? { ...one, old: true }) : answer.figures;
    return { ...past, ...answer, figures };
  }

  function takeRest(answer) {
    if (answer.stale) { again = true; return; }
    if (answer.error) { say(answer.error, "error"); return; }
    state.old = new Set();
    Object.assign(state.picture, answer);
    draw();
  }

  const early = []; // news of a version that has not been seen yet

  function hear(item) {
    if (item.kind === "gone") { say(GONE, "error"); return; }
    if (item.kind === "lost") { lose(item.text); return; }
    if (item.version === null) { tuner.hear(item); return; }
    if (item.version > state.version || state.moving) { early.push(item); return; }
    if (item.version < state.version || !state.picture) return;
    if (item.kind === "requirement") state.requirements[item.name] = item;
    if (item.kind === "proof") {
      state.proof = item;
      for (const one of state.pins) if (one.version === state.version) one.proof = item;
    }
    if (item.kind === "safe") state.safe = item;
    if (item.kind === "map") state.map = item;
    if (item.kind === "run") state.simulated = item;
    if (item.kind === "margin") state.picture.margin = item;
    if (item.kind === "failed") say(item.error, "error");
    if (item.kind === "notice") say(item.text);
    const binds = item.kind === "requirement" && state.limits.some((one) => one.entry === item.name);
    if (item.kind === "run" || item.kind === "safe" || binds || state.poles === "map") draw();
    else { drawHeader(); drawTables(); }
  }

  // --- the margin map: the plane of two parameters, and the poles at a point of it ---
  async function askMap() {
    const known = Object.keys(state.description.parameters);
    if (known.length < 2) return;
    if (!known.includes(state.mapX)) state.mapX = known[0];
    if (!known.includes(state.mapY) || state.mapY === state.mapX) state.mapY = known.find((name) => name !== state.mapX);
    for (const list of [mapXs, mapYs]) list.fill(known.map((name) => [name, name]));
    Object.assign(state, { map: null, there: null });
    draw();
    const answer = await transport.ask({ ask: "map", x: state.mapX, y: state.mapY }).catch(() => ({ error: GONE }));
    if (answer.error) say(answer.error, "error");
  }

  async function pickPoint(x, y) {
    const answer = await transport.ask({ ask: "map", x: state.mapX, y: state.mapY, at: [x, y] }).catch(() => ({ error: GONE }));
    if (answer.error) say(answer.error, "error");
    else if (answer.version === state.version) { state.there = answer; draw(); }
  }

  function say(text, kind = "note") {
    message.textContent = text;
    message.className = `message ${text ? kind : ""}`;
  }

  // --- drawing ---
  // indices: of the signals of these names, whose colours and dashes they have; dashed: whether the lines are
  function legendOf(chart, names, hidden, { marks = {}, indices = names.map((_, k) => k), dashed = true } = {}) {
    chart.legend.replaceChildren(...names.map((name, k) => {
      const swatch = element("i", {}, marks[name] ?? stroke(dashed ? dash(indices[k]) : ""));
      swatch.style.setProperty("--swatch", color(marks[name] ? { machine: 7, "closed loop": 0, regulator: 2, filter: 4 }[name] : indices[k]));
      return element("button", { type: "button", class: marks[name] ? "mark" : "", "aria-pressed": String(!hidden.has(name)), title: `show or hide ${name}`, onclick: () => { if (!hidden.delete(name)) hidden.add(name); draw(); } }, swatch, name);
    }));
  }

  function show(chart, view, empty) {
    if (view && before && chart.held?.words === view.y.label) Object.assign(view, { x: chart.held.x, y: chart.held.y });
    else if (view) chart.held = { x: view.x, y: view.y, words: view.y.label };
    const missing = view ? view.empty : empty;
    chart.node.classList.toggle("empty", Boolean(missing));
    chart.node.dataset.missing = missing ?? "";
    chart.legend.hidden = !view;
    chart.note.textContent = view?.note ?? "";
    if (view) chart.draw(view);
  }

  function draw() {
    drawHeader();
    tuner.show();
    const { picture } = state, pins = [...state.pins, ...state.candidates.slice(-MOST_GHOSTS), ...(state.ghost ? [{ picture: state.ghost }] : [])];
    if (!picture) return;
    for (const group of [sensTabs, reachTabs, poleTabs]) group.mark();
    for (const [key, part] of Object.entries({ sensitivity: "frequency", nyquist: "frequency", run: "run", load: "load" })) charts[key].node.parentElement.classList.toggle("old", state.old.has(part));
    const names = picture.frequency.sensors;
    show(charts.sensitivity, sensitivityView(picture, pins, state.sens, state.hidden, pull, state));
    show(charts.nyquist, nyquistView(picture, pins, state.reach, state.hidden, pull, state));
    const mapped = state.poles === "map", uncertain = Object.keys(state.description.parameters);
    mapXs.hidden = mapYs.hidden = !mapped || uncertain.length < 2;
    poleTabs.lastChild.hidden = uncertain.length < 2;
    show(charts.poles, mapped ? mapView(state, pickPoint) : poleView(picture, pins, state.poles === "all", state.hiddenPoles, state.there), state.map?.error ?? "The map follows.");
    legendOf(charts.sensitivity, names, state.hidden);
    legendOf(charts.nyquist, names, state.hidden);
    if (mapped) charts.poles.legend.replaceChildren();
    else legendOf(charts.poles, Object.keys(picture.poles).filter((name) => picture.poles[name].length), state.hiddenPoles, { marks: { machine: "○", "closed loop": "×", regulator: "+", filter: "□" } });
    drawTimes({ ...state, pins });
    if (state.told) charts[state.told.chart].note.textContent = charts[state.told.chart].note.title = state.told.text;
    drawTables();
  }

  function drawTimes(seen) {
    const groups = timeGroups(state.description, true), short = timeGroups(state.description, false);
    const group = groups.find((one) => one.id === state.runGroup) ?? groups[0];
    const under = short.find((one) => one.id === state.loadGroup) ?? short[0];
    show(charts.run, runView(seen, group, state.hidden, pull), "Too many samples for the linear loop, or no such run.");
    show(charts.load, loadView(seen, under, state.hidden, pull), state.description.loads.length ? "An unstable loop carries no load." : "No force acts on this machine from outside.");
    const signals = group.of === "v" ? state.description.inputs : state.description.outputs;
    const named = (of, indices) => indices.map((k) => of[k].name);
    legendOf(charts.run, named(signals, group.indices), state.hidden, { indices: group.indices, dashed: false }); // dashes are of the linear loop
    legendOf(charts.load, named(state.description.outputs, under.indices), state.hidden, { indices: under.indices });
    const { simulated } = state;
    charts.run.note.textContent = !simulated ? "linear loop; the simulation follows" : simulated.error ? `no simulation: ${simulated.error}`
      : `– – linear   —— simulated${simulated.engine === "compiled" ? "" : ` (${simulated.engine})`}${simulated.completed ? "" : `: ${simulated.verdict} at ${digits(simulated.end, 3)} s`}`;
    charts.run.note.title = charts.run.note.textContent;
    if (state.picture.load) drawLoadNote(state.description.loads.find((load) => load.name === state.picture.load.name));
  }

  // What is drawn of a load, and what the worker proved of any waveform of it.
  function drawLoadNote({ name, unit }) {
    const { safe } = state, size = safe?.loads[name], { note } = charts.load, drawn = `1 ${unit} of ${name}, constant from t = 0, linear loop`;
    note.textContent = size ? `1 ${unit} from t = 0, linear; any ${name} ≤ ${size} touches nothing: proven` : drawn;
    note.title = !safe ? drawn : `${drawn}. ${size ? `Any waveform of ${name} up to ${size} touches nothing and saturates nothing: proven of the nonlinear machine with forces as commanded. Beyond: ` : "Nothing is proven of any waveform: "}${safe.ends[name]}`;
  }

  function drawTables() {
    if (!state.picture) return;
    tableTabs.mark();
    const { table } = state;
    if (table === "requirements") {
      tables.replaceChildren(state.description.requirements.length ? element("table", { class: "requirements" }, element("tbody", {}, ...requirementRows(state.description, state)))
        : howToAsk(state), figureTable(state));
    } else tables.replaceChildren(table === "figures" ? figureTable(state) : differenceTable(state.description, state));
    const counts = countLights(state.description, state);
    lights.hidden = !state.description.requirements.length;
    lights.replaceChildren(...[["true", "✓"], ["false", "✗"], ["null", "…"]].filter(([key]) => counts[key]).map(([key, sign]) => element("span", { class: `light ${key === "null" ? "open" : key}` }, `${sign} ${counts[key]}`)));
    lights.setAttribute("aria-label", `requirements: ${counts.true} met, ${counts.false} not met, ${counts.null} not known yet`);
  }

  function badgeText() {
    const { picture, proof } = state;
    if (state.failed) return ["broken", "✗ no design", state.failed];
    if (!picture) return ["open", "…", ""];
    if (!picture.stable && !state.moving) return ["broken", "✗ unstable", `spectral radius ${digits(picture.radius, 6)}`];
    const upper = picture.margin?.upper;
    const found = picture.margin === null ? "" : picture.margin.reason ? `no eigenvalue margin: ${picture.margin.reason}` : upper === null || upper === undefined ? "no loss found by eigenvalues" : `≤ ${picture.margin.lost} by eigenvalues`;
    if (!Object.keys(state.description.parameters).length) return ["open", "✓ stable", "no uncertainty in the file, so no margin"];
    if (state.moving) return ["open", `… ${found}`, "of the last design"];
    if (!proof) return ["open", `✓ stable  ${found}`, "not proven yet: the proof follows"];
    const lost = proof.upper === null || proof.upper === undefined ? "" : `lost at ${proof.lost}${proof.frequency === null ? "" : `, ${hertz(proof.frequency)}`}`;
    if (proof.lower === null || proof.lower === undefined) return ["unknown", "nothing proven", [proof.reason, found].filter(Boolean).join("; ")];
    return ["proven", `✓ proven ${proof.proven}`, [lost, proof.reason].filter(Boolean).join("; ")];
  }

  function drawHeader() {
    const { description: d } = state, count = Object.keys(changes()).length;
    title.textContent = `${d.name}${count ? " ·" : ""}`;
    title.title = d.summary;
    if (machine.of !== d.picture) machine.innerHTML = machine.of = d.picture;
    subtitle.textContent = `${d.law} for ${d.machine} (${d.preset})${count ? `, ${count} changed` : ""}${state.redesign ? "" : ", machine differs"}`;
    const [kind, text, more] = badgeText();
    badge.className = `badge ${kind}`;
    badge.replaceChildren(element("b", {}, text), element("small", { title: more }, more), speed);
    undo.disabled = !state.undo.length;
    redo.disabled = !state.redo.length;
    pin.disabled = !state.picture || Boolean(state.failed) || Boolean(state.moving) || state.old.size > 0;
    pins.replaceChildren(...state.pins.map((one) => element("span", { class: "pin" }, button(one.name, "go back to this design", () => commit(one)), button("×", `forget ${one.name}`, () => { state.pins = state.pins.filter((other) => other !== one); draw(); }, { "aria-label": `forget ${one.name}` }))));
  }

  // --- pins, saving ---
  function pinDesign() {
    if (!state.picture || state.failed || state.moving || state.old.size) return; // the picture is not of these numbers
    const name = String.fromCharCode(65 + (state.pinned++ % 26));
    state.pins = [...state.pins, { name, ...snapshot(), picture: state.picture, proof: state.proof, version: state.version }].slice(-MOST_PINS);
    state.table = state.table === "requirements" ? "figures" : state.table;
    draw();
  }

  let replace = false;

  function openSave() {
    replace = false;
    file.value = state.description.file;
    saveNote.textContent = "";
    saveButton.textContent = "Save";
    saving.showModal();
    file.select();
  }
  file.addEventListener("input", () => { replace = false; saveButton.textContent = "Save"; saveNote.textContent = ""; });

  async function saveDesign() {
    const answer = await transport.ask({ ask: "save", file: file.value, values: state.values, redesign: state.redesign, replace }).catch(() => ({ error: GONE }));
    if (answer.exists) {
      replace = true;
      saveNote.textContent = `${answer.exists.join(", ")} exists.`;
      saveButton.textContent = "Replace";
      cancel.focus(); // a second Enter replaces nothing
      return;
    }
    if (answer.error) { saveNote.textContent = answer.error; return; }
    saving.close();
    describe(answer.open);
    say(`wrote ${answer.written.join(", ")}`);
    draw();
  }

  let replaceGains = "";

  async function writeGains() {
    gains.disabled = true;
    say("malta design runs: verify, simulate, write…");
    const answer = await transport.ask({ ask: "gains", replace: replaceGains === state.description.file }).catch(() => ({ error: GONE }));
    gains.disabled = false;
    replaceGains = answer.exists ? state.description.file : "";
    if (answer.exists) say(`${answer.exists.join(", ")} exist: press Gain files again to replace them`);
    else say(answer.error ?? `wrote ${answer.written.join(", ")}`, answer.error ? "error" : "note");
  }

  // --- another design ---
  async function listDesigns() {
    const answer = await transport.ask({ ask: "designs" }).catch(() => ({ designs: [] }));
    const rows = answer.designs ?? [];
    designs.replaceChildren(...rows.map((one) => element("option", { value: one.id, selected: one.open }, `${one.folder ? `${one.folder}/` : ""}${one.name}${one.gains ? " (gain files)" : ""}`)));
    designs.parentElement.hidden = rows.length < 2;
    designs.own = rows.find((one) => one.open)?.id;
  }

  async function openDesign(id, discard = false) {
    say("opening…");
    const answer = await transport.ask({ ask: "switch", id, discard }).catch(() => ({ error: GONE }));
    say(answer.error ?? "", answer.error ? "error" : "note");
    if (!answer.open) designs.value = designs.own;
    if (answer.unsaved) {
      leaving.querySelector("p").textContent = `${answer.unsaved.slice(0, 6).join(", ")}${answer.unsaved.length > 6 ? ` and ${answer.unsaved.length - 6} more` : ""}`;
      leaving.onclose = () => { if (leaving.returnValue === "discard") openDesign(id, true); else if (leaving.returnValue === "save") openSave(); };
      leaving.returnValue = "";
      leaving.showModal();
    }
    if (!answer.open) return;
    Object.assign(state, { undo: [], redo: [], pins: [], candidates: [], front: [], picture: null, ghost: null, proof: null, safe: null, requirements: {}, past: {}, simulated: null, map: null, there: null,
      run: answer.open.runs[0], load: answer.open.loads[0]?.name ?? "", runGroup: "", loadGroup: "", hidden: new Set(), redesign: true, poles: state.poles === "map" ? "slow" : state.poles });
    before = null;
    tuner.reset();
    controls.replaceChildren();
    state.values = Object.fromEntries(answer.open.fields.map((field) => [field.key, field.value]));
    describe(answer.open);
    refresh();
  }

  function turnTheme() {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
  }

  // --- keys ---
  root.addEventListener("keydown", onKey);
  function onKey(event) {
    if (root.inert || saving.open || shortcuts.open || leaving.open) return;
    const key = event.key.toLowerCase(), control = event.ctrlKey || event.metaKey;
    const typing = event.target.matches?.("input[type=text], input[type=search], select");
    const typed = event.target.matches?.("input[type=text]") && event.target.value !== event.target.dataset.shown;
    const run = (action) => { event.preventDefault(); action(); };
    if (control && key === "s") run(openSave);
    else if (control && !typed && (key === "y" || (key === "z" && event.shiftKey))) run(() => step("redo", "undo"));
    else if (control && !typed && key === "z") run(() => step("undo", "redo"));
    else if (control || event.altKey || typing) return;
    else if (key === "p") run(pinDesign);
    else if (key === "r") run(() => reset.click());
    else if (key === "/") run(() => panel.seek.focus());
    else if (key === "?") run(() => shortcuts.showModal());
  }

  function describe(next) {
    state.description = next;
    listDesigns();
    const tail = next.fields.some((field) => field.group === "Machine") ? [element("label", { class: "switch", title: "off: the controller believes in the machine of the file, and runs on this one" }, redesign, "design for the machine's numbers")] : [];
    const opened = new Set([...controls.querySelectorAll("details[open]")].map((box) => box.dataset.group));
    panel = createPanel(next, change, (text) => say(text, "error"));
    if (opened.size) for (const box of panel.nodes) box.open = opened.has(box.dataset.group);
    controls.replaceChildren(tuner.node, panel.seek, element("div", { class: "switches" }, element("label", { class: "switch" }, ties, "equal values move together"), ...tail), ...panel.nodes);
    worst.hidden = !next.runs.includes(WORST);
    runList.fill(next.runs.map((run) => [run, run]));
    loadList.fill(next.loads.map((load) => [load.name, `1 ${load.unit} of ${load.name}`]));
    runGroups.fill(timeGroups(next, true).map((group) => [group.id, group.text]));
    loadGroups.fill(timeGroups(next, false).map((group) => [group.id, group.text]));
    for (const [list, first] of [[runGroups, timeGroups(next, true)[0]], [loadGroups, timeGroups(next, false)[0]]]) if (!list.value) list.value = first.id;
    panel.show(state.values);
    redesign.checked = state.redesign;
  }

  describe(description);
  transport.listen(hear);
  await ask();
}
