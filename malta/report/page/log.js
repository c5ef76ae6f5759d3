// The panels of a log: uPlot draws, this file zooms them together, tells values by keys, and turns colours with the page.
"use strict";
const data = JSON.parse(document.getElementById("log-data").textContent);
const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
const numbers = (text) => Array.from(new Float32Array(bytesOf(text)), (value) => (Number.isNaN(value) ? null : value));
const times = Array.from(new Float64Array(bytesOf(data.t)));
const frequencies = numbers(data.f), whole = [times[0] ?? 0, times[times.length - 1] ?? 1];
const LIGHT = { ink: "#1b1f24", grid: "#e3e6ea", line: "#e07b00", lines: ["#00568a", "#d55e00", "#008a63", "#b4458a", "#9a7b00", "#5a2fa0", "#2a3036", "#7d2906"] };
const DARK = { ink: "#e4e7eb", grid: "#2b3138", line: "#e0b040", lines: ["#56b4e9", "#f0904a", "#3fcf9f", "#e08cc0", "#f3e27a", "#9a7af0", "#f0f3f5", "#c9e8ff"] };
const HEIGHT = 200, FLOOR = 1e-7; // px; of the largest amplitude, below which there is rounding
const digits = (value) => (value === null || value === undefined ? "–" : String(Number(value.toPrecision(5))).replace("-", "−"));
const POWERS = "⁰¹²³⁴⁵⁶⁷⁸⁹";
const decade = (value) => { // at a tick of a logarithmic axis
  if (value === null) return "";
  const power = Math.round(Math.log10(value));
  return Math.abs(power) < 4 ? digits(value) : `10${power < 0 ? "⁻" : ""}${[...String(Math.abs(power))].map((d) => POWERS[d]).join("")}`;
};
// The value at a place: of a long log the least and the largest of its interval.
function valueAt(values, at, unit) {
  if (at === null || at === undefined) return "–";
  const low = values[data.whole ? at : at - (at % 2)], high = values[data.whole ? at : at - (at % 2) + 1];
  return `${digits(low)}${low === high || low === null ? "" : ` … ${digits(high)}`} ${unit}`;
}
const dark = matchMedia("(prefers-color-scheme: dark)"), told = document.getElementById("told"), span = document.getElementById("span");
const signals = data.panels.map((panel) => panel.signals.map((signal) => ({ ...signal, values: numbers(signal.values), amplitude: numbers(signal.amplitude).map((value) => (value > 0 ? value : null)) })));
const hidden = new Set(); // names
document.documentElement.style.setProperty("--entry", data.whole ? "9.5rem" : "15rem"); // of a value, so that nothing moves
let charts = [], shown = [...whole], paper = 0;

function seriesOf(panel, k, spectrum, colours) {
  return signals[k].map((signal, n) => ({
    label: signal.name, stroke: colours.lines[n % 8], width: 1.2, show: !hidden.has(signal.name), points: { show: false },
    dash: signal.group === "reference" ? [2, 3] : n >= 8 ? [6, 3] : undefined,
    value: (_, value, _series, at) => (spectrum ? `${digits(value)} ${panel.unit}` : valueAt(signal.values, at, panel.unit)),
  }));
}

function create(parent, panel, k, spectrum) {
  const colours = dark.matches && !paper ? DARK : LIGHT, axis = { stroke: colours.ink, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif", values: (_, splits) => splits.map(spectrum ? decade : (value) => (value === null ? "" : digits(value))), grid: { stroke: colours.grid, width: 1 }, ticks: { stroke: colours.grid, width: 1 } };
  const node = document.createElement("div"), words = `${panel.signals.map((one) => one.name).join(", ")}${panel.unit ? ` [${panel.unit}]` : ""}`;
  node.className = "panel";
  node.tabIndex = 0;
  node.setAttribute("role", "group");
  node.setAttribute("aria-label", spectrum ? `spectrum of ${words}` : `${words} over time; arrow keys move the cursor`);
  parent.append(node);
  const marks = (u) => {
    u.ctx.fillStyle = colours.line;
    for (const f of data.lines) u.ctx.fillRect(u.valToPos(f, "x", true) - devicePixelRatio, u.bbox.top + u.bbox.height - 7 * devicePixelRatio, 2 * devicePixelRatio, 7 * devicePixelRatio);
  };
  const log = spectrum ? { distr: 3 } : {};
  const chart = new uPlot({
    width: paper || node.clientWidth || 600, height: HEIGHT,
    cursor: { sync: { key: spectrum ? "spectra" : "log" }, drag: { x: true, y: false }, focus: { prox: 24 } }, focus: { alpha: 0.35 },
    scales: { x: { time: false, ...log, ...(spectrum ? {} : { min: shown[0], max: shown[1] }) }, y: spectrum ? { ...log, range: (_, low, high) => [Math.max(low, FLOOR * high), 2 * high] } : {} },
    axes: [{ ...axis, size: 34, ...(k === data.panels.length - 1 ? { label: spectrum ? "frequency [Hz]" : "time [s]", labelSize: 18 } : {}) }, { ...axis, size: 62, label: panel.unit || "1", labelSize: 18 }],
    series: [{ label: spectrum ? "frequency" : "time", value: (_, x) => (x === null ? "–" : `${digits(x)} ${spectrum ? "Hz" : "s"}`) }, ...seriesOf(panel, k, spectrum, colours)],
    hooks: {
      setScale: [(u, name) => { if (!spectrum && name === "x") show(u.scales.x.min, u.scales.x.max); }],
      setCursor: [(u) => { if (!spectrum && u.cursor.idx !== null && u.cursor.idx !== undefined) where(times[u.cursor.idx]); }],
      setSeries: [(u, n, now) => { if (n && now.show !== undefined) hidden[now.show ? "delete" : "add"](u.series[n].label); }],
      draw: spectrum ? [marks] : [],
    },
  }, [spectrum ? frequencies : times, ...signals[k].map((signal) => (spectrum ? signal.amplitude : signal.values))], node);
  chart.root.addEventListener("dblclick", () => { if (!spectrum) show(...whole); });
  if (!spectrum) node.addEventListener("keydown", (event) => press(event, chart, panel, k));
  charts.push({ chart, node, spectrum });
}

function where(t) { span.textContent = `${digits(shown[0])} to ${digits(shown[1])} s${t === undefined ? "" : `, cursor at ${digits(t)} s`}`; }

// All panels show the same seconds.
function show(low, high) {
  const room = whole[1] - whole[0], least = 4 * (room / Math.max(1, times.length - 1)), size = Math.max(Math.min(high - low, room), least);
  const from = Math.max(whole[0], Math.min(low, whole[1] - size));
  if (from === shown[0] && from + size === shown[1]) return;
  shown = [from, from + size];
  for (const { chart, spectrum } of charts) if (!spectrum) chart.setScale("x", { min: shown[0], max: shown[1] });
  where();
}

const ACTS = {
  in: () => zoom(0.5), out: () => zoom(2), whole: () => show(...whole),
  back: () => move(-0.5), on: () => move(0.5),
};
const zoom = (factor, about = (shown[0] + shown[1]) / 2) => show(about - factor * (about - shown[0]), about + factor * (shown[1] - about));
const move = (share) => { const by = share * (shown[1] - shown[0]); show(shown[0] + by, shown[1] + by); };
for (const button of document.querySelectorAll(".tools button")) button.addEventListener("click", () => ACTS[button.dataset.act]());

function press(event, chart, panel, k) {
  const at = chart.cursor.idx ?? chart.posToIdx(chart.over.clientWidth / 2);
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "+" || event.key === "=") zoom(0.5, times[at]);
  else if (event.key === "-") zoom(2, times[at]);
  else if (event.key === "0") show(...whole);
  else if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
    const pixels = Math.max(1, Math.round((chart.posToIdx(event.shiftKey ? 20 : 2) - chart.posToIdx(0))));
    const next = Math.max(0, Math.min(times.length - 1, at + (event.key === "ArrowLeft" ? -pixels : pixels)));
    if (times[next] < shown[0] || times[next] > shown[1]) move(times[next] < shown[0] ? -0.5 : 0.5);
    for (const one of charts) if (!one.spectrum) one.chart.setCursor({ left: one.chart.valToPos(times[next], "x"), top: one.chart.over.clientHeight / 2 });
    told.textContent = [`${digits(times[next])} s`, ...signals[k].filter((one) => !hidden.has(one.name)).map((one) => `${one.name} ${valueAt(one.values, next, panel.unit)}`)].join(", ");
  } else return;
  event.preventDefault();
}

function build() {
  const focus = charts.findIndex(({ node }) => node === document.activeElement);
  for (const { chart, node } of charts) { chart.destroy(); node.remove(); }
  charts = [];
  for (const [id, spectrum] of [["panels", false], ["spectra", true]]) data.panels.forEach((panel, k) => create(document.getElementById(id), panel, k, spectrum));
  if (focus >= 0) charts[focus].node.focus({ preventScroll: true });
}
build();
where();
dark.addEventListener("change", build);
matchMedia("print").addEventListener("change", (media) => { paper = media.matches ? 660 : 0; build(); });
addEventListener("resize", () => { for (const { chart, node } of charts) chart.setSize({ width: node.clientWidth, height: HEIGHT }); });
