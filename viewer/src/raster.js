// Heights and classes of a tile in cells, row 0 in the north.

/** Returns a raster of quantised heights: 0 is no height, other values are low + (value - 1) * step (m). */
export function heights(grid, low, step, bytes) {
  const values = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2);
  return { grid, at: (index) => (values[index] ? low + (values[index] - 1) * step : NaN) };
}

/** Returns the value of the cell under a place, or of the nearest cell: thinned rasters may end before the tile. */
export function nearest(raster, easting, northing) {
  const { west, north, cell, rows, cols } = raster.grid;
  const col = Math.min(Math.max(Math.floor((easting - west) / cell), 0), cols - 1);
  const row = Math.min(Math.max(Math.floor((north - northing) / cell), 0), rows - 1);
  return raster.at(row * cols + col);
}

/** Returns the step of the cell under a place (m); 0 without a step, and where tiles meet. */
export function stepAt(steps, easting, northing) {
  const { west, north, cell, rows, cols } = steps.grid;
  const [x, y] = [(easting - west) / cell, (north - northing) / cell];
  const inside = x > 0 && x < cols && y > 0 && y < rows;
  return (inside && nearest(steps, easting, northing)) || 0;
}

/** Returns the height between cell centres, or of the nearest cell if one of the four has no height. */
export function bilinear(raster, easting, northing) {
  const { west, north, cell, rows, cols } = raster.grid;
  const x = Math.min(Math.max((easting - west) / cell - 0.5, 0), cols - 1);
  const y = Math.min(Math.max((north - northing) / cell - 0.5, 0), rows - 1);
  const [col, row] = [Math.min(Math.floor(x), Math.max(cols - 2, 0)), Math.min(Math.floor(y), Math.max(rows - 2, 0))];
  const [u, v] = [x - col, y - row];
  const [right, down] = [Math.min(col + 1, cols - 1), Math.min(row + 1, rows - 1)];
  const value =
    (1 - v) * ((1 - u) * raster.at(row * cols + col) + u * raster.at(row * cols + right)) +
    v * ((1 - u) * raster.at(down * cols + col) + u * raster.at(down * cols + right));
  return Number.isNaN(value) ? nearest(raster, easting, northing) : value;
}

/** Returns east and north of each cell's centre, by its index. */
export function centre(grid, index) {
  const row = Math.floor(index / grid.cols);
  return [grid.west + (index - row * grid.cols + 0.5) * grid.cell, grid.north - (row + 0.5) * grid.cell];
}
