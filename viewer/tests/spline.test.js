import assert from "node:assert/strict";
import { test } from "node:test";

import { basis, spline } from "../src/spline.js";

const KNOTS = [-3, -2, -1, 0, 1, 2, 3, 4, 5, 6, 7];

/** Coefficients of a plane: control heights at the Greville abscissae. */
function plane(height) {
  const A = [];
  for (let row = 0; row < 7; row++) for (let col = 0; col < 7; col++) A.push(height(col - 1, row - 1));
  return A;
}

test("basis functions add up to one, and their slopes to zero", () => {
  for (const u of [0, 0.3, 1, 2.5, 4]) {
    const { values, slopes } = basis(KNOTS, 3, 7, u);
    assert.ok(Math.abs(values.reduce((a, b) => a + b) - 1) < 1e-12);
    assert.ok(Math.abs(slopes.reduce((a, b) => a + b)) < 1e-12);
  }
});

test("a spline with linear control heights is the plane, inside and beyond its domain", () => {
  const at = spline({
    degree: [3, 3],
    bounds: [1000, 2000, 1040, 2020],
    datum: 100,
    knotsU: KNOTS,
    knotsV: KNOTS,
    A: plane((u, v) => 2 * u - 3 * v),
    W: null,
  });
  for (const [easting, northing] of [[1000, 2000], [1013.7, 2009.1], [1040, 2020], [1050, 1990]]) {
    const found = at(easting, northing);
    // Four intervals are 40 m and 20 m wide.
    assert.ok(Math.abs(found.height - (100 + 0.2 * (easting - 1000) - 0.6 * (northing - 2000))) < 1e-9);
    assert.ok(Math.abs(found.byEasting - 0.2) < 1e-12);
    assert.ok(Math.abs(found.byNorthing + 0.6) < 1e-12);
  }
});

test("equal weights do not change heights, and slopes with weights are those of differences", () => {
  const surface = (W) =>
    spline({
      degree: [3, 3],
      bounds: [0, 0, 4, 4],
      datum: 0,
      knotsU: KNOTS,
      knotsV: KNOTS,
      A: plane((u, v) => Math.sin(u) + v * v).map((a, i) => a * (W ? W[i] : 1)),
      W,
    });
  const [bare, doubled] = [surface(null), surface(new Array(49).fill(2))];
  assert.ok(Math.abs(bare(1.3, 2.2).height - doubled(1.3, 2.2).height) < 1e-12);
  const weighted = surface(Array.from({ length: 49 }, (_, i) => 1 + (i % 3)));
  const [a, b] = [weighted(1.3 - 1e-5, 2.2), weighted(1.3 + 1e-5, 2.2)];
  assert.ok(Math.abs((b.height - a.height) / 2e-5 - weighted(1.3, 2.2).byEasting) < 1e-6);
});
