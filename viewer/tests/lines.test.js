import assert from "node:assert/strict";
import { test } from "node:test";

import { continuation, lengths, nearestLine, placeAt } from "../src/lines.js";

const line = (...points) => ({ points, along: lengths(points), name: "" });
const STREET = line([0, 0], [10, 0], [10, 10]);

test("a place at a length lies on the line", () => {
  assert.deepEqual(placeAt(STREET.points, STREET.along, 15), { easting: 10, northing: 5, direction: [0, 1] });
  assert.equal(placeAt(STREET.points, STREET.along, 99).northing, 10);
});

test("the nearest line is found within the distance alone", () => {
  const other = line([0, 5], [10, 5]);
  assert.equal(nearestLine([STREET, other], 5, 4, 3).line, other);
  assert.equal(nearestLine([STREET, other], 5, 40, 3), null);
});

test("the straightest line goes on, in either drawn direction, and none behind a sharp turn", () => {
  const [onward, aside] = [line([12, 20], [10.2, 10]), line([10, 10], [20, 12])];
  const found = continuation([STREET, aside, onward], STREET, [10, 10], [0, 1]);
  assert.equal(found.line, onward);
  assert.deepEqual(found.points[0], [10.2, 10]);
  assert.equal(continuation([STREET, line([10, 10], [10, 0])], STREET, [10, 10], [0, 1]), null);
});
