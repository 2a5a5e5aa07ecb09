// The 3D scene: camera, light, the tiles near the camera's target, and the surface under a pixel.
//
// x is east, y is up, z is south, all relative to the run's origin; heights are relative to `base`, times the exaggeration.

import { Color, Group, LinearSRGBColorSpace, PerspectiveCamera, Raycaster, Scene, Spherical, Vector2, Vector3, WebGLRenderer } from "three";
import { MapControls } from "three/addons/controls/MapControls.js";

import { COLOURS, sharedUniforms } from "./material.js";
import { DONE, contains, near, tileAt } from "./run.js";
import { unpacked } from "./tile_data.js";
import { TileObject } from "./tile_object.js";

const EYE = 1.5;
const MOST_TILES = window.matchMedia("(max-width: 700px)").matches ? 5 : 9;
const NEARBY = 1.6;
const FROM_SOUTH = new Vector3(-0.25, 0.8, 0.9);
// Share of the free height and width that a complete tile takes.
const FILLED = 0.86;
// Distance to a place that is looked at from near (m), and points of a tile's edge, each side.
const CLOSE_M = 40;
const OUTLINE_POINTS = 64;
const EDGE_M = 0.05;

/** Returns the pick whose height is nearest to a height (m). */
export function nearest(picks, height) {
  return picks.reduce((best, pick) => (Math.abs(pick.height - height) < Math.abs(best.height - height) ? pick : best));
}

export class Stage {
  /** Draws into a canvas; `events` are changed(), entered(tile), loading(number), failed(tile, error), frame(). */
  constructor(canvas, run, scripts, events) {
    this.run = run;
    this.scripts = scripts;
    this.events = events;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.shared = sharedUniforms();
    this.scene = new Scene();
    this.ground = new Group();
    this.scene.add(this.ground);
    this.camera = new PerspectiveCamera(50, 1, 1, 10000);
    this.controls = new MapControls(this.camera, canvas);
    Object.assign(this.controls, { maxPolarAngle: 1.5, minDistance: 4, maxDistance: 20000, zoomToCursor: true });
    this.controls.addEventListener("change", () => this.moved());
    this.objects = new Map();
    this.missing = new Set();
    this.look = { colour: "class", road: true, terrain: true, levels: true, wire: false, points: false, z: 1 };
    this.base = 0;
    this.active = false;
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /** Returns the width of the canvas that the settings cover (pixels). */
  covered() {
    return this.renderer.domElement.clientWidth > 900 ? 330 : 0;
  }

  /**
   * Opens a tile: loads it, looks at it or at a place (easting, northing) on it, then loads the tiles around.
   * `camera` is easting, northing, height of eye and target.
   */
  async open(tile, { camera = null, place = null }) {
    this.active = true;
    this.tile = tile;
    const object = await this.load(tile);
    if (this.tile !== tile || !this.active) return;
    this.resize();
    if (object) this.rebase(object.low);
    if (camera) this.place(camera);
    else if (place) this.approach(place);
    else this.overlook(tile);
    this.moved();
  }

  /** Leaves the scene and frees its tiles. */
  close() {
    this.active = false;
    this.tile = null;
    this.scripts.keepOnly(new Set());
    for (const tile of [...this.objects.keys()]) this.unload(tile);
    this.missing.clear();
  }

  /** Shows the complete tile in the free space beside the settings, seen from the south. */
  overlook(tile) {
    const [easting, northing] = [(tile.west + tile.east) / 2, (tile.south + tile.north) / 2];
    const target = this.toScene(easting, northing, this.heightAt(easting, northing) ?? this.base);
    const toEye = FROM_SOUTH.clone().normalize();
    const right = new Vector3(0, 1, 0).cross(toEye).normalize();
    const up = toEye.clone().cross(right);
    const { clientWidth, clientHeight } = this.renderer.domElement;
    const high = Math.tan((this.camera.fov * Math.PI) / 360) * FILLED;
    const wide = (high * (clientWidth - this.covered())) / clientHeight;
    const needed = this.corners(tile).map((corner) => {
      const place = corner.sub(target);
      return place.dot(toEye) + Math.max(Math.abs(place.dot(right)) / wide, Math.abs(place.dot(up)) / high);
    });
    this.camera.position.copy(target).addScaledVector(toEye, Math.max(...needed));
    this.controls.target.copy(target);
    this.controls.update();
    this.moved();
  }

  /** Looks at a place (easting, northing) from near, from the south. */
  approach([easting, northing]) {
    const target = this.toScene(easting, northing, this.heightAt(easting, northing) ?? this.base);
    this.controls.target.copy(target);
    this.camera.position.copy(target).addScaledVector(FROM_SOUTH.clone().normalize(), CLOSE_M);
    this.controls.update();
    this.moved();
  }

  /** Returns the edge of a tile on its surface: places [easting, northing, height] around it; the corners twice. */
  outline({ tile, data }) {
    // Just inside, where the steps beside roads are from the tile's own cells.
    const [west, south, east, north] = [tile.west + EDGE_M, tile.south + EDGE_M, tile.east - EDGE_M, tile.north - EDGE_M];
    const corners = [[west, south], [east, south], [east, north], [west, north], [west, south]];
    // For heights of a mesh, all its triangles must be searched.
    const number = data.surface ? OUTLINE_POINTS : OUTLINE_POINTS / 8;
    return corners.slice(1).flatMap(([toX, toY], side) => {
      const [x, y] = corners[side];
      return Array.from({ length: number + 1 }, (_, i) => {
        const [easting, northing] = [x + ((toX - x) * i) / number, y + ((toY - y) * i) / number];
        return [easting, northing, this.heightAt(easting, northing) ?? this.base];
      });
    });
  }

  /** Returns the corners of a tile at the height of the surface. */
  corners({ west, south, east, north }) {
    const places = [[west, south], [east, south], [west, north], [east, north]];
    return places.map(([x, y]) => this.toScene(x, y, this.heightAt(x, y) ?? this.base));
  }

  /** Returns the pixels of places of the scene on the canvas. */
  pixels(places) {
    const { clientWidth, clientHeight } = this.renderer.domElement;
    this.camera.updateMatrixWorld();
    return places.map((place) => {
      const { x, y } = place.clone().project(this.camera);
      return [((x + 1) * clientWidth) / 2, ((1 - y) * clientHeight) / 2];
    });
  }

  /** Places the camera: easting, northing and height (m) of the eye, then of the target. */
  place([easting, northing, height, toEasting, toNorthing, toHeight]) {
    this.camera.position.copy(this.toScene(easting, northing, height));
    this.controls.target.copy(this.toScene(toEasting, toNorthing, toHeight));
    this.controls.update();
    this.moved();
  }

  /** Moves to the right and forwards, by a share of the distance to the target. */
  shift(right, forward) {
    const [eye, target] = [this.camera.position, this.controls.target];
    const ahead = new Vector3(target.x - eye.x, 0, target.z - eye.z).normalize();
    const aside = new Vector3(-ahead.z, 0, ahead.x);
    const step = ahead.multiplyScalar(forward).add(aside.multiplyScalar(right)).multiplyScalar(0.06 * eye.distanceTo(target));
    eye.add(step);
    target.add(step);
    this.controls.update();
    this.moved();
  }

  /** Turns around the target, by angles in radians. */
  turn(around, over) {
    const { target } = this.controls;
    const place = new Spherical().setFromVector3(this.camera.position.clone().sub(target));
    place.theta += around;
    place.phi = Math.min(Math.max(place.phi - over, 0.05), this.controls.maxPolarAngle);
    this.camera.position.setFromSpherical(place).add(target);
    this.controls.update();
    this.moved();
  }

  /** Returns the place of the camera, as for `place`. */
  where() {
    return [...this.toGround(this.camera.position), ...this.toGround(this.controls.target)];
  }

  /** Changes the view; z is the vertical exaggeration. */
  apply(look) {
    const target = this.toGround(this.controls.target);
    const eye = this.camera.position.clone().sub(this.controls.target);
    const stretched = look.z !== undefined && look.z !== this.look.z;
    this.look = { ...this.look, ...look };
    this.shared.colour.value = COLOURS[this.look.colour];
    this.shared.z.value = this.look.z;
    this.ground.scale.y = this.look.z;
    this.ground.position.y = -this.base * this.look.z;
    for (const object of this.objects.values()) object.apply(this.look);
    if (stretched && this.active) {
      // The eye keeps its distance to the target.
      this.controls.target.copy(this.toScene(...target));
      this.camera.position.copy(this.controls.target).add(eye);
      this.controls.update();
      this.moved();
    }
    this.draw();
  }

  /** Takes the colours of the page. */
  theme(sky) {
    this.shared.sky.value = new Color(sky);
    this.scene.background = new Color(sky);
    this.draw();
  }

  toScene(easting, northing, height) {
    const [east, north] = this.run.origin;
    return new Vector3(easting - east, (height - this.base) * this.look.z, north - northing);
  }

  toGround({ x, y, z }) {
    const [east, north] = this.run.origin;
    return [x + east, north - z, y / this.look.z + this.base];
  }

  /**
   * Returns the height of the surface at a place (m); null where no tile is loaded. With decks or tunnels it is
   * the height seen from above, or of the level that is nearest to a height.
   */
  heightAt(easting, northing, near = null) {
    const levels = near === null ? [] : this.levelsAt(easting, northing);
    if (levels.length) return nearest(levels, near).height;
    for (const object of this.objects.values()) {
      const found = object.at(easting, northing);
      if (found) return found.height;
    }
    return this.meshHeight(easting, northing);
  }

  /** Returns the pick of each level at a place, the highest first; empty on tiles with only level 0. */
  levelsAt(easting, northing) {
    const object = this.objectAt(easting, northing);
    if (!object?.data.top) return [];
    const found = object.levels.map((level) => this.hit(this.down(easting, northing), object.meshesOf(level)));
    return found.filter(Boolean).sort((a, b) => b.height - a.height);
  }

  /** Returns the loaded tile under a place. */
  objectAt(easting, northing) {
    for (const object of this.objects.values()) if (contains(object.tile, easting, northing)) return object;
    return null;
  }

  /** Returns place, height, slopes and tile under a pixel of the canvas, and the height of the mesh; null for the sky. */
  pick(x, y) {
    const { clientWidth, clientHeight } = this.renderer.domElement;
    const ray = new Raycaster();
    ray.setFromCamera(new Vector2((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight), this.camera);
    return this.hit(ray, this.visible());
  }

  meshHeight(easting, northing) {
    return this.hit(this.down(easting, northing), this.visible(), false)?.height ?? null;
  }

  down(easting, northing) {
    return new Raycaster(this.toScene(easting, northing, this.base + 1e5), new Vector3(0, -1, 0));
  }

  visible() {
    return [...this.objects.values()].flatMap((object) => Object.values(object.meshes).filter((mesh) => mesh.visible));
  }

  hit(ray, meshes, exact = true) {
    // Else tiles that were not drawn yet would have no places.
    this.ground.updateMatrixWorld();
    const [first] = ray.intersectObjects(meshes, false);
    if (!first) return null;
    const [easting, northing, height] = this.toGround(first.point);
    const object = first.object.userData.owner;
    const surface = exact ? object.at(easting, northing) : null;
    const { x, y, z } = first.normal ?? first.face.normal;
    return {
      easting,
      northing,
      height: surface?.height ?? height,
      drawn: height,
      byEasting: surface?.byEasting ?? -x / y,
      byNorthing: surface?.byNorthing ?? z / y,
      kind: first.object.name,
      level: first.object.userData.level,
      object,
    };
  }

  /** Requests the next frame; many calls give one frame. */
  draw() {
    if (this.frame || !this.active) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = null;
      if (!this.active) return;
      this.events.frame();
      const away = Math.max(this.camera.position.distanceTo(this.controls.target), 5);
      this.camera.near = away / 200;
      this.camera.far = away * 12 + 1500;
      this.shared.far.value = this.camera.far;
      this.camera.updateProjectionMatrix();
      this.renderer.render(this.scene, this.camera);
    });
  }

  moved() {
    if (!this.active) return;
    this.stayAbove();
    this.draw();
    // Not on every step. During a drive or a long drag tiles are loaded, too.
    this.later ??= setTimeout(() => {
      this.later = null;
      this.refresh();
      this.events.changed();
    }, 120);
  }

  /** Loads the tiles near the target, and removes tiles far away. */
  refresh() {
    if (!this.active) return;
    const [easting, northing] = this.toGround(this.controls.target);
    const size = this.tile ? this.tile.east - this.tile.west : 250;
    const away = this.camera.position.distanceTo(this.controls.target);
    const within = Math.min(Math.max(away, size * 0.5), size * 3);
    const wanted = new Set(near(this.run, easting, northing, within, MOST_TILES));
    const under = tileAt(this.run, easting, northing);
    if (under && under !== this.tile && under.state === DONE && this.objects.has(under)) {
      this.tile = under;
      this.events.entered(under);
    }
    this.scripts.keepOnly(wanted);
    for (const tile of wanted) this.load(tile);
    // Tiles a little farther away stay: small moves must not load them again and again.
    const kept = new Set(near(this.run, easting, northing, within * NEARBY, MOST_TILES + 3));
    for (const tile of [...this.objects.keys()]) if (!kept.has(tile) && !wanted.has(tile)) this.unload(tile);
  }

  /** Loads a tile; returns its object, null if it cannot be loaded or is no longer wanted. */
  async load(tile) {
    if (this.objects.has(tile)) return this.objects.get(tile);
    if (this.missing.has(tile)) return null;
    this.loading = (this.loading ?? 0) + 1;
    this.events.loading(this.loading);
    try {
      const data = await unpacked(tile, await this.scripts.load(tile));
      if (!this.active || this.objects.has(tile)) return this.objects.get(tile) ?? null;
      const object = new TileObject(data, this.run.origin, this.shared);
      object.apply(this.look);
      this.objects.set(tile, object);
      this.ground.add(object.group);
      this.draw();
      this.events.changed();
      return object;
    } catch (error) {
      if (error.message !== "no longer wanted") {
        this.missing.add(tile);
        this.events.failed(tile, error);
      }
      return null;
    } finally {
      this.loading -= 1;
      this.events.loading(this.loading);
    }
  }

  unload(tile) {
    const object = this.objects.get(tile);
    this.ground.remove(object.group);
    object.dispose();
    this.objects.delete(tile);
  }

  rebase(low) {
    this.base = low;
    this.ground.position.y = -low * this.look.z;
  }

  stayAbove() {
    const [easting, northing, height] = this.toGround(this.camera.position);
    const object = this.objectAt(easting, northing);
    const ground = object?.at(easting, northing)?.height;
    if (ground !== undefined && height < ground + EYE / this.look.z) {
      this.camera.position.copy(this.toScene(easting, northing, ground + EYE / this.look.z));
    }
  }

  resize() {
    const { clientWidth, clientHeight } = this.renderer.domElement;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    // The middle of the free space beside the settings, not of the canvas.
    this.camera.setViewOffset(clientWidth, clientHeight, this.covered() / 2, 0, clientWidth, clientHeight);
    this.draw();
  }
}
