// Colours of the map by state, flag, name or number, for light and dark pages, and the legend.

import { mix } from "../scale.js";
import { DATA } from "./data.js";

export const STATE_KEYS = Object.keys(DATA.stateNames);
const STATE_COLOURS = {
  light: { fine: "#bcd9ee", flagged: "#ffb43d", "no-road": "#e3d9c2", failed: "#e0475c", pending: "#c9ccd2" },
  dark: { fine: "#4f7fa3", flagged: "#ffab2e", "no-road": "#8d8168", failed: "#ee4f66", pending: "#5a6270" },
};
const RAMPS = {
  light: ["#fff6d5", "#fed98e", "#fd9f4e", "#e2543b", "#a8123a", "#5d0b35"],
  dark: ["#26435a", "#3f6472", "#80795a", "#d08a3c", "#f7b045", "#fff3b0"],
};
const SIGNED = {
  light: ["#2166ac", "#7fb3d5", "#f4f2ee", "#f0a582", "#b2182b"],
  dark: ["#6fb7f2", "#3f6f9c", "#48505a", "#a8604a", "#ff8f78"],
};
const NAMES = {
  light: ["#a6cee3", "#fdbf6f", "#b2df8a", "#cab2d6", "#fb9a99", "#ffff99", "#d9d9d9", "#80cdc1"],
  dark: ["#4d86a8", "#b9792b", "#5f9440", "#7d62a0", "#b2504f", "#a39b3a", "#777d85", "#3f8f85"],
};
const BARS = 18;
const NO_CHANGE = 0.01; // Ends of a scale of differences if all are 0.

export const darkMedia = window.matchMedia("(prefers-color-scheme: dark)");
export let printing = false;
export const setPrinting = (now) => { printing = now; };
const isDark = () => darkMedia.matches && !printing;
const tone = () => (isDark() ? "dark" : "light");

export function themeColours() {
  return isDark()
    ? { dark: true, ground: "#171c23", beyond: "#6d747d", none: "#39414c", edge: "rgba(0,0,0,.45)", halo: "#10141a", mark: "#ffffff" }
    : { dark: false, ground: "#eef1f4", beyond: "#ffffff", none: "#d3d8de", edge: "rgba(255,255,255,.6)", halo: "#ffffff", mark: "#111820" };
}

export function format(value) {
  if (value === null || value === undefined) return "–";
  if (Math.abs(value) >= 100) return Math.round(value).toLocaleString("en-US");
  return String(Number(value.toPrecision(3)));
}

export const withUnit = (value, unit) => (unit === "%" || unit === "°" ? format(value) + unit : `${format(value)} ${unit}`.trim());

// A scale gives the colour of a tile, the text of its value, and the entries of the legend.
export function scaleOf(key) {
  if (key === "state") return stateScale();
  if (key === "flags") return flagScale();
  if (key.startsWith("flag:")) return oneFlagScale(Number(key.slice(5)));
  const column = DATA.columns.find((one) => one.key === key);
  return column.names ? nameScale(column) : numberScale(column);
}

function countBy(kinds, kindOf) {
  const counts = new Map(kinds.map((kind) => [kind, 0]));
  for (let i = 0; i < DATA.ids.length; i++) {
    const kind = kindOf(i);
    if (kind !== null) counts.set(kind, (counts.get(kind) || 0) + 1);
  }
  return counts;
}

function kindScale(title, kinds, kindOf, colourOf, nameOf) {
  const counts = countBy(kinds, kindOf);
  return {
    title,
    colour: (i) => { const kind = kindOf(i); return kind === null ? null : colourOf(kind); },
    text: (i) => { const kind = kindOf(i); return kind === null ? "no value" : nameOf(kind); },
    kind: kindOf,
    entries: () => kinds.filter((kind) => counts.get(kind)).map((kind) => ({
      kind, colour: colourOf(kind), name: nameOf(kind), count: counts.get(kind) })),
  };
}

function stateScale() {
  return kindScale("state of the tiles", STATE_KEYS, (i) => STATE_KEYS[DATA.states[i]],
    (kind) => STATE_COLOURS[tone()][kind], (kind) => DATA.stateNames[kind]);
}

export const isDone = (i) => !["failed", "pending"].includes(STATE_KEYS[DATA.states[i]]);
export const flagNamesOf = (i) => DATA.flagNames.filter((_, bit) => DATA.flags[i] & (1 << bit));

function flagScale() {
  const kinds = ["no flag", "one flag", "two flags", "three or more flags"];
  const colours = { "no flag": 0.02, "one flag": 0.35, "two flags": 0.6, "three or more flags": 0.85 };
  return kindScale("number of flags", kinds, (i) => (isDone(i) ? kinds[Math.min(flagNamesOf(i).length, 3)] : null),
    (kind) => mix(RAMPS[tone()], colours[kind]), (kind) => kind);
}

function oneFlagScale(bit) {
  const name = DATA.flagNames[bit];
  return kindScale(`flag ${name}`, [name, `not ${name}`],
    (i) => (isDone(i) ? (DATA.flags[i] & (1 << bit) ? name : `not ${name}`) : null),
    (kind) => (kind === name ? STATE_COLOURS[tone()].flagged : STATE_COLOURS[tone()].fine), (kind) => kind);
}

function nameScale(column) {
  const kinds = [...new Set(column.names)].filter((name) => name).sort();
  return kindScale(column.label, kinds, (i) => column.names[i] || null,
    (kind) => NAMES[tone()][kinds.indexOf(kind) % NAMES.light.length], (kind) => kind);
}

function numberScale(column) {
  const { values, unit, label } = column;
  const sorted = values.filter((v) => v !== null).sort((a, b) => a - b);
  const at = (share) => sorted[Math.round(share * (sorted.length - 1))];
  const signed = column.signed || (at(0) < 0 && at(1) > 0);
  let low = at(0.02), high = at(0.98);
  if (signed) { high = Math.max(-low, high) || NO_CHANGE; low = -high; }
  if (!(high > low)) { low -= Math.abs(low) * 0.05 || 0.5; high += Math.abs(high) * 0.05 || 0.5; }
  const colourAt = (v) => mix((signed ? SIGNED : RAMPS)[tone()], (v - low) / (high - low));
  return {
    title: unit ? `${label} (${unit})` : label,
    colour: (i) => (values[i] === null ? null : colourAt(values[i])),
    text: (i) => (values[i] === null ? "no value" : withUnit(values[i], unit)),
    numbers: { low, high, colourAt, sorted, below: sorted[0] < low, above: sorted[sorted.length - 1] > high,
               missing: values.length - sorted.length, limit: column.limit },
  };
}

// --- legend -----------------------------------------------------------------------------------------

// Taken from the page, so that the file has no web address.
const SVG = document.getElementById("svg").namespaceURI;

export function element(tag, attributes = {}, ...children) {
  const node = tag.startsWith("svg:") ? document.createElementNS(SVG, tag.slice(4)) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children);
  return node;
}

export function drawLegend(box, scale, dimmed, toggle) {
  box.replaceChildren(element("h3", {}, scale.title));
  box.append(scale.numbers ? numberLegend(scale.numbers) : kindLegend(scale, dimmed, toggle));
}

function kindLegend(scale, dimmed, toggle) {
  const list = element("ul", { class: "kinds" });
  for (const { kind, colour, name, count } of scale.entries()) {
    const swatch = element("span", { class: "swatch" });
    swatch.style.background = colour;
    if (kind === "failed") swatch.textContent = "×";
    if (kind === "pending") swatch.textContent = "\\";
    const button = element("button", { type: "button", "aria-pressed": String(!dimmed.has(kind)),
      title: "Show or hide these tiles" }, swatch, element("span", {}, name),
      element("span", { class: "count" }, count.toLocaleString("en-US")));
    button.addEventListener("click", () => toggle(kind));
    list.append(element("li", {}, button));
  }
  return list;
}

function numberLegend({ low, high, colourAt, sorted, below, above, missing, limit }) {
  const width = 280, height = 56, counts = new Array(BARS).fill(0);
  for (const v of sorted) {
    counts[Math.min(BARS - 1, Math.max(0, Math.floor(((v - low) / (high - low)) * BARS)))]++;
  }
  const top = Math.max(...counts), svg = element("svg:svg", {
    viewBox: `0 0 ${width} ${height + 36}`, role: "img", "aria-label": "Colours and number of tiles by value" });
  counts.forEach((n, i) => {
    const x = (i * width) / BARS, tall = n ? Math.max(2, (n / top) * height) : 0;
    const fill = colourAt(low + ((i + 0.5) / BARS) * (high - low));
    svg.append(element("svg:rect", { x: x + 0.5, y: height - tall, width: width / BARS - 1, height: tall, class: "count-bar" }),
      element("svg:rect", { x, y: height + 3, width: width / BARS + 0.5, height: 12, fill }));
  });
  const ends = [[low, "start", 0, below ? "≤ " : ""], [(low + high) / 2, "middle", width / 2, ""], [high, "end", width, above ? "≥ " : ""]];
  for (const [value, anchor, x, sign] of ends) {
    svg.append(element("svg:text", { x, y: height + 31, "text-anchor": anchor }, sign + format(value)));
  }
  if (limit !== null && limit !== undefined && limit > low && limit < high) {
    const x = ((limit - low) / (high - low)) * width;
    svg.append(element("svg:path", { class: "limit", d: `M${x} 0V${height + 15}` },
      element("svg:title", {}, `flag above ${format(limit)}`)));
  }
  const box = element("div", {}, svg);
  if (missing) box.append(element("p", { class: "soft" }, `${missing.toLocaleString("en-US")} without a value`));
  return box;
}
