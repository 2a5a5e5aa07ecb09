import assert from "node:assert/strict";
import { test } from "node:test";
import { FlatMap, beside } from "../src/flat_map.js";
import { ViewBox } from "../src/view_box.js";
import { lengthText, mix, roundLength } from "../src/scale.js";

const tile = (column, row) => ({ west: 10 * column, east: 10 * column + 10, south: 10 * row, north: 10 * row + 10 });

test("arrow keys lead to the next tile in a direction, and to the nearest one of a place", () => {
  const tiles = [tile(0, 0), tile(1, 0), tile(3, 0), tile(1, 1), tile(2, 2)];
  const [origin, east, far, north, diagonal] = tiles;
  assert.equal(beside(tiles, origin, [1, 0]), east);
  assert.equal(beside(tiles, east, [1, 0]), far);
  assert.equal(beside(tiles, east, [0, 1]), north);
  assert.equal(beside(tiles, origin, [-1, 0]), null);
  assert.equal(beside(tiles, null, [1, 0], [26, 27]), diagonal);
});

test("places of flags are chosen by pixels near them, on tiles that are large enough", () => {
  const [flagged, other] = [tile(0, 0), tile(1, 0)];
  flagged.places = { spike: [2, 5], patch: [2.5, 5] };
  const map = Object.assign(Object.create(FlatMap.prototype), { tiles: [flagged, other], box: new ViewBox() });
  Object.assign(map.box, { easting: 10, northing: 5, scale: 20, width: 400, height: 200 });
  assert.deepEqual([...map.placesInSight()].map(({ flag, pixel }) => [flag, pixel]), [["spike", [40, 100]], ["patch", [50, 100]]]);
  assert.deepEqual(map.placeAt(44, 102).place, [2, 5]);
  assert.equal(map.placeAt(48, 100).flag, "patch");
  assert.equal(map.placeAt(80, 100), null);
  map.box.scale = 5;
  assert.equal(map.placeAt(...map.box.toScreen(2, 5)), null);
});

test("scale bars have round lengths", () => {
  assert.deepEqual([130, 99, 20, 19.9, 0.3].map(roundLength), [100, 50, 20, 10, 0.2]);
  assert.deepEqual([500, 2000].map(lengthText), ["500 m", "2 km"]);
});

test("colours lie between their neighbours, and ends continue", () => {
  const stops = ["#000000", "#ff8000", "#ffffff"];
  assert.deepEqual([-1, 0.25, 0.5, 2].map((share) => mix(stops, share)), ["rgb(0,0,0)", "rgb(128,64,0)", "rgb(255,128,0)", "rgb(255,255,255)"]);
});
