// Colours of the overview map: states, one flag, or one measure, with the legend.

import { DONE, FAILED } from "./run.js";
import { short } from "./place.js";
import { mix } from "./scale.js";
import { flagText, isFlagged } from "./words.js";

export const STATES = { done: "#3f8fb5", flagged: "#e3a02c", failed: "#b8352c", pending: "#9aa3aa" };
const PALE = "#b9c8d1";
const RAMP = ["#ecf0d6", "#a6d3b0", "#4ca4aa", "#306696", "#3a2466"];

/** Returns the choices of a run: key, label and a function that gives the colour of a tile; with a legend. */
export function choices(run) {
  const flags = [...new Set(run.tiles.flatMap((tile) => tile.flags))].sort();
  return [
    byState(run),
    ...Object.entries(run.measures).map(([name, measure]) => byMeasure(run, name, measure)),
    ...flags.map((flag) => byFlag(run, flag)),
  ].filter(Boolean);
}

function byState(run) {
  const kind = (tile) =>
    tile.state === FAILED ? "failed" : tile.state !== DONE ? "pending" : isFlagged(tile) ? "flagged" : "done";
  const labels = { done: "Done", flagged: "Done, look at it", failed: "Failed", pending: "Not computed" };
  const numbers = {};
  for (const tile of run.tiles) numbers[kind(tile)] = (numbers[kind(tile)] ?? 0) + 1;
  return {
    key: "state",
    label: "State",
    colour: (tile) => STATES[kind(tile)],
    legend: Object.keys(labels)
      .filter((name) => numbers[name])
      .map((name) => ({ colour: STATES[name], label: labels[name], number: numbers[name] })),
  };
}

function byFlag(run, flag) {
  const raised = run.tiles.filter((tile) => tile.flags.includes(flag)).length;
  return {
    key: `flag:${flag}`,
    label: `Flag: ${flagText(flag)}`,
    colour: (tile) => withState(tile, tile.flags.includes(flag) ? STATES.flagged : PALE),
    legend: [
      { colour: STATES.flagged, label: flagText(flag), number: raised },
      { colour: PALE, label: "without this flag", number: run.tiles.length - raised },
    ],
  };
}

function byMeasure(run, name, { title, unit }) {
  const values = run.tiles
    .map((tile) => tile.measures[name])
    .filter((value) => value != null)
    .sort((a, b) => a - b);
  if (!values.length) return null;
  // Outliers do not change the colours of other tiles.
  const [low, high] = [quantile(values, 0.02), quantile(values, 0.98)];
  const shade = (value) => ramp(high > low ? (value - low) / (high - low) : 0.5);
  const text = (value) => (unit === "%" ? `${short(100 * value)} %` : `${short(value, unit)}${unit ? ` ${unit}` : ""}`);
  return {
    key: name,
    label: title,
    text: (tile) => (tile.measures[name] == null ? null : text(tile.measures[name])),
    colour: (tile) => (tile.measures[name] == null ? withState(tile, PALE) : shade(tile.measures[name])),
    ramp: { low: text(low), high: text(high), stops: [0, 0.25, 0.5, 0.75, 1].map(ramp) },
    legend: values.length < run.tiles.length ? [{ colour: PALE, label: "no value" }] : [],
  };
}

function withState(tile, colour) {
  return tile.state === FAILED ? STATES.failed : tile.state === DONE ? colour : STATES.pending;
}

function quantile(sorted, share) {
  return sorted[Math.round(share * (sorted.length - 1))];
}

/** Returns the colour of a share from 0 to 1. */
export const ramp = (share) => mix(RAMP, share);
