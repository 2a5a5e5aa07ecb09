// The part of the address after "#": which tile, from where, and how it is shown.
//
// `#tile=ID` alone opens a tile. Without it the map is shown.

const NUMBERS = { camera: 6, z: 1 };
const TEXTS = ["tile", "by", "colour", "hide", "show"];

/** Returns the state in a hash; missing or damaged parts are left out. */
export function parse(hash) {
  const state = {};
  for (const part of hash.replace(/^#/, "").split("&")) {
    const at = part.indexOf("=");
    if (at < 0) continue;
    const [name, text] = [part.slice(0, at), decoded(part.slice(at + 1))];
    if (text === null) continue;
    if (TEXTS.includes(name)) state[name] = text;
    const numbers = text.split(",").map(Number);
    if (numbers.length === NUMBERS[name] && numbers.every(Number.isFinite) && text !== "") {
      state[name] = numbers.length === 1 ? numbers[0] : numbers;
    }
  }
  return state;
}

/** Returns the hash of a state; `parse` returns the state, except for the rounding of the camera's place. */
export function format(state) {
  const parts = [];
  for (const name of [...TEXTS, ...Object.keys(NUMBERS)]) {
    const value = state[name];
    if (value == null || value === "") continue;
    const text = Array.isArray(value) ? value.map((number) => number.toFixed(1)).join(",") : String(value);
    parts.push(`${name}=${encodeURIComponent(text).replaceAll("%2C", ",")}`);
  }
  return parts.length ? `#${parts.join("&")}` : "";
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return null;
  }
}
