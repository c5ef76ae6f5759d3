// Designs from where the page stands: candidates of a search, and the front of margin against noise under one slider.

import { element } from "./controls.js";
import { digits, quantity } from "./numbers.js";

const SHOWN = 6; // candidates at once, the newest
const STARTS = { tune: "tuning from here…", front: "computing the front…" };

const priceOf = (point) => point.picture.figures.find((one) => one.label.startsWith(point.price)); // of the margin
const boundWords = (name) => name.replaceAll("_", " ");

// Of points {margin, picture} those that no other beats in both, by margin; a design without a proven margin is none.
export function undominated(points) {
  const known = points.filter((one) => one.margin > 0 && priceOf(one)), price = (one) => priceOf(one).value;
  const beats = (a, b) => a.margin >= b.margin && price(a) <= price(b) && (a.margin > b.margin || price(a) < price(b));
  return known.filter((one) => !known.some((other) => beats(other, one))).sort((a, b) => a.margin - b.margin);
}

export const pointText = (point) => {
  const price = priceOf(point), missed = point.limit ? `, misses ${boundWords(point.limit)} by ${digits(100 * (point.ratio - 1), 2)} %` : "";
  return `${point.proven} proven · ${quantity(price.value, price.unit)} ${price.label.split(" [")[0]}${missed}`;
};

// What a candidate misses most, or is nearest to: its ratio is at most 1 where all hold.
export const limitText = ({ name, limit, ratio }) => `${name}  ${ratio > 1 ? `misses ${boundWords(limit)} by ${digits(100 * (ratio - 1), 2)} %` : `holds all${limit ? `, nearest ${boundWords(limit)}` : ""}`}`;

// state.candidates are drawn beside the design. ask(document) -> promise; place(values, done) moves the design to others.
export function createTuner(state, { ask, place, say, redraw }) {
  const button = (text, title, press) => element("button", { type: "button", title, onclick: press }, text);
  const tune = button("Tune from here", "malta tune, begun at these numbers", () => begin("tune"));
  const trade = button("", "the front about this design: what each margin costs", () => begin("front"));
  const stop = button("Stop", "what was found stays", () => begin("stop"));
  const clear = button("Clear", "forget what was found", () => { Object.assign(state, { candidates: [], front: [] }); redraw(); });
  const status = element("p", { class: "soft", role: "status" });
  const list = element("div", { class: "found" });
  const slider = element("input", { type: "range", min: 0, max: 0, step: 1, "aria-label": "point of the front" });
  const label = element("output", {});
  const master = element("div", { class: "row master" }, label, slider);
  const node = element("section", { class: "tuner", "aria-label": "search from this design" }, element("div", { class: "buttons" }, tune, trade, stop, clear), status, list, master);
  const found = { running: "", from: {}, redesign: true };
  Object.assign(state, { candidates: [], front: [] });

  async function begin(task) {
    const values = { ...state.values };
    const answer = await ask(task).catch((problem) => ({ error: problem.message }));
    if (answer.error) { say(answer.error, "error"); return; }
    const stopped = task === "stop";
    Object.assign(found, { running: stopped ? "" : task }, stopped ? {} : { from: values });
    status.textContent = stopped ? "stopped: what was found stays" : STARTS[task];
    if (!stopped) Object.assign(state, task === "tune" ? { candidates: [] } : { front: [] });
    redraw();
  }

  function take(item) {
    if (!Object.keys(found.from).length) found.from = { ...state.values };
    const one = { ...item, name: `${item.of === "tune" ? "T" : "F"}${item.number}`, values: { ...found.from, ...item.values } };
    found.running = item.of;
    if (item.of === "tune") state.candidates = [...state.candidates.filter((other) => other.number !== one.number), one];
    else state.front = undominated([...state.front, one]);
    status.textContent = `${STARTS[item.of]} ${item.of === "tune" ? `${item.trials} trials` : `${item.number} designs`}`;
  }

  // News without a version: they are of the search, wherever the page has moved since.
  function hear(item) {
    if (item.kind === "candidate") take(item);
    if (item.kind === "notice") { Object.assign(state, { candidates: [], front: [] }); say(item.text); }
    if (item.kind === "searched") {
      found.running = "";
      const none = item.of === "tune" ? "nothing better was found: this design is as near as the search comes" : "no point was found";
      status.textContent = item.error ? "" : item.count ? "ended: one click takes a design, Ctrl Z goes back" : none;
      if (item.error) say(item.error, "error");
    }
    redraw();
  }

  function show() {
    trade.textContent = `Margin against ${state.description.law === "PID" ? "load" : "noise"}`;
    stop.hidden = !found.running;
    clear.hidden = !state.candidates.length && !state.front.length;
    list.replaceChildren(...state.candidates.slice(-SHOWN).map((one) => button(limitText(one), "take this design; the words name the requirement that it misses most, or is nearest to", () => place(one.values, true))));
    master.hidden = state.front.length < 2;
    if (master.hidden) return;
    const same = (one) => Object.entries(one.values).every(([key, value]) => state.values[key] === value);
    const at = state.front.findIndex(same);
    slider.max = state.front.length - 1;
    if (at >= 0) slider.value = at;
    const text = pointText(state.front[Number(slider.value)]);
    label.textContent = at < 0 ? `front of ${state.front.length}: the design is none of its points` : text;
    slider.setAttribute("aria-valuetext", text);
  }

  const slide = (done) => { place(state.front[Number(slider.value)].values, done); show(); };
  slider.addEventListener("input", () => slide(false));
  slider.addEventListener("change", () => slide(true));
  const reset = () => { Object.assign(found, { running: "", from: {} }); status.textContent = ""; };
  return { node, hear, show, reset };
}
