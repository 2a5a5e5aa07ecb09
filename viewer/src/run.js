// The index of a run: its tiles, by id and by place. Coordinates are eastings and northings (m).

export const PENDING = 0;
export const DONE = 1;
export const FAILED = 2;

/** Returns the run from the columns of run.js. */
export function runOf(data) {
  const { tiles: columns } = data;
  const tiles = columns.id.map((id, number) => ({
    number,
    id,
    file: columns.file[number],
    west: columns.west[number],
    south: columns.south[number],
    east: columns.west[number] + columns.width[number],
    north: columns.south[number] + columns.height[number],
    state: columns.state[number],
    stale: columns.stale[number],
    flags: columns.flags[number],
    places: columns.places[number],
    error: columns.error[number],
    measures: Object.fromEntries(Object.entries(columns.measures).map(([name, values]) => [name, values[number]])),
  }));
  return { ...data, tiles, byId: new Map(tiles.map((tile) => [tile.id, tile])), bounds: boundsOf(tiles) };
}

/** Returns west, south, east, north around tiles. */
export function boundsOf(tiles) {
  const bounds = { west: Infinity, south: Infinity, east: -Infinity, north: -Infinity };
  for (const tile of tiles) {
    bounds.west = Math.min(bounds.west, tile.west);
    bounds.south = Math.min(bounds.south, tile.south);
    bounds.east = Math.max(bounds.east, tile.east);
    bounds.north = Math.max(bounds.north, tile.north);
  }
  return bounds;
}

/** Whether a place lies on a tile. */
export function contains(tile, easting, northing) {
  return tile.west <= easting && easting <= tile.east && tile.south <= northing && northing <= tile.north;
}

/** Returns the tile under a place; null without a tile. Of two tiles, the tile with a surface. */
export function tileAt(run, easting, northing) {
  const under = run.tiles.filter((tile) => contains(tile, easting, northing));
  return under.find((tile) => tile.state === DONE) ?? under[0] ?? null;
}

/** Returns the distance of a place to a tile (m); 0 on the tile. */
export function distance(tile, easting, northing) {
  const x = Math.max(tile.west - easting, 0, easting - tile.east);
  const y = Math.max(tile.south - northing, 0, northing - tile.north);
  return Math.hypot(x, y);
}

/** Returns the tiles with a surface within a distance of a place, the nearest first. */
export function near(run, easting, northing, within, most) {
  return run.tiles
    .filter((tile) => tile.state === DONE)
    .map((tile) => [distance(tile, easting, northing), offCentre(tile, easting, northing), tile])
    .filter(([away]) => away <= within)
    .sort((a, b) => a[0] - b[0] || a[1] - b[1])
    .slice(0, most)
    .map(([, , tile]) => tile);
}

/** Returns the tiles to look at first: failed tiles, up to a half, then tiles with the largest error estimates. */
export function worst(run, most) {
  const estimate = (tile) => tile.measures.error_estimate_m ?? 0;
  const failed = run.tiles.filter((tile) => tile.state === FAILED);
  const others = run.tiles
    .filter((tile) => tile.state === DONE && (tile.flags.length || estimate(tile) > 0))
    .sort((a, b) => estimate(b) - estimate(a));
  const first = failed.slice(0, Math.max(most / 2, most - others.length));
  return [...first, ...others.slice(0, most - first.length)];
}

function offCentre(tile, easting, northing) {
  return Math.hypot((tile.west + tile.east) / 2 - easting, (tile.south + tile.north) / 2 - northing);
}
