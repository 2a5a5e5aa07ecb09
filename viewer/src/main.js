// The page: takes the run of run.js, and shows the map or a tile, by the address.

import { byId, el, fill, show } from "./dom.js";
import { MapView, summary } from "./map_view.js";
import { format, parse } from "./permalink.js";
import { DONE, runOf } from "./run.js";
import { TileScripts } from "./tile_scripts.js";
import { OUTLINE, TileView } from "./tile_view.js";

const LAYERS = { road: true, terrain: true, levels: true, wire: false, points: false };
const scripts = new TileScripts();
let received = null;

// The functions that run.js and tiles/*.js call.
window.FLEXROAD = {
  run: (data) => {
    received = data;
  },
  tile: (id, data) => scripts.take(id, data),
  pictures: (pictures) => {
    received.pictures = pictures;
  },
};

window.addEventListener("load", () => {
  if (received) new Page(runOf(received));
  else message("This folder is not complete", "run.js is missing or damaged: the folder was not written to the end.", "Write it again with flexroad view.");
});

class Page {
  constructor(run) {
    this.run = run;
    if (!run.tiles.length) {
      message(run.name, "This run has no tiles.", "See flexroad status.");
      return;
    }
    show(byId("message"), false);
    show(byId("app"), true);
    document.title = `${run.name} – FlexRoad`;
    this.maps = new MapView(run, { open: (tile, place) => this.openTile(tile, { place }), changed: () => this.follow() });
    this.listen();
    this.obey();
    if (run.pictures) this.loadPictures();
  }

  listen() {
    byId("back").addEventListener("click", () => this.showMap());
    byId("help").addEventListener("click", () => byId("help-text").showModal());
    byId("panel-toggle").addEventListener("click", () => byId("panel").classList.toggle("open"));
    // Unlike hashchange it comes before any timer. A timer would write the old view into the new entry.
    window.addEventListener("popstate", () => {
      if (window.location.hash !== this.hash) this.obey();
    });
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.theme());
    document.addEventListener("keydown", (event) => this.key(event));
    window.FLEXROAD.inspect = () => this.inspect();
  }

  /** Loads the small pictures of the tiles, after the map is shown. */
  loadPictures() {
    const script = el("script", { src: "pictures.js", load: () => this.maps.map.show(received.pictures) });
    document.head.append(script);
  }

  /** Keys work everywhere except in fields that use them. */
  key(event) {
    const own = event.target.closest("input[type=search], input[type=range], select, dialog");
    const pressed = event.key === "Enter" && event.target.closest("button, summary");
    if (own || pressed || event.ctrlKey || event.metaKey || event.altKey) return;
    const used = this.inTile ? this.tiles.key(event) : this.maps.key(event);
    if (used) event.preventDefault();
  }

  /** Shows the view of the address. */
  obey() {
    const state = parse(window.location.hash);
    this.hash = window.location.hash;
    this.maps.by(state.by);
    const tile = this.run.byId.get(state.tile);
    // The address already has an entry in the history.
    this.recorded = tile?.state === DONE;
    if (tile?.state === DONE) {
      this.openTile(tile, state);
      return;
    }
    this.showMap();
    if (tile) this.maps.choose(tile);
    else if (state.tile !== undefined) this.maps.lacks(state.tile);
  }

  async openTile(tile, state = {}) {
    if (!this.views()) return;
    this.switch(true);
    fill(byId("summary"), this.run.name);
    const look = lookOf(state);
    if (Object.keys(look).length) this.tiles.stage.apply(look);
    this.theme();
    this.maps.map.selected = tile;
    await this.tiles.open(tile, state, look.colour);
    this.follow();
  }

  showMap() {
    this.tiles?.close();
    this.switch(false);
    fill(byId("title"), this.run.name);
    fill(byId("summary"), summary(this.run));
    fill(byId("panel-content"), this.maps.panel());
    this.maps.map.resize();
    this.follow();
  }

  switch(toTile) {
    this.inTile = toTile;
    show(byId("tile-view"), toTile);
    show(byId("map-view"), !toTile);
    show(byId("back"), toTile);
    show(byId("tip"), false);
    byId("panel").classList.remove("open");
    byId("panel-content").scrollTop = 0;
  }

  /** Makes the 3D view on first use; returns whether the browser can show one. */
  views() {
    if (this.tiles) return true;
    try {
      this.tiles = new TileView(this.run, scripts, this.maps.choices, {
        back: () => this.showMap(),
        changed: () => this.follow(),
      });
      return true;
    } catch (error) {
      fill(byId("panel-content"), el("section", {}, el("p", { class: "error" }, `This browser cannot show 3D: ${error.message}`)), this.maps.panel());
      byId("panel").classList.add("open");
      return false;
    }
  }

  theme() {
    this.maps.map.draw();
    this.tiles?.stage.theme(getComputedStyle(document.documentElement).getPropertyValue("--sky").trim());
  }

  /** Writes the view into the address. */
  follow() {
    const by = this.maps.choice.key === "state" ? "" : this.maps.choice.key;
    const hash = format(this.inTile && this.tiles?.tile ? { ...this.tileState(), by } : { by });
    if (hash === this.hash) return;
    this.hash = hash;
    // "Back" leads from a tile to the map, and not through each move of the camera.
    const entered = this.inTile !== this.recorded;
    this.recorded = this.inTile;
    try {
      history[entered ? "pushState" : "replaceState"](null, "", hash || window.location.pathname);
    } catch {
      window.location[entered ? "assign" : "replace"](hash || "#");
    }
  }

  tileState() {
    const { stage, tile } = this.tiles;
    const names = (wanted) => Object.keys(LAYERS).filter((name) => LAYERS[name] !== wanted && stage.look[name] === wanted);
    return {
      tile: tile.id,
      colour: stage.look.colour,
      hide: names(false).join(","),
      show: names(true).join(","),
      z: stage.look.z === 1 ? null : stage.look.z,
      camera: stage.objects.has(tile) ? stage.where() : null,
    };
  }

  /** Returns the view, for scripts and tests. */
  inspect() {
    const stage = this.tiles?.stage;
    return {
      view: this.inTile ? "tile" : "map",
      tile: this.tiles?.tile?.id ?? null,
      loaded: stage ? [...stage.objects.keys()].map((tile) => tile.id) : [],
      loading: (stage?.loading ?? 0) + (stage?.later ? 1 : 0),
      look: stage?.look,
      camera: stage?.active ? stage.where() : null,
      lines: this.tiles?.drive.lines.length ?? 0,
      driving: this.tiles?.drive.running ?? false,
      box: { ...this.maps.map.box },
      outline: stage?.active ? this.tiles.overlay.drawn(OUTLINE) : null,
      corners: stage?.active && this.tiles.tile ? stage.pixels(stage.corners(this.tiles.tile)) : null,
      free: stage ? this.tiles.canvas.clientWidth - stage.covered() : null,
    };
  }
}

function lookOf(state) {
  const look = { ...(state.tile === undefined ? {} : LAYERS) };
  for (const name of (state.hide ?? "").split(",")) if (name in LAYERS) look[name] = false;
  for (const name of (state.show ?? "").split(",")) if (name in LAYERS) look[name] = true;
  if (["class", "photo", "support", "estimate"].includes(state.colour)) look.colour = state.colour;
  if (state.z >= 1 && state.z <= 20) look.z = state.z;
  return look;
}

function message(title, ...lines) {
  fill(byId("message"), el("h1", {}, title), lines.map((line) => el("p", {}, line)));
}
