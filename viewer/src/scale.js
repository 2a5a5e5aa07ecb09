// Colours between others, and round lengths for scale bars.

/** Returns the colour of a share from 0 to 1 on a row of colours, #rrggbb. */
export function mix(stops, share) {
  const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const i = Math.min(Math.floor(at), stops.length - 2);
  const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
  const [a, b] = [rgb(stops[i]), rgb(stops[i + 1])];
  return `rgb(${a.map((v, k) => Math.round(v + (b[k] - v) * (at - i))).join(",")})`;
}

/** Returns the longest round length (m) up to a given one. */
export function roundLength(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return [5, 2, 1].map((digit) => digit * power).find((metres) => metres <= most) ?? power;
}

export const lengthText = (metres) => (metres >= 1000 ? `${metres / 1000} km` : `${metres} m`);
