// The scene with its settings, the card under the cursor, the section and the drive.

import { chart, legend as chartLegend } from "./chart.js";
import { byId, el, fill, show } from "./dom.js";
import { Drive } from "./drive.js";
import { Overlay } from "./overlay.js";
import { buttons, check, legend, section, slider, surfaceLegend, tileFigures, tileHead } from "./panel.js";
import { metres, signed } from "./place.js";
import { csv, section as along, summary } from "./profile.js";
import { Readout } from "./readout.js";
import { Stage } from "./stage.js";
import { POINTS } from "./tile_object.js";

const CLICK_PX = 5;
const KEYS = { r: "road", t: "terrain", w: "wire", s: "points", l: "levels" };
const COLOUR_KEYS = ["class", "photo", "support", "estimate"];
/** Name of the line around the tile. */
export const OUTLINE = "outline";
const OUTLINE_COLOUR = "#1f8fd0";
const FLAG_COLOUR = "#e3a02c";
const SPEEDS = { min: 10, max: 130, step: 5 };

export class TileView {
  /** `back()` returns to the map; `changed()` is called when the address must be updated. */
  constructor(run, scripts, choices, { back, changed }) {
    this.run = run;
    this.choices = choices;
    this.back = back;
    this.changed = changed;
    this.canvas = byId("scene");
    this.stage = new Stage(this.canvas, run, scripts, {
      changed: () => this.followed(),
      entered: (tile) => this.enter(tile),
      loading: (number) => this.loading(number),
      failed: (tile, error) => this.hint(`Tile ${tile.id}: ${error.message}`, tile === this.tile ? 0 : 8000),
      frame: () => this.overlay.update(),
    });
    this.overlay = new Overlay(this.stage);
    this.readout = new Readout(byId("readout"), run, this.stage);
    this.drive = new Drive(this.stage, { passed: (pick) => this.readout.show(pick), ended: () => this.driveEnded() });
    this.places = [];
    this.listen();
  }

  /** Shows a tile in 3D; `camera` and `place` are as in `Stage.open`. */
  async open(tile, { camera, place }, colour) {
    this.chosen ||= Boolean(colour);
    this.enter(tile);
    await this.stage.open(tile, { camera, place });
    if (this.tile === tile) this.redraw();
  }

  /** Takes the tile under the camera's target. */
  enter(tile) {
    this.tile = tile;
    fill(byId("title"), tile.id);
    this.redraw();
    this.mark();
  }

  /** Draws the tile's outline and the places of its flags, once it is loaded. */
  mark() {
    const object = this.stage.objects.get(this.tile);
    if (this.marked === object) return;
    this.marked = object;
    this.overlay.line(OUTLINE, object ? this.stage.outline(object) : null, OUTLINE_COLOUR);
    for (const flag of this.flagged ?? []) this.overlay.dot(`flag:${flag}`, null);
    this.flagged = object ? Object.keys(this.tile.places) : [];
    for (const flag of this.flagged) {
      const [easting, northing] = this.tile.places[flag];
      const height = this.stage.heightAt(easting, northing) ?? this.stage.base;
      this.overlay.dot(`flag:${flag}`, [easting, northing, height], FLAG_COLOUR);
    }
  }

  close() {
    this.drive.stop();
    this.measure(false);
    this.readout.show(null);
    this.stage.close();
    this.tile = null;
    this.mark();
    show(byId("hint"), false);
  }

  /** Returns the settings; called again when a tile has been loaded. */
  panel() {
    const { look } = this.stage;
    const object = this.stage.objects.get(this.tile);
    const lacks = (has, what) => (object && !has ? `This tile has no ${what}.` : null);
    const data = object?.data;
    const colours = [
      { key: "class", label: "Class" },
      { key: "photo", label: "Photo", off: lacks(data?.photo, "orthophoto") },
      { key: "support", label: "Height source", off: lacks(data?.support, "support") },
      { key: "estimate", label: "Error estimate", off: lacks(data?.estimate, "error estimate") },
    ];
    const layer = (name, label, off) => check(name, label, look[name], (on) => this.apply({ [name]: on }), off);
    const set = (colour) => this.apply({ colour });
    return [
      el("section", {}, tileHead(this.tile, (place) => this.approach(place))),
      this.tools(),
      section("Colour", buttons(colours, look.colour, set), surfaceLegend(look.colour)),
      section(
        "Show",
        layer("road", "Road"),
        layer("terrain", "Terrain"),
        this.run.levels ? layer("levels", "Decks and tunnels") : null,
        layer("wire", "Wireframe"),
        layer("points", "Scan points (DSM)", lacks(data?.dsm, "scan to compare with")),
        look.points ? legend(POINTS) : null,
      ),
      section(
        null,
        slider("z", "Heights times", { min: 1, max: 10, step: 0.5, value: look.z }, (value) => `${value}`, (z) => this.apply({ z }, true)),
      ),
      el("section", {}, this.figures(), el("div", { class: "quiet small" }, this.systems())),
    ];
  }

  approach(place) {
    byId("panel").classList.remove("open");
    this.stage.approach(place);
  }

  tools() {
    const { running, speed, lines } = this.drive;
    const faster = (value) => {
      this.drive.speed = value / 3.6;
    };
    return section(
      null,
      el(
        "div",
        { class: "choices" },
        this.tool("measure", "Section", this.measuring, () => this.measure(!this.measuring)),
        lines.length ? this.tool("drive", "Drive along", running, () => this.toggleDrive()) : null,
        el("button", { type: "button", click: () => this.stage.overlook(this.tile) }, "Whole tile"),
        el("button", { type: "button", click: () => this.copyLink() }, "Copy link"),
      ),
      running
        ? slider("speed", "Speed", { ...SPEEDS, value: Math.round(speed * 3.6) }, (value) => `${value} km/h`, faster)
        : null,
    );
  }

  figures() {
    return tileFigures(this.tile, this.choices, this.unfolded, (open) => {
      this.unfolded = open;
    });
  }

  systems() {
    const { crs_name: plan, vertical } = this.run;
    return [el("p", {}, `Coordinates: ${plan}`), el("p", {}, `Heights: ${vertical ?? "as in the data"}, m`)];
  }

  tool(name, label, pressed, click) {
    return el("button", { type: "button", "data-tool": name, "aria-pressed": String(Boolean(pressed)), click }, label);
  }

  /** Changes the view. */
  apply(look, quiet = false) {
    if (look.colour) this.chosen = true;
    this.stage.apply(look);
    if (look.z) this.drawSection();
    if (!quiet) this.redraw();
    this.changed();
  }

  redraw() {
    if (this.tile) fill(byId("panel-content"), this.panel());
  }

  followed() {
    if (!this.tile) return;
    const object = this.stage.objects.get(this.tile);
    this.mark();
    if (object && !this.chosen && object.data.photo && this.stage.look.colour === "class") {
      this.chosen = true;
      this.stage.apply({ colour: "photo" });
      this.redraw();
    }
    const lines = this.drive.lines.length > 0;
    if (lines !== this.hadLines) this.redraw();
    this.hadLines = lines;
    this.changed();
  }

  listen() {
    let down = null;
    this.canvas.addEventListener("pointerdown", (event) => {
      down = [event.clientX, event.clientY];
    });
    this.canvas.addEventListener("pointerup", (event) => {
      const still = down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < CLICK_PX;
      down = null;
      if (still && event.button === 0) this.clicked(...this.pixel(event));
    });
    this.canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons && event.pointerType !== "touch") this.point(this.pixel(event));
    });
    this.canvas.addEventListener("pointerleave", (event) => {
      if (event.pointerType !== "touch") this.point(null);
    });
    byId("section-close").addEventListener("click", () => this.measure(false));
    byId("section-save").addEventListener("click", () => this.save());
    fill(byId("section-legend"), chartLegend());
    new ResizeObserver(() => this.drawSection()).observe(byId("chart"));
  }

  pixel(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  point(pixel) {
    this.pointer = pixel;
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = null;
      if (!this.tile || this.drive.running) return;
      this.readout.show(this.pointer && this.stage.pick(...this.pointer));
    });
  }

  clicked(x, y) {
    if (this.drive.running) return;
    const pick = this.stage.pick(x, y);
    this.readout.show(pick);
    if (!this.measuring || !pick) return;
    this.places = this.places.length === 1 ? [this.places[0], pick] : [pick];
    this.overlay.dot("from", spot(this.places[0]), "#ffffff");
    this.overlay.dot("to", spot(this.places[1]), "#ffffff");
    if (this.places.length === 1) {
      this.overlay.line("section", null);
      this.hint("Choose where the section ends.");
      return;
    }
    show(byId("hint"), false);
    this.stations = along(this.stage, ...this.places);
    const known = this.stations.filter(({ surface }) => !Number.isNaN(surface));
    this.overlay.line("section", known.map((s) => [s.easting, s.northing, s.surface]), "#ff6b35");
    show(byId("section"), true);
    byId("panel").classList.remove("open");
    this.drawSection();
  }

  drawSection() {
    if (!this.stations || byId("section").hidden) return;
    const found = summary(this.stations);
    const text = found
      ? `${metres(found.length, 1)} m, ${found.rise < 0 ? "falls" : "rises"} ${Math.abs(found.rise).toFixed(2)} m, ${signed(found.grade, 1)} % on average`
      : "No surface along this line";
    fill(byId("section-text"), text);
    chart(byId("chart"), this.stations, (station) =>
      this.overlay.dot("cursor", station && !Number.isNaN(station.surface) ? spot({ ...station, height: station.surface }) : null, "#ff6b35"),
    );
  }

  /** Starts or ends measuring sections. */
  measure(on) {
    this.measuring = on;
    this.places = [];
    this.stations = null;
    for (const name of ["from", "to", "cursor"]) this.overlay.dot(name, null);
    this.overlay.line("section", null);
    show(byId("section"), false);
    if (on) {
      byId("panel").classList.remove("open");
      this.hint("Choose where the section begins.");
    } else show(byId("hint"), false);
    this.redraw();
  }

  save() {
    const link = el("a", { download: `section_${this.tile.file}.csv`, href: `data:text/csv,${encodeURIComponent(csv(this.stations))}` });
    link.click();
  }

  toggleDrive() {
    if (this.drive.running) this.drive.stop();
    else if (this.drive.start()) {
      byId("panel").classList.remove("open");
      this.hint("Escape or the button stops the drive.", 3000);
    } else this.hint("There is no road line near here.", 3000);
    this.redraw();
  }

  driveEnded() {
    this.hint("The road line ends here.", 3000);
    this.redraw();
  }

  async copyLink() {
    const done = await navigator.clipboard?.writeText(window.location.href).then(
      () => true,
      () => false,
    );
    this.hint(done ? "The link is copied." : "Copy the link from the address bar.", 3000);
  }

  hint(text, milliseconds) {
    fill(byId("hint"), text);
    show(byId("hint"), true);
    clearTimeout(this.hiding);
    if (milliseconds) this.hiding = setTimeout(() => show(byId("hint"), false), milliseconds);
  }

  loading(number) {
    show(byId("loading"), number > 0);
    fill(byId("loading"), number === 1 ? "Loading a tile" : `Loading ${number} tiles`);
  }

  /** Runs the command of a key; returns whether the key has a command. */
  key(event) {
    const name = event.key.toLowerCase();
    const { controls } = this.stage;
    const arrows = { arrowleft: [1, 0], arrowright: [-1, 0], arrowup: [0, 1], arrowdown: [0, -1] };
    const zooms = { "+": 1, "=": 1, "-": -1 };
    if (name === "escape") this.leave();
    else if (KEYS[name]) this.apply({ [KEYS[name]]: !this.stage.look[KEYS[name]] });
    else if (COLOUR_KEYS[Number(name) - 1]) this.colourByKey(COLOUR_KEYS[Number(name) - 1]);
    else if (name === "p") this.measure(!this.measuring);
    else if (name === "d" && this.drive.lines.length) this.toggleDrive();
    else if (zooms[name]) this.zoom(zooms[name]);
    else if (arrows[name] && !this.drive.running) this.step(controls, arrows[name], event.shiftKey);
    else return false;
    return true;
  }

  colourByKey(colour) {
    const button = document.querySelector(`#panel-content button[data-key="${colour}"]`);
    if (button && !button.disabled) this.apply({ colour });
  }

  leave() {
    if (this.drive.running) this.toggleDrive();
    else if (this.measuring) this.measure(false);
    else this.back();
  }

  zoom(direction) {
    if (this.drive.running) {
      this.drive.speed = Math.min(Math.max(this.drive.speed + direction * 2, 3), 40);
      this.redraw();
      return;
    }
    const { controls, camera } = this.stage;
    camera.position.sub(controls.target).multiplyScalar(direction > 0 ? 0.85 : 1 / 0.85).add(controls.target);
    controls.update();
    this.stage.moved();
  }

  step(controls, [x, y], turn) {
    if (turn) this.stage.turn(x * 0.08, y * 0.05);
    else this.stage.shift(-x, y);
  }
}

function spot(place) {
  return place ? [place.easting, place.northing, place.height] : null;
}
