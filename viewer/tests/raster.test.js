import assert from "node:assert/strict";
import { test } from "node:test";

import { bilinear, centre, heights, nearest, stepAt } from "../src/raster.js";

const GRID = { west: 100, north: 50, cell: 2, rows: 2, cols: 3 };
const bytes = (...codes) => new Uint8Array(new Uint16Array(codes).buffer);
// 10 to 15 m, row 0 in the north.
const RASTER = heights(GRID, 10, 0.5, bytes(1, 3, 5, 7, 9, 11));

test("cells have their heights, and places beyond the raster those of its edge", () => {
  assert.equal(nearest(RASTER, 100.1, 49.9), 10);
  assert.equal(nearest(RASTER, 105.9, 46.1), 15);
  assert.equal(nearest(RASTER, 99, 60), 10);
});

test("heights between centres are bilinear", () => {
  for (let index = 0; index < 6; index++) {
    const [easting, northing] = centre(GRID, index);
    assert.equal(bilinear(RASTER, easting, northing), 10 + index);
  }
  assert.equal(bilinear(RASTER, 102, 48), 12);
});

test("a cell without height has none, and is not mixed into its neighbours", () => {
  const holed = heights(GRID, 10, 0.5, bytes(0, 3, 5, 7, 9, 11));
  assert.ok(Number.isNaN(nearest(holed, 101, 49)));
  assert.equal(bilinear(holed, 102.2, 48.6), 11);
});

test("steps are those of the cell, and 0 without one and on the border of the tile", () => {
  const steps = heights(GRID, -0.25, 0.125, bytes(0, 1, 5, 3, 4, 0));
  assert.deepEqual(
    [[101, 49], [103, 49], [105, 49], [101, 47]].map(([x, y]) => stepAt(steps, x, y)),
    [0, -0.25, 0.25, 0],
  );
  assert.equal(stepAt(steps, 103, 50), 0);
  assert.equal(stepAt(steps, 106, 47), 0);
});
