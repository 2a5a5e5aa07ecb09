// The chart of a section, as SVG.

import { el, fill, svg } from "./dom.js";
import { metres, signed } from "./place.js";

const SERIES = [
  { name: "dsm", label: "Scan" },
  { name: "dtm", label: "Terrain model" },
  { name: "surface", label: "Surface" },
];
const MARGIN = { left: 52, right: 14, top: 24, bottom: 26 };

/** Draws stations into an element; `hover(station)` is called with the station under the pointer, or null. */
export function chart(element, stations, hover) {
  const [width, height] = [Math.max(element.clientWidth, 260), Math.max(element.clientHeight, 120)];
  const values = stations.flatMap((station) => SERIES.map(({ name }) => station[name])).filter((z) => !Number.isNaN(z));
  if (!values.length) {
    fill(element, el("p", { class: "quiet" }, "No surface is loaded along this line."));
    return;
  }
  const length = stations[stations.length - 1].distance || 1;
  const [low, high] = padded(Math.min(...values), Math.max(...values));
  const x = (distance) => MARGIN.left + (distance / length) * (width - MARGIN.left - MARGIN.right);
  const y = (z) => MARGIN.top + ((high - z) / (high - low)) * (height - MARGIN.top - MARGIN.bottom);
  const cursor = svg("line", { class: "cursor", y1: MARGIN.top, y2: height - MARGIN.bottom, visibility: "hidden" });
  const text = el("output", { class: "values" });
  const drawing = svg(
    "svg",
    { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": "Heights along the section" },
    ticks(low, high, 4).map((z) => [
      svg("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: y(z), y2: y(z) }),
      svg("text", { x: MARGIN.left - 8, y: y(z) + 4, "text-anchor": "end" }, decimal(z, high - low)),
    ]).flat(),
    ticks(0, length, width < 500 ? 4 : 8).map((distance) =>
      svg("text", { x: x(distance), y: height - 8, "text-anchor": "middle" }, `${decimal(distance, length)} m`),
    ),
    SERIES.map(({ name }) => svg("path", { class: name, d: path(stations, name, x, y) })),
    cursor,
  );
  drawing.addEventListener("pointermove", (event) => {
    const box = drawing.getBoundingClientRect();
    const share = ((event.clientX - box.left) * (width / box.width) - MARGIN.left) / (width - MARGIN.left - MARGIN.right);
    const station = stations[Math.round(Math.min(Math.max(share, 0), 1) * (stations.length - 1))];
    cursor.setAttribute("x1", x(station.distance));
    cursor.setAttribute("x2", x(station.distance));
    cursor.setAttribute("visibility", "visible");
    fill(text, described(station));
    hover(station);
  });
  drawing.addEventListener("pointerleave", () => {
    cursor.setAttribute("visibility", "hidden");
    fill(text);
    hover(null);
  });
  fill(element, drawing, text);
}

/** Returns the legend of a chart. */
export function legend() {
  return SERIES.map(({ name, label }) =>
    el("span", { class: "key" }, svg("svg", { width: 22, height: 8 }, svg("path", { class: name, d: "M1 4H21" })), label),
  ).reverse();
}

function described(station) {
  const off = (name, label) => (Number.isNaN(station[name]) ? "" : `, ${label} ${signed(station[name] - station.surface, 2)} m`);
  const surface = Number.isNaN(station.surface) ? "no surface" : `surface ${metres(station.surface)} m`;
  return `At ${station.distance.toFixed(1)} m: ${surface}${off("dsm", "scan")}${off("dtm", "terrain model")}`;
}

function path(stations, name, x, y) {
  let pen = false;
  return stations
    .map((station) => {
      if (Number.isNaN(station[name])) {
        pen = false;
        return "";
      }
      const point = `${pen ? "L" : "M"}${x(station.distance).toFixed(1)} ${y(station[name]).toFixed(1)}`;
      pen = true;
      return point;
    })
    .join("");
}

function padded(low, high) {
  const room = Math.max((high - low) * 0.08, 0.25);
  return [low - room, high + room];
}

function ticks(low, high, most) {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((digit) => digit * power).find((size) => size >= rough);
  const found = [];
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) found.push(value);
  return found;
}

function decimal(value, range) {
  return value.toFixed(range < 2 ? 2 : range < 12 ? 1 : 0);
}
