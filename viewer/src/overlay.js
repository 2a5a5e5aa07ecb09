// Lines and dots over the surface: the profile, the place under its cursor, road lines.

import { Color, Group, Mesh, MeshBasicMaterial, SphereGeometry, Vector2 } from "three";
import { Line2 } from "three/addons/lines/Line2.js";
import { LineGeometry } from "three/addons/lines/LineGeometry.js";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";

const DOT_PX = 6;

export class Overlay {
  constructor(stage) {
    this.stage = stage;
    this.group = new Group();
    this.group.renderOrder = 10;
    stage.scene.add(this.group);
    this.lines = new Map();
    this.dots = new Map();
  }

  /** Draws a line through places [easting, northing, height]; null removes it. */
  line(name, places, colour) {
    const old = this.lines.get(name);
    if (old) {
      this.group.remove(old.object);
      old.object.geometry.dispose();
      old.object.material.dispose();
      this.lines.delete(name);
    }
    if (places && places.length > 1) {
      const size = this.stage.renderer.getSize(new Vector2());
      const material = new LineMaterial({ color: new Color(colour), linewidth: 3, depthTest: false, transparent: true });
      material.resolution.copy(size);
      const object = new Line2(new LineGeometry(), material);
      object.renderOrder = 10;
      object.frustumCulled = false;
      this.lines.set(name, { object, places });
      this.group.add(object);
      this.set(name);
    }
    this.stage.draw();
  }

  /** Returns the places of a line; null if it is not drawn. */
  drawn(name) {
    return this.lines.get(name)?.places ?? null;
  }

  /** Puts a dot at a place [easting, northing, height]; null removes it. */
  dot(name, place, colour) {
    let dot = this.dots.get(name);
    if (!dot && place) {
      const material = new MeshBasicMaterial({ color: new Color(colour), depthTest: false, transparent: true });
      dot = { object: new Mesh(new SphereGeometry(1, 16, 12), material) };
      dot.object.renderOrder = 11;
      this.dots.set(name, dot);
      this.group.add(dot.object);
    }
    if (dot) {
      dot.place = place;
      dot.object.visible = Boolean(place);
    }
    this.stage.draw();
  }

  /** Follows camera and vertical exaggeration; called before each frame. */
  update() {
    const { camera, renderer } = this.stage;
    const perPixel = (2 * Math.tan((camera.fov * Math.PI) / 360)) / renderer.domElement.clientHeight;
    for (const { object, place } of this.dots.values()) {
      if (!place) continue;
      object.position.copy(this.stage.toScene(...place));
      object.scale.setScalar(camera.position.distanceTo(object.position) * perPixel * DOT_PX);
    }
    const shape = `${this.stage.look.z},${this.stage.base}`;
    if (shape !== this.shape) {
      this.shape = shape;
      for (const name of this.lines.keys()) this.set(name);
    }
    for (const { object } of this.lines.values()) renderer.getSize(object.material.resolution);
  }

  set(name) {
    const { object, places } = this.lines.get(name);
    object.geometry.setPositions(places.flatMap((place) => this.stage.toScene(...place).toArray()));
  }
}
