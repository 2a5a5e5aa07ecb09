// The fitted surface itself: a NURBS height field, as in flexroad's `NurbsSurface`.

/** Returns the surface from its knots and coefficients; row 0 of `A` and `W` is in the south. */
export function spline({ degree, bounds, datum, knotsU, knotsV, A, W }) {
  const [west, south, east, north] = bounds;
  const [u, v] = [axis(knotsU, degree[0], west, east), axis(knotsV, degree[1], south, north)];

  /** Returns height (m) and its derivatives by easting and northing; beyond the domain, extrapolated linearly. */
  return function at(easting, northing) {
    const [along, across] = [u(easting), v(northing)];
    let [a, w, aU, wU, aV, wV] = [0, 0, 0, 0, 0, 0];
    for (let i = 0; i < across.values.length; i++) {
      const row = (across.start + i) * u.points;
      for (let j = 0; j < along.values.length; j++) {
        const [height, weight] = [A[row + along.start + j], W ? W[row + along.start + j] : 1];
        const [value, byU, byV] = [
          across.values[i] * along.values[j],
          across.values[i] * along.slopes[j],
          across.slopes[i] * along.values[j],
        ];
        a += value * height;
        w += value * weight;
        aU += byU * height;
        wU += byU * weight;
        aV += byV * height;
        wV += byV * weight;
      }
    }
    const byEasting = (aU - (a / w) * wU) / w;
    const byNorthing = (aV - (a / w) * wV) / w;
    const height = datum + a / w + byEasting * along.beyond + byNorthing * across.beyond;
    return { height, byEasting, byNorthing };
  };
}

/** Returns the basis along one axis as a function of the coordinate (m). */
function axis(knots, degree, low, high) {
  const points = knots.length - degree - 1;
  const [first, last] = [knots[degree], knots[points]];
  const scale = (last - first) / (high - low);
  const of = (place) => {
    const inside = Math.min(Math.max(place, low), high);
    const found = basis(knots, degree, points, first + (inside - low) * scale);
    return { ...found, slopes: found.slopes.map((slope) => slope * scale), beyond: place - inside };
  };
  of.points = points;
  return of;
}

/** Returns the basis functions that are not zero at a parameter, their slopes, and the index of the first. */
export function basis(knots, degree, points, parameter) {
  let span = degree;
  while (span < points - 1 && knots[span + 1] <= parameter) span++;
  let values = [1];
  let slopes = [0];
  for (let k = 1; k <= degree; k++) {
    const next = new Array(k + 1).fill(0);
    slopes = new Array(k + 1).fill(0);
    for (let i = 0; i < k; i++) {
      const [left, right] = [knots[span + 1 - k + i], knots[span + 1 + i]];
      const share = values[i] / (right - left);
      next[i] += (right - parameter) * share;
      next[i + 1] += (parameter - left) * share;
      slopes[i] -= k * share;
      slopes[i + 1] += k * share;
    }
    values = next;
  }
  return { start: span - degree, values, slopes };
}
