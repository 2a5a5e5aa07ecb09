// Reads the binary glTF that flexroad writes: meshes with positions, normals and texture coordinates, one image.

const MAGIC = 0x46546c67;
const JSON_CHUNK = 0x4e4f534a;
const BINARY_CHUNK = 0x004e4942;
const ARRAYS = { 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
const LEVEL = /^level (-?\d+)$/;
const WIDTHS = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };

/**
 * Returns the parts of a file, by the names of their node and level: kind, level, positions, normals, uvs, indices
 * and the translation from the scene's origin; with the image's bytes, null without an image.
 */
export function readGlb(bytes) {
  const { json, binary } = chunks(bytes);
  const parts = {};
  for (const root of json.scenes[json.scene ?? 0].nodes) walk(json, root, [0, 0, 0], 0, parts, binary);
  const image = json.images?.[0];
  return { parts, image: image ? view(json, binary, image.bufferView) : null, mime: image?.mimeType ?? "" };
}

function chunks(bytes) {
  const data = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.byteLength < 20 || data.getUint32(0, true) !== MAGIC) throw new Error("the mesh is no GLB");
  const found = {};
  for (let at = 12; at + 8 <= bytes.byteLength; ) {
    const length = data.getUint32(at, true);
    found[data.getUint32(at + 4, true)] = bytes.subarray(at + 8, at + 8 + length);
    at += 8 + length;
  }
  return { json: JSON.parse(new TextDecoder().decode(found[JSON_CHUNK])), binary: found[BINARY_CHUNK] };
}

function walk(json, index, above, levelAbove, parts, binary) {
  const node = json.nodes[index];
  const level = Number(node.name?.match(LEVEL)?.[1] ?? levelAbove);
  const own = node.matrix ? node.matrix.slice(12, 15) : (node.translation ?? [0, 0, 0]);
  const translation = above.map((value, axis) => value + own[axis]);
  if (node.mesh !== undefined) {
    const [primitive] = json.meshes[node.mesh].primitives;
    const { POSITION, NORMAL, TEXCOORD_0 } = primitive.attributes;
    parts[level ? `${node.name}, level ${level}` : node.name] = {
      kind: node.name,
      level,
      translation,
      positions: accessor(json, binary, POSITION),
      normals: accessor(json, binary, NORMAL),
      uvs: TEXCOORD_0 === undefined ? null : accessor(json, binary, TEXCOORD_0),
      indices: accessor(json, binary, primitive.indices),
    };
  }
  for (const child of node.children ?? []) walk(json, child, translation, level, parts, binary);
}

function accessor(json, binary, index) {
  const { bufferView, byteOffset = 0, componentType, count, type } = json.accessors[index];
  const Type = ARRAYS[componentType];
  const bytes = view(json, binary, bufferView).subarray(byteOffset);
  const length = count * WIDTHS[type];
  // A copy: it is aligned, and does not keep the whole file in memory.
  return new Type(bytes.slice(0, length * Type.BYTES_PER_ELEMENT).buffer);
}

function view(json, binary, index) {
  const { byteOffset = 0, byteLength } = json.bufferViews[index];
  return binary.subarray(byteOffset, byteOffset + byteLength);
}
