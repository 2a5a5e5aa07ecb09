// The map of the report: tiles in colours over relief, with marks of failed tiles and of suspect places.

import { FlatMap } from "../flat_map.js";
import { contains } from "../run.js";
import { STATE_KEYS, printing, themeColours } from "./colours.js";

const FIT_MARGIN = 0.06;
const DETAIL_PX = 26;
const SCALE_PX = 130;

export class TileMap extends FlatMap {
  /** Positions are relative to the south-west corner of the run (m). */
  constructor(canvas, data, relief, on) {
    const [west, south, east, north] = data.bounds;
    const tiles = data.boxes.flatMap((box, number) =>
      box ? [{ number, west: box[0], south: box[1], east: box[2], north: box[3], places: relative(data.places[number], west, south) }] : []);
    super(canvas, tiles, { west: 0, south: 0, east: east - west, north: north - south }, {
      margins: ({ width, height }) => ({ top: FIT_MARGIN * height, bottom: FIT_MARGIN * height, sides: FIT_MARGIN * width }),
      point: (x, y) => this.point(x, y),
      choose: (x, y) => on.select(this.numberAt(x, y)),
      // Without focus the wheel scrolls the page.
      wheel: (event) => {
        if (document.activeElement === canvas || event.ctrlKey) return true;
        on.wheel();
        return false;
      },
    });
    this.numbered = new Map(tiles.map((tile) => [tile.number, tile]));
    this.data = data;
    this.relief = relief;
    this.on = on;
    this.showRelief = true;
    this.colours = () => null;
    canvas.addEventListener("dblclick", (event) => this.zoom(2, event.offsetX, event.offsetY));
    canvas.addEventListener("keydown", (event) => { if (this.key(event)) event.preventDefault(); });
    this.start();
  }

  /** Marks the tile of a number; -1 and tiles without a place have no mark. */
  selectNumber(number) {
    this.select(this.numbered.get(number) ?? null);
  }

  /** Returns the number of the smallest tile under a pixel, -1 without one. */
  numberAt(x, y) {
    const place = this.box.toGround(x, y), area = (tile) => (tile.east - tile.west) * (tile.north - tile.south);
    const under = this.tiles.filter((tile) => contains(tile, ...place));
    return under.length ? under.reduce((best, tile) => (area(tile) < area(best) ? tile : best)).number : -1;
  }

  point(x, y) {
    const over = x === null ? -1 : this.numberAt(x, y);
    this.canvas.style.cursor = over >= 0 ? "pointer" : "grab";
    this.on.hover(over, x, y);
  }

  move(x, y) {
    this.canvas.style.cursor = "grabbing";
    super.move(x, y);
  }

  chosen(tile) {
    this.on.select(tile.number, true);
  }

  key(event) {
    if (event.key !== "Escape") return super.key(event);
    this.on.select(-1);
    return true;
  }

  paint() {
    const c = this.cleared(), theme = themeColours();
    c.fillStyle = theme.ground;
    c.fillRect(0, 0, this.box.width, this.box.height);
    const visible = [...this.inSight()].map(([{ number }, rect]) => [number, wholePixels(rect)]);
    if (this.showRelief && this.relief.image) this.paintRelief(visible, theme);
    for (const [i, rect] of visible) this.paintTile(i, rect, theme);
    c.globalCompositeOperation = "source-over";
    for (const [i, rect] of visible) this.paintMarks(i, rect, theme);
    this.paintPlaces(theme);
    for (const [tile, rect] of this.inSight()) if (tile === this.selected) this.twice(theme, [6, 3], () => c.strokeRect(...wholePixels(rect)));
    // On paper the map, with its scale bar, has another size than in the window.
    if (printing) this.paintScale(SCALE_PX, [14, this.box.height - 14], theme.mark, "14px sans-serif");
    // While all of the run is visible, a finger scrolls the page.
    this.canvas.style.touchAction = this.isFitted() ? "pan-y" : "none";
    const [metres, text] = this.scaleBar(SCALE_PX);
    this.on.view(metres * this.box.scale, text);
  }

  paintRelief(visible, theme) {
    const c = this.context, { image, side, columns, places } = this.relief;
    c.imageSmoothingEnabled = true;
    c.imageSmoothingQuality = "medium";
    for (const [i, [x, y, w, h]] of visible) {
      const n = places[i];
      if (n === undefined || n === null) continue;
      // Shows where a tile reaches beyond the survey.
      c.fillStyle = theme.beyond;
      c.fillRect(x, y, w, h);
      c.drawImage(image, (n % columns) * side, Math.floor(n / columns) * side, side, side, x, y, w, h);
    }
  }

  paintTile(i, [x, y, w, h], theme) {
    const c = this.context, colour = this.colours(i);
    const below = this.showRelief && this.relief.image && this.relief.places[i] != null;
    c.globalCompositeOperation = colour && below ? "multiply" : "source-over";
    c.fillStyle = colour || theme.none;
    c.globalAlpha = colour || !below ? 1 : theme.dark ? 0.7 : 0.5;
    c.fillRect(x, y, w, h);
    c.globalAlpha = 1;
  }

  paintMarks(i, [x, y, w, h], theme) {
    const c = this.context, state = STATE_KEYS[this.data.states[i]];
    if (w > 5) {
      c.strokeStyle = theme.edge;
      c.lineWidth = w > DETAIL_PX ? 1 : 0.5;
      c.strokeRect(x + 0.5, y + 0.5, w, h);
    }
    if (w >= 8 && (state === "failed" || state === "pending")) {
      const inset = w * 0.3;
      c.strokeStyle = theme.mark;
      c.lineWidth = Math.min(3, Math.max(1, w / 22));
      c.beginPath();
      c.moveTo(x + inset, y + inset);
      c.lineTo(x + w - inset, y + h - inset);
      if (state === "failed") {
        c.moveTo(x + w - inset, y + inset);
        c.lineTo(x + inset, y + h - inset);
      }
      c.stroke();
    }
  }
}

function relative(places = {}, west, south) {
  return Object.fromEntries(Object.entries(places).map(([flag, [east, north]]) => [flag, [east - west, north - south]]));
}

// So that neighbours have no line between them.
function wholePixels([x, y, w, h]) {
  const left = Math.round(x), top = Math.round(y);
  return [left, top, Math.max(1, Math.round(x + w) - left), Math.max(1, Math.round(y + h) - top)];
}
