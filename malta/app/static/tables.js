// The tables beside the charts: requirements as lights, figures of pinned designs, and what differs.

import { element } from "./controls.js";
import { digits, hertz, printedUnit, quantity } from "./numbers.js";

const SIGNS = { true: ["✓", "met"], false: ["✗", "not met"], null: ["…", "not known yet"] };

// Whether a margin is reached: by the verdict on the proof, or refuted by eigenvalues before it. Bounds come as text: who proves rounds.
function marginLight(asked, state) {
  const { proof, picture } = state, upper = proof?.upper ?? picture.margin?.upper, text = proof?.upper ? proof.lost : picture.margin?.lost;
  if (!picture.stable) return { holds: false, found: 0, how: "unstable loop" };
  if (proof?.holds !== undefined && proof?.holds !== null) return { holds: proof.holds, found: proof.lower ?? 0, text: proof.proven, how: proof.reason || "proven over the travel" };
  if (upper !== undefined && upper !== null && upper < asked) return { holds: false, found: upper, text, how: "lost there, by eigenvalues" };
  return { holds: null, found: upper ?? null, text, how: "eigenvalues; the proof follows" };
}

// "peak_sensitivity" as words; what follows the first space are names of signals and loads.
const wordsOf = (name) => [name.split(" ")[0].replaceAll("_", " "), ...name.split(" ").slice(1)].join(" ");

const boundText = (asked, value) => (asked.switch ? (value ? "yes" : "no") : asked.name === "margin" ? `${digits(100 * value, 10)} %` : quantity(value, asked.unit, 3));
// Hz stand below rad/s: beside them they would push the bound out of a narrow panel.
const inHertz = (asked, value) => (typeof value === "number" && asked.frequency ? [element("br", {}), element("small", { class: "soft" }, quantity(value / (2 * Math.PI), "Hz"))] : []);

// Failures first, then what is not known yet. A value of the last design stays, grey and without a verdict, until the new one comes.
export function requirementRows(description, state) {
  const past = (asked) => ({ holds: null, found: state.past?.[asked.name]?.found ?? null, text: state.past?.[asked.name]?.text, how: "of the last design", old: true });
  const judged = description.requirements.map((asked) => {
    const found = asked.name === "margin" ? marginLight(asked.asked, state) : state.requirements[asked.name];
    return { asked, found: found && (found.found !== null || found.holds !== null) ? found : past(asked) };
  });
  const rank = ({ found }) => (found.holds === false ? 0 : 1);
  return judged.sort((one, other) => rank(one) - rank(other)).map(({ asked, found }) => {
    const [sign, words] = SIGNS[found.holds ?? null];
    const value = found.found === null || found.found === undefined ? (found.holds === false ? "none" : "") : found.text ?? boundText(asked, found.found);
    const bound = asked.switch ? "" : `${asked.at_least ? "≥" : "≤"} ${boundText(asked, asked.asked)}`;
    return element("tr", { class: `light ${found.holds ?? "open"}${found.old ? " old" : ""}`, title: found.how ?? "" },
      element("td", { class: "sign", role: "img", "aria-label": words }, sign),
      element("td", {}, wordsOf(asked.name)), element("td", { class: "number" }, value, ...inHertz(asked, found.found)), element("td", { class: "number soft" }, bound));
  });
}

// What asking means, for a design file that asks for nothing: lines that this very design would just meet.
export function howToAsk(state) {
  const peak = state.picture.figures.find((one) => one.label === "peak |S|")?.value, margin = state.picture.margin?.upper;
  const lines = ["[specification]", ...(margin > 0 ? [`margin = ${digits(0.95 * margin, 2)}`] : []), `peak_sensitivity = ${digits(1.05 * (peak ?? 2), 2)}`];
  return element("div", { class: "soft asking" }, element("p", {}, "This design file asks for nothing, so no figure is judged. To ask means to bound a figure in the file: each bound is judged here at every move, by malta verify and in reports, and Tune from here searches numbers that hold them all. This design would just meet"), element("pre", {}, lines.join("\n")));
}

export function countLights(description, state) {
  const counts = { true: 0, false: 0, null: 0 };
  for (const row of requirementRows(description, state)) counts[row.classList.contains("true") ? "true" : row.classList.contains("false") ? "false" : "null"] += 1;
  return counts;
}

// A single column has room for Hz beside rad/s.
function figureRows(figures, proof, margin, alone = false) {
  const upper = proof?.upper ?? margin?.upper, lost = proof?.upper ? proof.lost : margin?.lost;
  const rows = figures.map((one) => ({ ...one, text: alone && one.frequency && one.value !== null ? hertz(one.value) : quantity(one.value, one.unit, 4) }));
  if (upper !== undefined && upper !== null) rows.unshift({ label: "margin, eigenvalues", value: upper, better: 1, text: `≤ ${lost}`, note: "upper bound" });
  if (proof?.lower !== undefined && proof?.lower !== null) rows.unshift({ label: "margin, proven", value: proof.lower, better: 1, text: proof.proven, note: proof.reason });
  return rows;
}

// Figures of the design and of the pinned ones, the better of two marked.
export function figureTable(state) {
  const columns = [{ name: "now", rows: figureRows(state.picture.figures, state.proof, state.picture.margin, !state.pins.length && !state.candidates.length) }];
  for (const pin of [...state.pins, ...state.candidates]) columns.push({ name: pin.name, rows: figureRows(pin.picture.figures, pin.proof, pin.picture.margin) });
  const labels = [...new Set(columns.flatMap((column) => column.rows.map((row) => row.label)))];
  const head = element("tr", {}, element("th", {}, ""), ...columns.map((column) => element("th", { scope: "col", class: "number" }, column.name)));
  const body = labels.map((label) => {
    const cells = columns.map((column) => column.rows.find((row) => row.label === label));
    const known = cells.filter((cell) => cell && cell.value !== null), side = cells.find(Boolean).better;
    const best = known.reduce((one, other) => (side * other.value > side * one.value ? other : one), known[0])?.text; // ties are of the digits that are shown
    return element("tr", {}, element("th", { scope: "row" }, label), ...cells.map((cell) => {
      const wins = cell && side && cell.text === best && !known.every((one) => one.text === best);
      return element("td", { class: `number${wins ? " better" : ""}${cell?.old ? " old" : ""}`, title: cell?.note ?? "" }, cell ? (wins ? "★ " : "") + cell.text : "–");
    }));
  });
  return element("table", { class: "figures" }, element("thead", {}, head), element("tbody", {}, ...body));
}

// Entries that differ from the file, or between the design and a pinned one.
export function differenceTable(description, state) {
  const columns = [{ name: "file", values: Object.fromEntries(description.fields.map((field) => [field.key, field.value])) }, ...state.pins, { name: "now", values: state.values }];
  const rows = description.fields.filter((field) => columns.some((column) => column.values[field.key] !== columns[0].values[field.key]));
  if (!rows.length) return element("p", { class: "soft" }, "Nothing differs from the file.");
  const text = (value) => (typeof value === "number" ? digits(value, 5) : String(value));
  return element("table", { class: "figures" },
    element("thead", {}, element("tr", {}, element("th", {}, ""), ...columns.map((column) => element("th", { scope: "col", class: "number" }, column.name)))),
    element("tbody", {}, ...rows.map((field) => element("tr", {}, element("th", { scope: "row" }, `${field.key}${field.unit ? ` [${printedUnit(field.unit)}]` : ""}`),
      ...columns.map((column) => element("td", { class: `number${column.values[field.key] !== field.value ? " better" : ""}` }, text(column.values[field.key])))))));
}
