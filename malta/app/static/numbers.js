// Numbers as engineers write them: prefixes, ticks, digits.

const PREFIXES = [[1e12, "T"], [1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"], [1e-12, "p"]];
const PLAIN = new Set(["m", "rad", "N", "s", "A", "V", "Hz", "W", "N m", "H", "F", "K", "m/s", "m/s^2"]);
const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";

// A unit as it is printed: um as µm, ohm as Ω, ^2 as ².
export function printedUnit(unit) {
  return (unit === "1" ? "" : unit)
    .replace(/\bu(?=(m|s|A|V|rad|N|H|F|Wb)\b)/g, "µ")
    .replace(/\bohm\b/g, "Ω")
    .replace(/\bmohm\b/g, "mΩ")
    .replace(/\^(-?)(\d)/g, (_, sign, digit) => (sign ? "⁻" : "") + SUPERSCRIPTS[digit]);
}

// The factor and the unit in which values up to `size` read well.
export function scaleFor(size, unit) {
  if (!PLAIN.has(unit) || !(size > 0) || !Number.isFinite(size)) return { factor: 1, unit: printedUnit(unit) };
  const [factor, prefix] = PREFIXES.find(([f]) => size >= 0.9995 * f) ?? PREFIXES[PREFIXES.length - 1];
  return { factor, unit: prefix + printedUnit(unit) };
}

const SCALES = { T: 1e12, G: 1e9, M: 1e6, k: 1e3, "": 1, m: 1e-3, u: 1e-6, n: 1e-9, p: 1e-12 };
const BASES = [...PLAIN, "g", "ohm", "Wb", "T"].filter((base) => !/[ /^]/.test(base));

// A unit as its size and what it is of: "um s" is 1e-6 of "m s".
export function sizeOf(unit) {
  const plain = unit.trim().replace(/[µμ]/g, "u").replace(/Ω/g, "ohm").replace(/²/g, "^2");
  const [, head, tail] = /^([A-Za-z]*)(.*)$/.exec(plain), base = BASES.find((one) => head.endsWith(one) && head.slice(0, -one.length) in SCALES);
  return base && !tail.startsWith("^") ? [SCALES[head.slice(0, -base.length)], base + tail] : [1, plain];
}

// The number that is typed for a field, its unit behind it or not: "12 um", "0.012 mm". NaN for what is none; a comma is
// refused, since 1,000 may be one or a thousand.
export function numberIn(text, unit) {
  const found = /^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(.*?)\s*$/i.exec(text.replace("−", "-"));
  if (!found) return NaN;
  const [typed, own] = [sizeOf(found[2]), sizeOf(unit)];
  if (!found[2]) return Number(found[1]);
  return typed[1] === own[1] ? Number((Number(found[1]) * (typed[0] / own[0])).toPrecision(12)) : NaN;
}

// A number with so many digits, without an exponent where that is short.
export function digits(value, count = 4) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  const size = Math.abs(value);
  const text = size !== 0 && (size >= 1e6 || size < 1e-4) ? value.toExponential(count - 1).replace(/\.?0+e/, "e") : String(Number(value.toPrecision(count)));
  return text.replace("e+", "e").replace("-", "−");
}

// A value with its unit and a prefix.
export function quantity(value, unit, count = 3) {
  if (value === null || value === undefined) return "–";
  if (value === 0) return `0 ${printedUnit(unit)}`.trim();
  const scale = scaleFor(Math.abs(value), unit);
  return `${digits(value / scale.factor, count)} ${scale.unit}`.trim();
}

// A frequency, in rad/s and in Hz.
export const hertz = (w, count = 4) => `${digits(w, count)} rad/s (${quantity(w / (2 * Math.PI), "Hz", Math.min(count, 3))})`;

export const percent = (share) => (share === null || share === undefined ? "–" : `${digits(100 * share, 4)} %`);

export const decibels = (size) => `${(20 * Math.log10(size)).toFixed(1)} dB`;

// Ticks of a linear axis: steps of 1, 2 or 5.
export function linearTicks(low, high, most = 6) {
  const raw = (high - low) / most;
  if (!(raw > 0) || !Number.isFinite(raw)) return [low];
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((s) => s * power >= raw) * power;
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) ticks.push(k * step);
  return ticks;
}

// Ticks of a logarithmic axis: major at powers of ten, or also at 2 and 5 where few decades are seen; minor between.
export function logTicks(low, high) {
  const first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high));
  const every = Math.max(1, Math.ceil((last - first) / 7));
  const few = Math.log10(high / low) < 1.6;
  const major = [], minor = [];
  for (let k = first; k <= last; k++) {
    for (let d = 1; d < 10; d++) {
      const value = d * 10 ** k;
      if (value < low * 0.9999 || value > high * 1.0001) continue;
      if (d === 1 ? k % every === 0 : few && (d === 2 || d === 5)) major.push(value);
      else minor.push(value);
    }
  }
  return { major, minor };
}

// The label of a tick.
export function tickLabel(value, log) {
  if (log && value !== 0) {
    const power = Math.log10(Math.abs(value));
    if (Number.isInteger(Number(power.toFixed(9))) && (power >= 4 || power <= -3)) {
      const text = String(Math.round(power));
      return "10" + [...text].map((c) => (c === "-" ? "⁻" : SUPERSCRIPTS[c])).join("");
    }
  }
  return digits(Number(value.toPrecision(6)), 6);
}
