// The map: tiles as rectangles on a canvas, with relief below, zoom, pan, hover and selection.

const FIT_MARGIN = 0.06;
const MOST_PIXELS_PER_METRE = 40;
const CLICK_PX = 5;
const DETAIL_PX = 26;

class TileMap {
  constructor(canvas, data, relief, on) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.data = data;
    this.relief = relief;
    this.on = on;
    this.selected = -1;
    this.showRelief = true;
    this.colours = () => null;
    this.view = null;
    this.pointers = new Map();
    this.placed = data.boxes.flatMap((box, i) => (box ? [i] : []));
    this.listen();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  // --- view -----------------------------------------------------------------------------------------

  resize() {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width || !height) return;
    const before = this.view && this.isFitted();
    this.ratio = Math.max(1, window.devicePixelRatio || 1);
    this.width = width;
    this.height = height;
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(height * this.ratio);
    if (!this.view || before) this.fit();
    else this.draw();
  }

  fittedScale() {
    const [west, south, east, north] = this.data.bounds;
    const w = Math.max(east - west, 1), h = Math.max(north - south, 1);
    return (1 - 2 * FIT_MARGIN) * Math.min(this.width / w, this.height / h);
  }

  isFitted() {
    return Math.abs(this.view.scale / this.fittedAt - 1) < 1e-6;
  }

  fit() {
    const [west, south, east, north] = this.data.bounds;
    this.fittedAt = this.fittedScale();
    this.view = { x: (east - west) / 2, y: (north - south) / 2, scale: this.fittedAt };
    this.draw();
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.toGround(px, py);
    const least = this.fittedScale() * 0.5;
    this.view.scale = Math.min(Math.max(this.view.scale * factor, least), MOST_PIXELS_PER_METRE);
    this.view.x = x - (px - this.width / 2) / this.view.scale;
    this.view.y = y + (py - this.height / 2) / this.view.scale;
    this.draw();
  }

  pan(dx, dy) {
    const [west, south, east, north] = this.data.bounds;
    const clamp = (v, top) => Math.min(Math.max(v, 0), top);
    this.view.x = clamp(this.view.x - dx / this.view.scale, east - west);
    this.view.y = clamp(this.view.y + dy / this.view.scale, north - south);
    this.draw();
  }

  show(i) {
    const box = this.data.boxes[i];
    if (!box) return;
    const [x0, y0] = this.toPixel(box[0], box[3]), [x1, y1] = this.toPixel(box[2], box[1]);
    const margin = 12;
    if (x0 < margin || y0 < margin || x1 > this.width - margin || y1 > this.height - margin) {
      this.view.x = (box[0] + box[2]) / 2;
      this.view.y = (box[1] + box[3]) / 2;
    }
    // A tile of a large run is a dot until one zooms in.
    const side = (box[2] - box[0]) * this.view.scale;
    if (side < 14) {
      this.view.x = (box[0] + box[2]) / 2;
      this.view.y = (box[1] + box[3]) / 2;
      this.view.scale = 60 / (box[2] - box[0]);
    }
    this.draw();
  }

  // Positions on the ground are relative to the south-west corner of the run (m).
  toGround(px, py) {
    return [this.view.x + (px - this.width / 2) / this.view.scale,
            this.view.y - (py - this.height / 2) / this.view.scale];
  }

  toPixel(x, y) {
    return [this.width / 2 + (x - this.view.x) * this.view.scale,
            this.height / 2 - (y - this.view.y) * this.view.scale];
  }

  tileAt(px, py) {
    const [x, y] = this.toGround(px, py);
    let best = -1, least = Infinity;
    for (const i of this.placed) {
      const [west, south, east, north] = this.data.boxes[i];
      if (x < west || x > east || y < south || y > north) continue;
      const size = (east - west) * (north - south);
      if (size < least) { best = i; least = size; }
    }
    return best;
  }

  // The nearest tile to the left (-1, 0), above (0, 1) and so on of the selected one.
  neighbour(dx, dy) {
    if (!this.placed.length) return -1;
    const centre = (i) => {
      const b = this.data.boxes[i];
      return [(b[0] + b[2]) / 2, (b[1] + b[3]) / 2];
    };
    const chosen = this.selected >= 0 && this.data.boxes[this.selected];
    const [x, y] = chosen ? centre(this.selected) : [this.view.x, this.view.y];
    let best = chosen ? this.selected : -1, least = Infinity;
    for (const i of this.placed) {
      if (i === this.selected) continue;
      const [cx, cy] = centre(i);
      const along = (cx - x) * dx + (cy - y) * dy;
      const across = Math.abs((cx - x) * dy) + Math.abs((cy - y) * dx);
      if (chosen && along <= 1e-6) continue;
      const cost = chosen ? along + 3 * across : Math.hypot(cx - x, cy - y);
      if (cost < least) { best = i; least = cost; }
    }
    return best;
  }

  // --- drawing --------------------------------------------------------------------------------------

  draw() {
    if (this.waiting || !this.view) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.paint(); });
  }

  paint() {
    const c = this.context, theme = themeColours();
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.globalCompositeOperation = "source-over";
    c.fillStyle = theme.ground;
    c.fillRect(0, 0, this.width, this.height);
    const visible = [];
    for (const i of this.placed) {
      const rect = this.pixels(this.data.boxes[i]);
      if (rect[0] > this.width || rect[1] > this.height || rect[0] + rect[2] < 0 || rect[1] + rect[3] < 0) continue;
      visible.push([i, rect]);
    }
    if (this.showRelief && this.relief.image) this.paintRelief(visible, theme);
    for (const [i, rect] of visible) this.paintTile(i, rect, theme);
    c.globalCompositeOperation = "source-over";
    for (const [i, rect] of visible) this.paintMarks(i, rect, theme);
    if (this.selected >= 0 && this.data.boxes[this.selected]) {
      const [x, y, w, h] = this.pixels(this.data.boxes[this.selected]);
      for (const [colour, line] of [[theme.halo, 6], [theme.mark, 3]]) {
        c.strokeStyle = colour;
        c.lineWidth = line;
        c.strokeRect(x, y, w, h);
      }
    }
    if (printing) this.paintScale(theme);
    this.on.view(this);
  }

  // Length of the scale bar: a round number of metres that takes at most 130 pixels.
  scaleMetres() {
    const most = 130 / this.view.scale, power = 10 ** Math.floor(Math.log10(most));
    return [5, 2, 1].map((n) => n * power).find((n) => n <= most);
  }

  // On paper the map has another size than in the window, and its scale bar is a part of it.
  paintScale(theme) {
    const c = this.context, metres = this.scaleMetres(), right = 14 + metres * this.view.scale, y = this.height - 14;
    c.strokeStyle = c.fillStyle = theme.mark;
    c.lineWidth = 2;
    c.beginPath();
    c.moveTo(14, y - 10);
    c.lineTo(14, y);
    c.lineTo(right, y);
    c.lineTo(right, y - 10);
    c.stroke();
    c.font = "14px sans-serif";
    c.textAlign = "center";
    c.fillText(length(metres), (14 + right) / 2, y - 5);
  }

  // Whole pixels, so that neighbours have no line between them.
  pixels(box) {
    const [x0, y0] = this.toPixel(box[0], box[3]), [x1, y1] = this.toPixel(box[2], box[1]);
    const left = Math.round(x0), top = Math.round(y0);
    return [left, top, Math.max(1, Math.round(x1) - left), Math.max(1, Math.round(y1) - top)];
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
    const spots = this.data.places[i];
    if (spots && w > 2 * DETAIL_PX) {
      for (const [east, north] of Object.values(spots)) {
        const [px, py] = this.toPixel(east - this.data.bounds[0], north - this.data.bounds[1]);
        for (const [colour, line] of [[theme.halo, 4.5], [theme.mark, 2]]) {
          c.strokeStyle = colour;
          c.lineWidth = line;
          c.beginPath();
          c.arc(px, py, 7, 0, 2 * Math.PI);
          c.stroke();
        }
      }
    }
  }

  // --- pointer and keyboard -------------------------------------------------------------------------

  listen() {
    const canvas = this.canvas;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, at(event));
      this.moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const [px, py] = at(event), last = this.pointers.get(event.pointerId);
      if (last) this.drag(event.pointerId, last, [px, py]);
      const over = this.tileAt(px, py);
      canvas.style.cursor = last && this.moved > CLICK_PX ? "grabbing" : over >= 0 ? "pointer" : "grab";
      this.on.hover(over, px, py);
    });
    canvas.addEventListener("pointerup", (event) => {
      const was = this.pointers.delete(event.pointerId);
      const [px, py] = at(event);
      if (was && !this.pointers.size && this.moved <= CLICK_PX) this.on.select(this.tileAt(px, py));
    });
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => this.on.hover(-1, 0, 0));
    canvas.addEventListener("wheel", (event) => {
      // Without focus the wheel scrolls the page.
      if (document.activeElement !== canvas && !event.ctrlKey) { this.on.wheel(); return; }
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at(event));
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => this.zoom(2, ...at(event)));
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  drag(id, last, now) {
    if (this.pointers.size === 2) {
      const [other] = [...this.pointers].filter(([key]) => key !== id).map(([, place]) => place);
      const distance = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
      if (distance(last) > 10) this.zoom(distance(now) / distance(last), other[0], other[1]);
      this.moved = CLICK_PX + 1;
    } else {
      this.moved += Math.hypot(now[0] - last[0], now[1] - last[1]);
      if (this.moved > CLICK_PX) this.pan(now[0] - last[0], now[1] - last[1]);
    }
    this.pointers.set(id, now);
    // While all of the run is visible, a finger scrolls the page.
    this.canvas.style.touchAction = this.isFitted() ? "pan-y" : "none";
  }

  key(event) {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = arrows[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (step && event.shiftKey) this.pan(-60 * step[0], 60 * step[1]);
    else if (step) this.on.select(this.neighbour(...step), true);
    else if (event.key === "+" || event.key === "=") this.zoom(1.5);
    else if (event.key === "-") this.zoom(1 / 1.5);
    else if (event.key === "0" || event.key === "Home") this.fit();
    else if (event.key === "Escape") this.on.select(-1);
    else return;
    event.preventDefault();
  }
}
