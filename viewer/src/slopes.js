// Slopes of the surface in words that road engineers use. Derivatives are in m/m, results in percent.

/** Returns the steepest slope, and the compass direction in which it falls. */
export function steepest({ byEasting, byNorthing }) {
  const percent = 100 * Math.hypot(byEasting, byNorthing);
  const bearing = ((Math.atan2(-byEasting, -byNorthing) * 180) / Math.PI + 360) % 360;
  return { percent, towards: compass(bearing) };
}

/** Returns the grade along a direction, positive uphill, and the crossfall across it, positive if it falls to the right. */
export function along({ byEasting, byNorthing }, [east, north]) {
  return {
    grade: 100 * (byEasting * east + byNorthing * north),
    crossfall: -100 * (byEasting * north - byNorthing * east),
  };
}

/** Returns the size of a slope with the direction in which it falls, or "level" if it is shown as 0.0. */
export function fall(percent, towards) {
  const size = Math.abs(percent).toFixed(1);
  return `${size} %, ${Number(size) === 0 ? "level" : `falls to ${towards}`}`;
}

/** Returns the size of a grade, with up or down for a driver unless it is shown as 0.0. */
export function climb(percent, driven) {
  const size = Math.abs(percent).toFixed(1);
  const sense = Number(size) === 0 ? ", level" : percent < 0 ? " down" : " up";
  return `${size} %${driven ? sense : ""}`;
}

/** Returns the name of a bearing in degrees. */
export function compass(bearing) {
  return ["N", "NE", "E", "SE", "S", "SW", "W", "NW"][Math.round(bearing / 45) % 8];
}
