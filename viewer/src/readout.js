// The card on the place under the cursor: coordinates, height, slopes, class, scan and terrain model.

import { el, fill } from "./dom.js";
import { nearestLine } from "./lines.js";
import { lonLat, metres, signed } from "./place.js";
import { along, climb, compass, fall, steepest } from "./slopes.js";
import { SUPPORT } from "./words.js";

const LINE_WITHIN_M = 12;

export class Readout {
  constructor(element, run, stage) {
    this.element = element;
    this.run = run;
    this.stage = stage;
  }

  /** Shows a place that `Stage.pick` found; null clears the card. */
  show(pick) {
    this.element.hidden = !pick;
    if (!pick) return;
    const { easting, northing, height, drawn, object } = pick;
    Object.assign(this.element.dataset, { easting, northing, height, drawn, kind: pick.kind, tile: object.tile.id });
    const [longitude, latitude] = lonLat(object.tile, object.data.corners, easting, northing);
    const cells = object.cellsAt(easting, northing);
    const levels = this.stage.levelsAt(easting, northing);
    // Cells describe the surface seen from above, and not levels below it.
    if (levels.length > 1 && pick.level < levels[0].level) Object.assign(cells, { support: 0, estimate: NaN });
    const rows = [
      ["Height", `${metres(height)} m`, "strong"],
      ...(levels.length > 1 ? levels.map((found) => [`Level ${found.level}`, `${metres(found.height)} m`]) : []),
      ["East, north", `${metres(easting, 2)}, ${metres(northing, 2)}`],
      ["Lat, lon", `${latitude.toFixed(6)}°, ${longitude.toFixed(6)}°`],
      ...this.slopes(pick),
      ["Surface", [pick.kind, SUPPORT[cells.support]].filter((text) => text && text !== "no data").join(", ")],
      compared("Scan (DSM)", cells.dsm - height),
      compared("Terrain model (DTM)", cells.dtm - height),
      Number.isNaN(cells.estimate) ? null : ["Error estimate", `${Math.round(100 * cells.estimate)} cm`],
    ];
    fill(
      this.element,
      rows.filter(Boolean).map(([name, text, kind]) => el("div", { class: kind ?? "" }, el("dt", {}, name), el("dd", {}, text))),
    );
  }

  slopes(pick) {
    const found = nearestLine(pick.object.data.lines, pick.easting, pick.northing, LINE_WITHIN_M);
    const direction = pick.direction ?? found?.direction;
    if (pick.kind === "road" && direction) {
      const { grade, crossfall } = along(pick, direction);
      // Without a direction of travel, up and down have no meaning.
      return [
        ["Grade along the road", climb(grade, pick.direction)],
        ["Crossfall", fall(crossfall, side(crossfall, direction, pick.direction))],
      ];
    }
    const { percent, towards } = steepest(pick);
    return [["Slope", fall(percent, towards)]];
  }
}

/** Returns the direction of the crossfall: to the left or right of a driver, else by the compass. */
function side(crossfall, [east, north], driven) {
  if (driven) return crossfall >= 0 ? "the right" : "the left";
  const sign = crossfall >= 0 ? 1 : -1;
  return compass(((Math.atan2(sign * north, sign * -east) * 180) / Math.PI + 360) % 360);
}

function compared(name, difference) {
  return Number.isNaN(difference) ? null : [name, `${signed(difference, 2)} m`];
}
