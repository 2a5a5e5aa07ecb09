// A section between two places: the surface, the scan and the terrain model along it.

const MOST_STATIONS = 500;
const LEAST_STEP_M = 0.25;

/** Returns the stations between two places: distance, place, and heights (m), NaN where unknown. */
export function section(stage, from, to) {
  const [x, y] = [to.easting - from.easting, to.northing - from.northing];
  const length = Math.hypot(x, y);
  const steps = Math.max(2, Math.min(MOST_STATIONS, Math.ceil(length / LEAST_STEP_M)));
  return Array.from({ length: steps + 1 }, (_, i) => {
    const [easting, northing] = [from.easting + (x * i) / steps, from.northing + (y * i) / steps];
    const cells = stage.objectAt(easting, northing)?.cellsAt(easting, northing);
    return {
      distance: (length * i) / steps,
      easting,
      northing,
      surface: stage.heightAt(easting, northing) ?? NaN,
      dsm: cells?.dsm ?? NaN,
      dtm: cells?.dtm ?? NaN,
    };
  });
}

/** Returns the length, the rise and the mean grade (percent) between the first and last known heights. */
export function summary(stations) {
  const known = stations.filter(({ surface }) => !Number.isNaN(surface));
  if (known.length < 2) return null;
  const [first, last] = [known[0], known[known.length - 1]];
  const [length, rise] = [last.distance - first.distance, last.surface - first.surface];
  return { length: stations[stations.length - 1].distance, rise, grade: length ? (100 * rise) / length : 0 };
}

/** Returns stations as a table for spreadsheets. */
export function csv(stations) {
  const number = (value) => (Number.isNaN(value) ? "" : value.toFixed(3));
  const rows = stations.map((s) => [s.distance, s.easting, s.northing, s.surface, s.dsm, s.dtm].map(number).join(","));
  return ["distance_m,easting,northing,surface_m,dsm_m,dtm_m", ...rows, ""].join("\n");
}
