// The part of the ground that a map shows, as numbers, without a page.

export class ViewBox {
  constructor() {
    this.easting = 0;
    this.northing = 0;
    /** Pixels per metre. */
    this.scale = 1;
    this.width = 1;
    this.height = 1;
  }

  /** Shows bounds, with margins in pixels. */
  fit({ west, south, east, north }, { top = 24, bottom = 24, sides = 24 } = {}) {
    const [width, height] = [Math.max(this.width - 2 * sides, 10), Math.max(this.height - top - bottom, 10)];
    this.scale = Math.min(width / (east - west || 1), height / (north - south || 1));
    this.easting = (west + east) / 2;
    this.northing = (south + north) / 2 + (top - bottom) / 2 / this.scale;
  }

  /** Returns the pixel of a place. */
  toScreen(easting, northing) {
    return [
      this.width / 2 + (easting - this.easting) * this.scale,
      this.height / 2 - (northing - this.northing) * this.scale,
    ];
  }

  /** Returns the place of a pixel. */
  toGround(x, y) {
    return [
      this.easting + (x - this.width / 2) / this.scale,
      this.northing - (y - this.height / 2) / this.scale,
    ];
  }

  /** Moves the ground by pixels. */
  move(x, y) {
    this.easting -= x / this.scale;
    this.northing += y / this.scale;
  }

  /** Zooms by a factor; the place under a pixel stays there. */
  zoom(factor, x, y) {
    const [easting, northing] = this.toGround(x, y);
    this.scale *= factor;
    const [nowX, nowY] = this.toScreen(easting, northing);
    this.move(x - nowX, y - nowY);
  }
}
