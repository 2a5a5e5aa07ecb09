// The map of tiles on a canvas, for the viewer and the report: view, mouse, fingers and keys.

import { gestures } from "./gestures.js";
import { lengthText, roundLength } from "./scale.js";
import { ViewBox } from "./view_box.js";

const MOST_PIXELS_PER_METRE = 40;
/** Smallest scale, relative to the scale that shows all tiles. */
const LEAST = 0.5;
const ZOOM = 1.5;
const PAN_PX = 60;
/** A selected tile is at least this far from the edge. A tile smaller than DOT_PX is zoomed to SEEN_PX. */
const EDGE_PX = 12;
const DOT_PX = 14;
const SEEN_PX = 60;
/** Places of flags are rings on tiles of at least this width. A click up to a little outside of a ring chooses it. */
const PLACES_PX = 52;
const RING_PX = 7;
const NEAR_PX = 4;
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** Subclasses have `paint()`, and `chosen(tile)`, which is called for a tile selected by an arrow key. */
export class FlatMap {
  /**
   * Tiles and bounds have west, south, east and north (m). `margins(box)` is the room around all tiles;
   * `point(x, y)`, `choose(x, y)` and `wheel(event)` are passed to `gestures`; outside, `point` gets null.
   */
  constructor(canvas, tiles, bounds, { margins, point, choose, wheel }) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.tiles = tiles;
    this.bounds = bounds;
    this.margins = margins;
    this.box = new ViewBox();
    this.selected = null;
    this.fittedScale = null;
    gestures(canvas, {
      move: (x, y) => this.move(x, y),
      zoom: (factor, x, y) => this.zoom(factor, x, y),
      point,
      choose,
      wheel,
    });
  }

  /** Starts to draw, also after changes of the canvas's size. */
  start() {
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.resize();
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    const fitted = this.fittedScale === null || this.isFitted();
    this.ratio = Math.max(1, window.devicePixelRatio || 1);
    this.canvas.width = Math.round(clientWidth * this.ratio);
    this.canvas.height = Math.round(clientHeight * this.ratio);
    this.box.width = clientWidth;
    this.box.height = clientHeight;
    if (fitted) this.fit();
    else this.draw();
  }

  /** Shows all tiles. */
  fit() {
    this.box.fit(this.bounds, this.margins(this.box));
    this.fittedScale = this.box.scale;
    this.draw();
  }

  isFitted() {
    return Math.abs(this.box.scale / this.fittedScale - 1) < 1e-6;
  }

  zoom(factor, x = this.box.width / 2, y = this.box.height / 2) {
    const scale = Math.min(Math.max(this.box.scale * factor, LEAST * this.fittedScale), MOST_PIXELS_PER_METRE);
    this.box.zoom(scale / this.box.scale, x, y);
    this.draw();
  }

  move(x, y) {
    const { west, south, east, north } = this.bounds;
    this.box.move(x, y);
    this.box.easting = Math.min(Math.max(this.box.easting, west), east);
    this.box.northing = Math.min(Math.max(this.box.northing, south), north);
    this.draw();
  }

  /** Marks a tile, null for none, and shows it. */
  select(tile) {
    this.selected = tile;
    if (tile) this.reveal(tile);
    this.draw();
  }

  reveal(tile) {
    const [left, top] = this.box.toScreen(tile.west, tile.north);
    const [right, bottom] = this.box.toScreen(tile.east, tile.south);
    const outside =
      left < EDGE_PX || top < EDGE_PX || right > this.box.width - EDGE_PX || bottom > this.box.height - EDGE_PX;
    const dot = right - left < DOT_PX;
    if (outside || dot) [this.box.easting, this.box.northing] = middle(tile);
    if (dot) this.box.scale = SEEN_PX / (tile.east - tile.west);
  }

  draw() {
    cancelAnimationFrame(this.pending);
    this.pending = requestAnimationFrame(() => this.paint());
  }

  /** Clears the canvas; returns its context, in pixels of the page. */
  cleared() {
    this.context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    this.context.globalCompositeOperation = "source-over";
    this.context.clearRect(0, 0, this.box.width, this.box.height);
    return this.context;
  }

  /** Yields the tiles in sight, each with left, top, width and height in pixels. */
  *inSight() {
    for (const tile of this.tiles) {
      const [left, top] = this.box.toScreen(tile.west, tile.north);
      const [right, bottom] = this.box.toScreen(tile.east, tile.south);
      if (right < 0 || bottom < 0 || left > this.box.width || top > this.box.height) continue;
      yield [tile, [left, top, right - left, bottom - top]];
    }
  }

  /** Yields the places of flags in sight, each with its tile, flag and pixel. */
  *placesInSight() {
    for (const [tile, [, , width]] of this.inSight()) {
      if (width < PLACES_PX) continue;
      for (const [flag, place] of Object.entries(tile.places ?? {})) {
        yield { tile, flag, place, pixel: this.box.toScreen(...place) };
      }
    }
  }

  /** Returns the place of a flag under a pixel; null without one. */
  placeAt(x, y) {
    let [best, least] = [null, RING_PX + NEAR_PX];
    for (const found of this.placesInSight()) {
      const away = Math.hypot(found.pixel[0] - x, found.pixel[1] - y);
      if (away < least) [best, least] = [found, away];
    }
    return best;
  }

  /** Draws rings around the places of flags. */
  paintPlaces(colours) {
    for (const { pixel } of this.placesInSight()) {
      this.twice(colours, [4.5, 2], (context) => {
        context.beginPath();
        context.arc(...pixel, RING_PX, 0, 2 * Math.PI);
        context.stroke();
      });
    }
  }

  /** Strokes a wide line around a thin line, so that it is visible on every colour. */
  twice({ halo, mark }, [wide, thin], stroke) {
    for (const [colour, line] of [[halo, wide], [mark, thin]]) {
      this.context.strokeStyle = colour;
      this.context.lineWidth = line;
      stroke(this.context);
    }
  }

  /** Returns length (m) and text of a scale bar with a largest width in pixels. */
  scaleBar(mostPx) {
    const metres = roundLength(mostPx / this.box.scale);
    return [metres, lengthText(metres)];
  }

  paintScale(mostPx, [x, y], colour, font) {
    const [metres, text] = this.scaleBar(mostPx);
    const context = this.context;
    const right = x + metres * this.box.scale;
    context.strokeStyle = colour;
    context.fillStyle = colour;
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(x, y - 5);
    context.lineTo(x, y);
    context.lineTo(right, y);
    context.lineTo(right, y - 5);
    context.stroke();
    context.font = font;
    context.fillText(text, x + 6, y - 6);
  }

  /** Arrows go from tile to tile, with Shift they move the map; plus and minus zoom, 0 shows all tiles. */
  key(event) {
    const step = STEPS[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    if (step && event.shiftKey) this.move(-PAN_PX * step[0], PAN_PX * step[1]);
    else if (step) {
      const next = beside(this.tiles, this.selected, step, [this.box.easting, this.box.northing]);
      if (next) this.chosen(next);
    } else if (event.key === "+" || event.key === "=") this.zoom(ZOOM);
    else if (event.key === "-") this.zoom(1 / ZOOM);
    else if (event.key === "0" || event.key === "Home") this.fit();
    else return false;
    return true;
  }
}

/** Returns the centre of a tile. */
export function middle(tile) {
  return [(tile.west + tile.east) / 2, (tile.south + tile.north) / 2];
}

/** Returns the nearest tile in a direction from a tile: left is (-1, 0), up (0, 1). Without a tile: the nearest to a place. */
export function beside(tiles, from, [dx, dy], place) {
  const [x, y] = from ? middle(from) : place;
  let [best, least] = [null, Infinity];
  for (const tile of tiles) {
    if (tile === from) continue;
    const [cx, cy] = middle(tile);
    const along = (cx - x) * dx + (cy - y) * dy;
    const across = Math.abs((cx - x) * dy) + Math.abs((cy - y) * dx);
    if (from && along <= 1e-6) continue;
    const cost = from ? along + 3 * across : Math.hypot(cx - x, cy - y);
    if (cost < least) [best, least] = [tile, cost];
  }
  return best;
}
