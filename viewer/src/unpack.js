// Bytes and numbers of the texts in a tile's script: base64 of zlib streams.

/** Returns the bytes of base64. */
export function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/** Returns the bytes that were compressed by zlib and encoded as base64. */
export async function inflated(base64) {
  const stream = new Blob([bytesOf(base64)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Returns the 64-bit numbers in bytes. */
export function doubles(bytes) {
  return new Float64Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 8);
}
