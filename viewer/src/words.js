// Meanings of the names in a run's tables, in plain words.

export const SUPPORT = ["no data", "measured", "terrain model", "inferred"];

export const SUPPORT_MEANING = {
  measured: "The scan shows the ground here.",
  "terrain model": "Something hides the ground; the height is from the terrain model.",
  inferred: "No height is known here; the surface continues from the sides.",
};

const FLAGS = {
  "error-estimate": "the surface is far from scan and terrain model on average",
  "worst-error": "25 m² of road in one piece are far off",
  patch: "a patch of road is far from scan and terrain model",
  spike: "the surface bends more than a road can",
  "edge-step": "steps along the edges of the road",
  loose: "road points lie far from the surface",
  "off-dtm": "much of the road is off the terrain model",
  inferred: "much of the road has no height in the data",
  dropped: "most of the road mask was dropped by the filter",
  weights: "many weights of the surface are at their limit",
  "no-road": "no road on this tile",
  below: "a deck lies partly below the ground, or a tunnel above it",
  "no-rise": "a deck is hardly higher than the ground",
  "no-abutment": "no road on the ground continues a deck",
};

const STATES = ["not computed", "done", "failed"];

/** Returns the meaning of a flag; the flag itself if it is unknown. */
export function flagText(flag) {
  return FLAGS[flag] ?? flag;
}

/** Returns the state of a tile in words. */
export function stateText(tile) {
  if (tile.stale) return `${STATES[tile.state]}; its files are from an earlier result`;
  return tile.state === 1 && isFlagged(tile) ? "done, look at it" : STATES[tile.state];
}

/** Whether a finished tile has a flag that needs a look: a tile without road is no problem. */
export function isFlagged(tile) {
  return tile.flags.some((flag) => flag !== "no-road");
}

/** Returns a number with its noun. */
export function count(number, noun) {
  return `${number.toLocaleString("en").replaceAll(",", "\u202f")} ${noun}${number === 1 ? "" : "s"}`;
}
