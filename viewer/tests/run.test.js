import assert from "node:assert/strict";
import { test } from "node:test";

import { choices } from "../src/map_colours.js";
import { near, runOf, tileAt, worst } from "../src/run.js";
import { ViewBox } from "../src/view_box.js";
import { stateText } from "../src/words.js";

/** A run of three tiles of 100 m side by side: done, failed, done with a flag. */
function run() {
  return runOf({
    name: "x",
    measures: { error_estimate_m: { title: "Error estimate", unit: "m" } },
    tiles: {
      id: ["a", "b", "c"],
      file: ["a", "b", "c"],
      west: [0, 100, 200],
      south: [0, 0, 0],
      width: [100, 100, 100],
      height: [100, 100, 100],
      state: [1, 2, 1],
      stale: [false, true, false],
      flags: [[], [], ["spike"]],
      places: [{}, {}, { spike: [250.5, 49.5] }],
      error: ["", "load: broken", ""],
      measures: { error_estimate_m: [0.02, null, 0.05] },
    },
  });
}

test("a place on the border of two tiles is on the one with a surface", () => {
  assert.equal(tileAt(run(), 100, 50).id, "a");
  assert.equal(tileAt(run(), 150, 50).id, "b");
  assert.equal(tileAt(run(), 50, 500), null);
});

test("near tiles are finished ones, the nearest first", () => {
  assert.deepEqual(near(run(), 190, 50, 95, 9).map(({ id }) => id), ["c", "a"]);
  assert.deepEqual(near(run(), 190, 50, 80, 9).map(({ id }) => id), ["c"]);
});

test("failed tiles need a look first, then large error estimates", () => {
  assert.deepEqual(worst(run(), 2).map(({ id }) => id), ["b", "c"]);
});

test("files of an earlier result are told", () => {
  const [done, failed] = run().tiles;
  assert.equal(stateText(done), "done");
  assert.equal(stateText(failed), "failed; its files are from an earlier result");
});

test("each choice colours all tiles, and tiles without a value differ from the others", () => {
  const made = choices(run());
  assert.deepEqual(made.map(({ key }) => key), ["state", "error_estimate_m", "flag:spike"]);
  for (const { colour } of made) assert.equal(new Set(run().tiles.map(colour)).size, 3);
});

test("zooming keeps the place under the pointer, and fitted bounds are inside", () => {
  const box = new ViewBox();
  Object.assign(box, { width: 800, height: 600 });
  box.fit(run().bounds, { top: 80, bottom: 20, sides: 10 });
  const [x, y] = box.toScreen(0, 100);
  assert.ok(x >= 10 && y >= 80);
  const before = box.toGround(120, 300);
  box.zoom(3, 120, 300);
  const after = box.toGround(120, 300);
  assert.ok(Math.hypot(after[0] - before[0], after[1] - before[1]) < 1e-9);
});
