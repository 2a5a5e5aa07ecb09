// The settings beside map and scene, as elements; the functions that they call are passed in.

import { el } from "./dom.js";
import { ESTIMATE_COLOURS, ESTIMATE_MOST, SUPPORT_COLOURS } from "./material.js";
import { DONE, FAILED } from "./run.js";
import { OWN } from "./tile_object.js";
import { SUPPORT, flagText, stateText } from "./words.js";

/** Returns a section with a heading. */
export function section(title, ...content) {
  return el("section", {}, title ? el("h2", {}, title) : null, content);
}

/** Returns a select of choices with key and label. */
export function select(label, choices, key, change) {
  const options = choices.map((choice) => el("option", { value: choice.key, selected: choice.key === key }, choice.label));
  return el("select", { "aria-label": label, change: (event) => change(event.target.value) }, options);
}

/** Returns buttons of which one is pressed. */
export function buttons(choices, key, change) {
  const made = choices.map((choice) =>
    el(
      "button",
      {
        type: "button",
        "data-key": choice.key,
        "aria-pressed": String(choice.key === key),
        disabled: Boolean(choice.off),
        title: choice.off,
        click: () => change(choice.key),
      },
      choice.label,
    ),
  );
  return el("div", { class: "choices", role: "group" }, made);
}

/** Returns a check box. */
export function check(name, label, checked, change, off) {
  const box = el("input", {
    type: "checkbox",
    name,
    checked,
    disabled: Boolean(off),
    change: (event) => change(event.target.checked),
  });
  return el("label", { class: off ? "check off" : "check", title: off }, box, label);
}

/** Returns a slider with its value as text. */
export function slider(name, label, { min, max, step, value }, text, change) {
  const shown = el("output", {}, text(value));
  const input = el("input", {
    type: "range",
    name,
    min,
    max,
    step,
    value,
    "aria-label": label,
    input: (event) => {
      shown.textContent = text(Number(event.target.value));
      change(Number(event.target.value));
    },
  });
  return el("div", {}, el("div", { class: "split" }, el("span", {}, label), shown), input);
}

/** Returns entries of colour, label and number. */
export function legend(entries, ramp) {
  const bar = ramp && [
    el("div", { class: "ramp", style: `background: linear-gradient(to right, ${ramp.stops.join(", ")})` }),
    el("div", { class: "split quiet" }, el("span", {}, ramp.low), el("span", {}, ramp.high)),
  ];
  const rows = entries.map(({ colour, label, number }) =>
    el(
      "div",
      {},
      el("span", { class: "swatch", style: `background: ${colour}` }),
      el("span", {}, label),
      number === undefined ? null : el("span", { class: "number" }, String(number)),
    ),
  );
  return el("div", { class: "legend" }, bar, rows);
}

/** Returns the legend of the surface's colours. */
export function surfaceLegend(colour) {
  if (colour === "support") return legend([1, 2, 3].map((k) => ({ colour: SUPPORT_COLOURS[k], label: SUPPORT[k] })));
  if (colour === "estimate") {
    const ramp = { stops: ESTIMATE_COLOURS, low: "0 m", high: `${ESTIMATE_MOST} m and more` };
    // Else the colours beside the road seem to contradict the tile's figure.
    const note = "The figure of a tile is for its road. Where the data have no height, the estimate is 0.3 m or more.";
    return el("div", {}, legend([], ramp), el("p", { class: "quiet small" }, note));
  }
  if (colour === "photo") return null;
  return legend([
    { colour: OWN.road, label: "road" },
    { colour: OWN.terrain, label: "terrain" },
  ]);
}

/** Returns the id of a tile: struck through if its files are of an earlier result. */
export function tileId(tile) {
  return tile.stale ? el("s", {}, tile.id) : tile.id;
}

/** Returns a list of tiles as buttons: mark, id, value, and why a tile is listed; flags with a place open it there. */
export function tileList(tiles, { mark, value, open }) {
  const rows = tiles.map((tile) =>
    el(
      "li",
      {},
      el(
        "button",
        { type: "button", click: () => open(tile) },
        el("span", { class: "swatch", style: `background: ${mark(tile)}` }),
        el("span", { class: "id" }, tileId(tile)),
        el("span", { class: "value" }, value(tile) ?? ""),
        reason(tile, false) ? el("span", { class: "why" }, reason(tile, false)) : null,
      ),
      tile.state === DONE ? placed(tile).map((flag) => placeButton(tile, flag, (place) => open(tile, place))) : null,
    ),
  );
  return el("ol", { class: "list" }, rows);
}

/** Returns in one line why a tile needs a look, or an empty text; flags with a place may be left out. */
export function reason(tile, all = true) {
  if (tile.state === FAILED) return tile.error || "failed";
  return tile.flags.filter((flag) => all || !tile.places[flag]).map(flagText).join("; ");
}

function placed(tile) {
  return tile.flags.filter((flag) => tile.places[flag]);
}

/** Returns a button with a flag in words, which goes to its place. */
function placeButton(tile, flag, go) {
  const attributes = { type: "button", class: "place", "data-flag": flag, title: "Show the place" };
  return el("button", { ...attributes, click: () => go(tile.places[flag]) }, flagText(flag));
}

/** Returns id, state and problems of a tile; `go(place)` shows the place of a flag. */
export function tileHead(tile, go) {
  return [
    el("h3", {}, tileId(tile)),
    el("p", { class: "quiet" }, stateText(tile)),
    tile.state === FAILED ? el("p", { class: "error" }, tile.error || "The reason is in the run's failures.csv.") : null,
    tile.state === DONE && tile.flags.length
      ? el("ul", { class: "notes" }, tile.flags.map((flag) => el("li", {}, tile.places[flag] ? placeButton(tile, flag, go) : flagText(flag))))
      : null,
  ];
}

/** Returns the figures of a tile in an element that opens by a click; null without figures. */
export function tileFigures(tile, choices, open, toggle) {
  const figures = choices.filter((choice) => choice.text).map((choice) => [choice.label, choice.text(tile)]);
  const known = figures.filter(([, text]) => text !== null);
  if (!known.length) return null;
  const list = el("dl", { class: "facts" }, known.flatMap(([name, text]) => [el("dt", {}, name), el("dd", {}, text)]));
  return el("details", { open, toggle: (event) => toggle(event.target.open) }, el("summary", {}, "Figures of this tile"), list);
}
