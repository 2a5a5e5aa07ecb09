import assert from "node:assert/strict";
import { test } from "node:test";

import { format, parse } from "../src/permalink.js";

test("a state survives the address", () => {
  const state = { tile: "a b/<script>&=#ä", colour: "support", hide: "road", z: 2.5, camera: [1.5, 2, 3, 4, 5, 6] };
  assert.deepEqual(parse(format(state)), state);
});

test("a report links by the id alone", () => {
  assert.deepEqual(parse("#tile=295500_5629250"), { tile: "295500_5629250" });
});

test("damaged parts are left out", () => {
  assert.deepEqual(parse("#tile=x&camera=1,2,3&z=many&other=1&%&by=%E0%A4%A"), { tile: "x" });
  assert.deepEqual(parse(""), {});
});
