import assert from "node:assert/strict";
import { test } from "node:test";

import { readGlb } from "../src/glb.js";

/** Returns a file of nodes that share one triangle. */
function glb(nodes) {
  const binary = Buffer.alloc(44);
  [0, 0, 0, 1, 0, 0, 0, 1, 0].forEach((value, i) => binary.writeFloatLE(value, 4 * i));
  [0, 1, 2].forEach((value, i) => binary.writeUInt16LE(value, 36 + 2 * i));
  const json = {
    scenes: [{ nodes: [0] }],
    nodes,
    meshes: [{ primitives: [{ attributes: { POSITION: 0, NORMAL: 0 }, indices: 1 }] }],
    accessors: [
      { bufferView: 0, componentType: 5126, count: 3, type: "VEC3" },
      { bufferView: 1, componentType: 5123, count: 3, type: "SCALAR" },
    ],
    bufferViews: [{ byteLength: 36 }, { byteOffset: 36, byteLength: 6 }],
  };
  const text = Buffer.from(JSON.stringify(json));
  const head = Buffer.alloc(12);
  head.write("glTF");
  return new Uint8Array(Buffer.concat([head, size(text), Buffer.from("JSON"), text, size(binary), Buffer.from("BIN\0"), binary]));
}

function size(chunk) {
  const bytes = Buffer.alloc(4);
  bytes.writeUInt32LE(chunk.length);
  return bytes;
}

test("parts of other levels are those below their node, and levels that share a name stay apart", () => {
  const { parts } = readGlb(
    glb([
      { name: "tile", children: [1, 2, 4], matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1] },
      { name: "road", mesh: 0 },
      { name: "level 1", children: [3] },
      { name: "road", mesh: 0 },
      { name: "level -1", children: [5] },
      { name: "road", mesh: 0 },
    ]),
  );
  const found = Object.fromEntries(Object.entries(parts).map(([name, part]) => [name, [part.kind, part.level]]));
  assert.deepEqual(found, { road: ["road", 0], "road, level 1": ["road", 1], "road, level -1": ["road", -1] });
  assert.deepEqual(parts["road, level 1"].translation, [5, 6, 7]);
  assert.deepEqual([...parts["road, level -1"].positions], [0, 0, 0, 1, 0, 0, 0, 1, 0]);
});
