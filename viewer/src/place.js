// Coordinates as text, and longitudes and latitudes between the corners of a tile.

/** Returns longitude and latitude (degrees) of a place, bilinear between a tile's corners: SW, SE, NW, NE. */
export function lonLat(tile, corners, easting, northing) {
  const u = (easting - tile.west) / (tile.east - tile.west);
  const v = (northing - tile.south) / (tile.north - tile.south);
  return [0, 1].map(
    (i) =>
      (1 - v) * ((1 - u) * corners[0][i] + u * corners[1][i]) + v * ((1 - u) * corners[2][i] + u * corners[3][i]),
  );
}

/** Returns metres with a number of decimals and narrow spaces between thousands. */
export function metres(value, decimals = 3) {
  const [whole, rest] = value.toFixed(decimals).split(".");
  const grouped = whole.replace(/\B(?=(\d{3})+$)/g, "\u202f");
  return rest ? `${grouped}.${rest}` : grouped;
}

/** Returns a number with its sign. */
export function signed(value, decimals) {
  const text = Math.abs(value).toFixed(decimals);
  return Number(text) === 0 ? text : `${value < 0 ? "\u2212" : "+"}${text}`;
}

/** Returns a measure: lengths to the millimetre, others with three digits. */
export function short(value, unit = "") {
  if (unit === "m" && Math.abs(value) < 10) return value.toFixed(3);
  return value === 0 ? "0" : Math.abs(value) >= 1000 ? metres(value, 0) : String(Number(value.toPrecision(3)));
}
