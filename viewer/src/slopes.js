// Slopes of the surface in words that road engineers use. Derivatives are in m/m, results in percent.

/** Returns the steepest slope, and the compass direction that it falls to. */
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

/** Returns the name of a bearing in degrees. */
export function compass(bearing) {
  return ["N", "NE", "E", "SE", "S", "SW", "W", "NW"][Math.round(bearing / 45) % 8];
}
