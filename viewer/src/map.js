// The overview: all tiles of a run as coloured squares with their pictures.

import { FlatMap, middle } from "./flat_map.js";
import { DONE, FAILED, tileAt } from "./run.js";
import { bytesOf } from "./unpack.js";

const LABEL_PX = 110;
const GAP_PX = 6;
const PICTURE_PX = 16;
const HATCH_PX = 24;
const SCALE_PX = 160;
const RINGS = { halo: "#ffffff", mark: "#b8352c" };
/** Room for the bar above and the scale below (pixels). */
const MARGINS = { top: 84, bottom: 48, sides: 24 };

export class OverviewMap extends FlatMap {
  /**
   * Draws into a canvas; `open(tile, place)` is called for a chosen tile, with a place if a flag was chosen;
   * `point(tile, x, y, flag)` for the tile and the flag's place under the pointer.
   */
  constructor(canvas, run, { open, point }) {
    const under = (x, y) => tileAt(run, ...this.box.toGround(x, y));
    super(canvas, run.tiles, run.bounds, {
      margins: () => MARGINS,
      point: (x, y) => {
        const found = x === null ? null : this.placeAt(x, y);
        point(x === null ? null : (found?.tile ?? under(x, y)), x, y, found?.flag);
      },
      choose: (x, y) => {
        const found = this.placeAt(x, y);
        const tile = found?.tile ?? under(x, y);
        if (tile) open(tile, found?.place);
      },
    });
    this.open = open;
    this.point = point;
    this.colour = () => "#888";
    this.pictures = {};
    this.images = new Map();
    this.start();
  }

  /** Colours the tiles by a choice of `map_colours`. */
  colourBy(colour) {
    this.colour = colour;
    this.draw();
  }

  /** Draws pictures of tiles, by id: WebP as base64. */
  show(pictures) {
    this.pictures = pictures;
    this.draw();
  }

  /** Returns the picture of a tile once it is decoded. */
  image(tile) {
    const text = this.pictures[tile.id];
    if (!text) return null;
    if (!this.images.has(tile)) {
      this.images.set(tile, null);
      createImageBitmap(new Blob([bytesOf(text)], { type: "image/webp" })).then((image) => {
        this.images.set(tile, image);
        this.draw();
      });
    }
    return this.images.get(tile);
  }

  paint() {
    const context = this.cleared();
    const { color, fontFamily } = getComputedStyle(this.canvas);
    for (const [tile, [left, top, across, down]] of this.inSight()) {
      const gap = across > GAP_PX ? 1 : 0;
      const [width, height] = [Math.max(across - gap, 0.7), Math.max(down - gap, 0.7)];
      context.globalAlpha = tile.state === DONE ? 1 : 0.85;
      context.fillStyle = this.colour(tile);
      context.fillRect(left, top, width, height);
      const image = width > PICTURE_PX ? this.image(tile) : null;
      if (image) {
        context.globalCompositeOperation = "multiply";
        context.drawImage(image, left, top, width, height);
        context.globalCompositeOperation = "source-over";
      }
      if (tile.state === FAILED && width > HATCH_PX) cross(context, left, top, width, height);
      if (width > LABEL_PX) label(context, tile, left, top, width);
    }
    context.globalAlpha = 1;
    this.paintPlaces(RINGS);
    if (this.selected) this.outline(this.selected, color);
    this.paintScale(Math.min(SCALE_PX, this.box.width / 3), [18, this.box.height - 18], color, `12px ${fontFamily}`);
  }

  outline(tile, colour) {
    const [left, top] = this.box.toScreen(tile.west, tile.north);
    const [right, bottom] = this.box.toScreen(tile.east, tile.south);
    this.context.lineWidth = 2.5;
    this.context.strokeStyle = colour;
    this.context.strokeRect(left - 1, top - 1, right - left + 1, bottom - top + 1);
  }

  chosen(tile) {
    this.select(tile);
    this.point(tile, ...this.box.toScreen(...middle(tile)));
  }

  /** Enter opens the selected tile; other keys work as on every map. */
  key(event) {
    if (event.key !== "Enter" || !this.selected) return super.key(event);
    this.open(this.selected);
    return true;
  }
}

function cross(context, left, top, width, height) {
  context.save();
  context.beginPath();
  context.rect(left, top, width, height);
  context.clip();
  context.strokeStyle = "rgba(255,255,255,0.35)";
  context.lineWidth = 2;
  context.beginPath();
  for (let x = left - height; x < left + width; x += 9) {
    context.moveTo(x, top + height);
    context.lineTo(x + height, top);
  }
  context.stroke();
  context.restore();
}

function label(context, tile, left, top, width) {
  context.font = "12px system-ui, sans-serif";
  // A canvas gives an opaque fill back as #rrggbb.
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(context.fillStyle.slice(at, at + 2), 16));
  context.fillStyle = 0.3 * red + 0.59 * green + 0.11 * blue > 150 ? "#14252e" : "#ffffff";
  context.fillText(tile.id, left + 8, top + 18, width - 16);
  if (tile.stale) context.fillRect(left + 8, top + 14, Math.min(context.measureText(tile.id).width, width - 16), 1);
}
