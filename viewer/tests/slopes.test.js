import assert from "node:assert/strict";
import { test } from "node:test";

import { lonLat, metres, signed } from "../src/place.js";
import { along, climb, fall, steepest } from "../src/slopes.js";

test("a surface that rises to the east falls to the west", () => {
  const found = steepest({ byEasting: 0.05, byNorthing: 0 });
  assert.equal(found.towards, "W");
  assert.ok(Math.abs(found.percent - 5) < 1e-12);
});

test("driving north on it, it is level and falls to the left; driving east, it climbs", () => {
  const slope = { byEasting: 0.05, byNorthing: 0 };
  assert.equal(along(slope, [0, 1]).grade, 0);
  assert.equal(along(slope, [0, 1]).crossfall, -5);
  assert.equal(along(slope, [1, 0]).grade, 5);
});

test("slopes that are 0.0 as shown are level, and fall or climb nowhere", () => {
  assert.deepEqual([0, -0.049, 0.05, -2.5].map((percent) => fall(percent, "the left")), [
    "0.0 %, level",
    "0.0 %, level",
    "0.1 %, falls to the left",
    "2.5 %, falls to the left",
  ]);
  assert.deepEqual([-0.02, -3, 3].map((percent) => climb(percent, true)), ["0.0 %, level", "3.0 % down", "3.0 % up"]);
  assert.equal(climb(-3, false), "3.0 %");
});

test("longitude and latitude are those of the corners at the corners", () => {
  const tile = { west: 0, south: 0, east: 100, north: 100 };
  const corners = [[8, 50], [8.1, 50.01], [7.99, 50.1], [8.09, 50.11]];
  assert.deepEqual(lonLat(tile, corners, 100, 0), corners[1]);
  assert.deepEqual(lonLat(tile, corners, 0, 100), corners[2]);
});

test("numbers read as people write them", () => {
  assert.equal(metres(5600123.4567), "5\u202f600\u202f123.457");
  assert.equal(signed(-0.031, 2), "\u22120.03");
  assert.equal(signed(-0.001, 2), "0.00");
});
