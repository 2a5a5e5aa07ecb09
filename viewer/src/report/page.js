// The page: joins map, legend, details of the selected tile and tables.

import {
  STATE_KEYS, darkMedia, drawLegend, element, flagNamesOf, format, isDone, scaleOf, setPrinting, withUnit,
} from "./colours.js";
import { DATA } from "./data.js";
import { TileMap } from "./map.js";
import { TileList, makeSortable } from "./tables.js";

const find = (id) => document.getElementById(id);
const select = find("colour-by"), panel = find("tile"), tip = find("tip"), hint = find("hint");
const dimmed = new Set();
let scale = scaleOf("state");
let tileList = null;

function fillSelect() {
  const group = (label, options) => {
    if (options.length) select.append(element("optgroup", { label }, ...options.map(([value, text]) => element("option", { value }, text))));
  };
  const used = DATA.flagNames.flatMap((name, bit) => {
    const n = DATA.flags.filter((bits) => bits & (1 << bit)).length;
    return n ? [[`flag:${bit}`, `${name} (${n.toLocaleString("en-US")})`]] : [];
  });
  group("Tiles", [["state", "state"], ...(used.length ? [["flags", "number of flags"]] : [])]);
  group("Flags", used);
  group("Figures", DATA.columns.filter((c) => c.values).map((c) => [c.key, c.unit ? `${c.label} (${c.unit})` : c.label]));
  group("Names", DATA.columns.filter((c) => c.names).map((c) => [c.key, c.label]));
  select.value = "state";
}

function recolour() {
  map.colours = (i) => (scale.kind && dimmed.has(scale.kind(i)) ? null : scale.colour(i));
  drawLegend(find("legend"), scale, dimmed, (kind) => {
    if (!dimmed.delete(kind)) dimmed.add(kind);
    recolour();
  });
  map.draw();
}

function grouped(value) {
  return Math.round(value).toLocaleString("en-US");
}

function hover(i, px, py) {
  const place = map.box.toGround(px, py);
  find("cursor").textContent = px === null ? "" : `${grouped(DATA.bounds[0] + place[0])} / ${grouped(DATA.bounds[1] + place[1])}`;
  tip.hidden = i < 0;
  if (i < 0) return;
  const value = select.value === "state" ? "" : `: ${scale.text(i)}`;
  tip.replaceChildren(element("b", {}, DATA.ids[i]), element("br"), `${DATA.stateNames[STATE_KEYS[DATA.states[i]]]}`,
    ...(value ? [element("br"), `${scale.title}${value}`] : []));
  tip.style.left = `${Math.min(px + 14, map.box.width - tip.offsetWidth - 4)}px`;
  tip.style.top = `${py + 18 + tip.offsetHeight > map.box.height ? py - tip.offsetHeight - 8 : py + 18}px`;
}

function drawScaleBar(pixels, text) {
  find("scale").style.width = `${pixels}px`;
  find("scale").textContent = text;
}

function selectTile(i, byKey = false) {
  map.selectNumber(i);
  history.replaceState(null, "", i < 0 ? location.pathname + location.search : `#tile=${encodeURIComponent(DATA.ids[i])}`);
  showDetails(i);
  if (i >= 0 && !byKey && window.innerWidth < 900) panel.scrollIntoView({ block: "nearest" });
}

function figure(column, i) {
  return column.names ? column.names[i] : withUnit(column.values[i], column.unit);
}

function flagInWords(name, i) {
  const meaning = DATA.meanings[name], column = DATA.columns.find((c) => c.key === meaning.column);
  const value = column ? format(column.values[i]) + (meaning.percent ? "%" : "") : "";
  const words = meaning.words.replace("{value}", value).replace("{limit}", meaning.limit);
  const place = (DATA.places[i] || {})[name];
  const at = place ? `, at ${grouped(place[0])} / ${grouped(place[1])}` : "";
  return [element("b", {}, name), `: ${words}${at}; ${meaning.remedy}.`];
}

function showDetails(i) {
  if (i < 0) {
    panel.replaceChildren(element("p", { class: "soft" }, "Choose a tile on the map, or by the arrow keys, for its figures."));
    return;
  }
  const state = STATE_KEYS[DATA.states[i]], flags = flagNamesOf(i), box = DATA.boxes[i];
  const parts = [element("h3", {}, DATA.ids[i]),
    element("p", { class: `state ${state}` }, DATA.stateNames[state])];
  if (DATA.errors[i]) parts.push(element("p", { class: "error" }, DATA.errors[i]));
  if (flags.length) parts.push(element("ul", {}, ...flags.map((name) => element("li", {}, ...flagInWords(name, i)))));
  parts.push(element("p", { class: "links" }, ...linksOf(i)));
  const figures = DATA.columns.filter((c) => c.names ? c.names[i] : c.values[i] !== null);
  const rows = figures.flatMap((c) => [element("dt", {}, c.label), element("dd", {}, figure(c, i))]);
  if (box) {
    const [west, south] = DATA.bounds;
    rows.push(element("dt", {}, "west, south"), element("dd", {}, `${grouped(west + box[0])} / ${grouped(south + box[1])}`));
  }
  parts.push(element("dl", {}, ...rows));
  panel.replaceChildren(...parts);
}

function linksOf(i) {
  const links = [];
  if (DATA.viewer && isDone(i)) links.push(element("a", { href: `${DATA.viewer}#tile=${encodeURIComponent(DATA.ids[i])}` }, "See it in 3D"));
  const pictures = find(`pictures-${i}`);
  if (pictures) {
    const link = element("a", { href: `#pictures-${i}` }, "Pictures");
    link.addEventListener("click", () => openAround(pictures));
    links.push(link);
  }
  return links.flatMap((link, k) => (k ? [" · ", link] : [link]));
}

function openAround(node) {
  for (let at = node; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
}

function tileOfHash() {
  const given = /^#tile=(.*)$/.exec(location.hash);
  if (!given) return -1;
  try {
    return DATA.ids.indexOf(decodeURIComponent(given[1]));
  } catch {
    return -1;
  }
}

function onThePage() {
  select.addEventListener("change", () => { scale = scaleOf(select.value); dimmed.clear(); recolour(); });
  find("show-relief").addEventListener("change", (event) => { map.showRelief = event.target.checked; map.draw(); });
  find("zoom-in").addEventListener("click", () => map.zoom(1.6));
  find("zoom-out").addEventListener("click", () => map.zoom(1 / 1.6));
  find("zoom-all").addEventListener("click", () => map.fit());
  for (const button of document.querySelectorAll("button[data-tile]")) {
    button.addEventListener("click", () => {
      selectTile(Number(button.dataset.tile), true);
      find("where").scrollIntoView();
    });
  }
  for (const button of document.querySelectorAll("button[data-copy]")) {
    button.addEventListener("click", () => navigator.clipboard?.writeText(button.dataset.copy));
  }
  for (const table of document.querySelectorAll("table")) makeSortable(table);
  const all = find("all-tiles");
  all.addEventListener("toggle", () => {
    if (all.open && !tileList) tileList = new TileList(find("tile-list"), (i) => { selectTile(i, true); find("where").scrollIntoView(); });
  });
  window.addEventListener("hashchange", () => { const i = tileOfHash(); if (i >= 0) selectTile(i, true); });
  darkMedia.addEventListener("change", recolour);
  // On paper nothing can be opened.
  let closed = [];
  window.addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details[data-print]:not([open])")];
    for (const one of closed) one.open = true;
    setPrinting(true);
    recolour();
    map.paint();
  });
  window.addEventListener("afterprint", () => {
    for (const one of closed) one.open = false;
    setPrinting(false);
    recolour();
  });
}

const relief = { image: null, ...DATA.relief };
let hintTimer = 0;
const map = new TileMap(find("map"), DATA, relief, {
  hover,
  select: selectTile,
  view: drawScaleBar,
  wheel: () => {
    hint.hidden = false;
    clearTimeout(hintTimer);
    hintTimer = setTimeout(() => { hint.hidden = true; }, 1600);
  },
});
fillSelect();
onThePage();
recolour();
const picture = find("relief");
if (picture) picture.decode().then(() => { relief.image = picture; map.draw(); }, () => {});
find("show-relief").closest("label").hidden = !picture;
selectTileAtStart();

function selectTileAtStart() {
  const i = tileOfHash();
  if (i >= 0) selectTile(i, true);
  else showDetails(-1);
}
