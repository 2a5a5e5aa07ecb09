// Road lines: arrays of [easting, northing] (m).

/** Returns the length at each point of a line (m). */
export function lengths(points) {
  const along = [0];
  for (let i = 1; i < points.length; i++) {
    along.push(along[i - 1] + Math.hypot(points[i][0] - points[i - 1][0], points[i][1] - points[i - 1][1]));
  }
  return along;
}

/** Returns the place at a length of a line, and its direction there. */
export function placeAt(points, along, length) {
  const at = Math.min(Math.max(length, 0), along[along.length - 1]);
  let i = 1;
  while (i < points.length - 1 && along[i] < at) i++;
  const [a, b] = [points[i - 1], points[i]];
  const share = (at - along[i - 1]) / (along[i] - along[i - 1] || 1);
  const step = along[i] - along[i - 1] || 1;
  return {
    easting: a[0] + share * (b[0] - a[0]),
    northing: a[1] + share * (b[1] - a[1]),
    direction: [(b[0] - a[0]) / step, (b[1] - a[1]) / step],
  };
}

/** Returns the nearest line within a distance: the line, the length at its nearest point, and its direction. */
export function nearestLine(lines, easting, northing, within) {
  let best = null;
  for (const line of lines) {
    const { points } = line;
    for (let i = 1; i < points.length; i++) {
      const [a, b] = [points[i - 1], points[i]];
      const [x, y] = [b[0] - a[0], b[1] - a[1]];
      const length = Math.hypot(x, y);
      if (!length) continue;
      const share = Math.min(Math.max(((easting - a[0]) * x + (northing - a[1]) * y) / length ** 2, 0), 1);
      const away = Math.hypot(a[0] + share * x - easting, a[1] + share * y - northing);
      if (away <= (best?.away ?? within)) {
        best = { line, away, along: line.along[i - 1] + share * length, direction: [x / length, y / length] };
      }
    }
  }
  return best;
}

/** Returns the line that continues the end of another line, in the direction of travel; null without one. */
export function continuation(lines, from, end, direction, within = 1.0, maxTurn = 80) {
  let best = null;
  for (const line of lines) {
    if (line === from) continue;
    for (const points of [line.points, [...line.points].reverse()]) {
      const [first, second] = points;
      if (Math.hypot(first[0] - end[0], first[1] - end[1]) > within) continue;
      const step = Math.hypot(second[0] - first[0], second[1] - first[1]) || 1;
      const dot = ((second[0] - first[0]) * direction[0] + (second[1] - first[1]) * direction[1]) / step;
      const turn = (Math.acos(Math.min(Math.max(dot, -1), 1)) * 180) / Math.PI;
      if (turn <= (best?.turn ?? maxTurn)) best = { line, turn, points };
    }
  }
  return best;
}
