// The overview: all tiles of a run as coloured squares on a canvas.

import { gestures } from "./gestures.js";
import { DONE, FAILED, boundsOf, tileAt } from "./run.js";
import { bytesOf } from "./unpack.js";
import { ViewBox } from "./view_box.js";

const LABEL_PX = 110;
const GAP_PX = 6;
const PICTURE_PX = 16;
const HATCH_PX = 24;
/** Room for the bar above and the scale below (pixels). */
const MARGINS = { top: 84, bottom: 48, sides: 24 };

export class OverviewMap {
  /** Draws into a canvas; `open(tile)` is called for a chosen tile, `point(tile, x, y)` for the one under the pointer. */
  constructor(canvas, run, { open, point }) {
    this.canvas = canvas;
    this.run = run;
    this.box = new ViewBox();
    this.colour = () => "#888";
    this.selected = null;
    this.fitted = false;
    this.pictures = {};
    this.images = new Map();
    gestures(canvas, {
      move: (x, y) => this.changed(() => this.box.move(x, y)),
      zoom: (factor, x, y) => this.changed(() => this.box.zoom(factor, x, y)),
      point: (x, y) => point(x === null ? null : this.under(x, y), x, y),
      choose: (x, y) => {
        const tile = this.under(x, y);
        if (tile) open(tile);
      },
    });
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  /** Colours the tiles by a choice of `map_colours`. */
  paint(colour) {
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

  /** Marks a tile and moves the map if it lies outside. */
  select(tile) {
    this.selected = tile;
    const [x, y] = this.box.toScreen((tile.west + tile.east) / 2, (tile.south + tile.north) / 2);
    if (x < 0 || y < 0 || x > this.box.width || y > this.box.height) {
      this.box.easting = (tile.west + tile.east) / 2;
      this.box.northing = (tile.south + tile.north) / 2;
    }
    this.draw();
  }

  under(x, y) {
    return tileAt(this.run, ...this.box.toGround(x, y));
  }

  changed(change) {
    change();
    this.draw();
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(clientWidth * ratio);
    this.canvas.height = Math.round(clientHeight * ratio);
    this.box.width = clientWidth;
    this.box.height = clientHeight;
    if (!this.fitted) this.box.fit(this.run.bounds, MARGINS);
    this.fitted = true;
    this.draw();
  }

  /** Shows all tiles. */
  fit() {
    this.changed(() => this.box.fit(this.run.bounds, MARGINS));
  }

  draw() {
    cancelAnimationFrame(this.pending);
    this.pending = requestAnimationFrame(() => this.paintTiles());
  }

  paintTiles() {
    const ratio = window.devicePixelRatio || 1;
    const context = this.canvas.getContext("2d");
    const style = getComputedStyle(this.canvas);
    const text = style.color;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.box.width, this.box.height);
    for (const tile of this.run.tiles) {
      const [left, top] = this.box.toScreen(tile.west, tile.north);
      const [right, bottom] = this.box.toScreen(tile.east, tile.south);
      if (right < 0 || bottom < 0 || left > this.box.width || top > this.box.height) continue;
      const gap = right - left > GAP_PX ? 1 : 0;
      const [width, height] = [Math.max(right - left - gap, 0.7), Math.max(bottom - top - gap, 0.7)];
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
    if (this.selected) this.outline(context, this.selected, text);
    scaleBar(context, this.box, text, style.fontFamily);
  }

  outline(context, tile, colour) {
    const [left, top] = this.box.toScreen(tile.west, tile.north);
    const [right, bottom] = this.box.toScreen(tile.east, tile.south);
    context.lineWidth = 2.5;
    context.strokeStyle = colour;
    context.strokeRect(left - 1, top - 1, right - left + 1, bottom - top + 1);
  }

  /** Arrows go from tile to tile, Enter opens; plus and minus zoom. */
  key(event, open, point) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = steps[event.key];
    const zooms = { "+": 1.4, "=": 1.4, "-": 1 / 1.4 };
    if (step) {
      const next = this.selected ? beside(this.run, this.selected, step) : middle(this.run);
      if (next) {
        this.select(next);
        const [x, y] = this.box.toScreen((next.west + next.east) / 2, (next.south + next.north) / 2);
        point(next, x, y);
      }
    } else if (event.key === "Enter" && this.selected) open(this.selected);
    else if (zooms[event.key]) this.changed(() => this.box.zoom(zooms[event.key], this.box.width / 2, this.box.height / 2));
    else if (event.key === "0") this.fit();
    else return false;
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

function scaleBar(context, box, colour, font) {
  const goal = Math.min(160, box.width / 3) / box.scale;
  const power = 10 ** Math.floor(Math.log10(goal));
  const length = [5, 2, 1].map((digit) => digit * power).find((metres) => metres <= goal) ?? power;
  const [x, y] = [18, box.height - 18];
  context.strokeStyle = colour;
  context.fillStyle = colour;
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(x, y - 5);
  context.lineTo(x, y);
  context.lineTo(x + length * box.scale, y);
  context.lineTo(x + length * box.scale, y - 5);
  context.stroke();
  context.font = `12px ${font}`;
  context.fillText(length >= 1000 ? `${length / 1000} km` : `${length} m`, x + 6, y - 6);
}

function middle(run) {
  const { west, south, east, north } = boundsOf(run.tiles);
  return nearestTo(run.tiles, (west + east) / 2, (south + north) / 2);
}

function beside(run, tile, [x, y]) {
  const [width, height] = [tile.east - tile.west, tile.north - tile.south];
  const [easting, northing] = [(tile.west + tile.east) / 2, (tile.south + tile.north) / 2];
  const ahead = run.tiles.filter((other) => {
    const [dx, dy] = [(other.west + other.east) / 2 - easting, (other.south + other.north) / 2 - northing];
    return x ? dx * x > width / 2 && Math.abs(dy) <= Math.abs(dx) : dy * y > height / 2 && Math.abs(dx) <= Math.abs(dy);
  });
  return nearestTo(ahead, easting, northing);
}

function nearestTo(tiles, easting, northing) {
  const away = (tile) => Math.hypot((tile.west + tile.east) / 2 - easting, (tile.south + tile.north) / 2 - northing);
  return tiles.reduce((best, tile) => (best && away(best) <= away(tile) ? best : tile), null);
}
