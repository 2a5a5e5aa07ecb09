// A drive along a road line at the height of a driver's eyes. Where lines meet, it continues on the next line.

import { continuation, lengths, nearestLine, placeAt } from "./lines.js";
import { nearest } from "./stage.js";

const EYE_M = 2.2;
const AHEAD_M = 18;
const START_WITHIN_M = 400;
const REPORT_MS = 200;

export class Drive {
  /** `passed(pick)` is called with the surface below, several times a second; `ended()` at the end of the road line. */
  constructor(stage, { passed, ended }) {
    this.stage = stage;
    this.passed = passed;
    this.ended = ended;
    this.speed = 40 / 3.6;
    this.running = false;
  }

  /** All road lines of the loaded tiles. */
  get lines() {
    return [...this.stage.objects.values()].flatMap((object) => object.data.lines);
  }

  /** Starts at the place on a line that is nearest to the camera's target; returns whether there is a line. */
  start() {
    const [easting, northing, height] = this.stage.toGround(this.stage.controls.target);
    const found = nearestLine(this.lines, easting, northing, START_WITHIN_M);
    if (!found) return false;
    const [eye, target] = [this.stage.camera.position, this.stage.controls.target];
    const view = [target.x - eye.x, eye.z - target.z];
    const forward = view[0] * found.direction[0] + view[1] * found.direction[1] >= 0;
    this.take(found.line, forward ? found.line.points : [...found.line.points].reverse());
    this.at = forward ? found.along : this.along[this.along.length - 1] - found.along;
    this.running = true;
    this.stage.controls.enabled = false;
    this.last = null;
    this.heights = null;
    // Where decks lie above streets, the drive stays on its level.
    this.ground = height;
    requestAnimationFrame((now) => this.step(now));
    return true;
  }

  /** Stops and gives the camera back. */
  stop() {
    if (!this.running) return;
    this.running = false;
    this.stage.controls.enabled = true;
    this.stage.moved();
  }

  take(line, points) {
    this.line = line;
    this.points = points;
    this.along = lengths(points);
  }

  step(now) {
    if (!this.running) return;
    // After a pause of the page, the drive continues from the same place.
    const seconds = Math.min((now - (this.last ?? now)) / 1000, 0.25);
    this.last = now;
    this.at += this.speed * seconds;
    const length = this.along[this.along.length - 1];
    if (this.at >= length && !this.goOn(length)) {
      this.stop();
      this.ended();
      return;
    }
    this.look(seconds);
    this.report(now);
    requestAnimationFrame((next) => this.step(next));
  }

  report(now) {
    if (now - (this.reported ?? -Infinity) < REPORT_MS) return;
    this.reported = now;
    const { easting, northing, direction } = placeAt(this.points, this.along, this.at);
    const object = this.stage.objectAt(easting, northing);
    const surface = object?.at(easting, northing);
    const levels = this.stage.levelsAt(easting, northing);
    if (surface) this.passed({ easting, northing, ...surface, drawn: surface.height, kind: "road", object, direction });
    else if (levels.length) this.passed({ ...nearest(levels, this.ground), direction });
  }

  goOn(length) {
    const end = this.points[this.points.length - 1];
    const { direction } = placeAt(this.points, this.along, length);
    const next = continuation(this.lines, this.line, end, direction);
    if (!next) return false;
    this.take(next.line, next.points);
    this.at -= length;
    return true;
  }

  look(seconds) {
    const here = placeAt(this.points, this.along, this.at);
    const there = this.ahead();
    const near = this.stage.heightAt(here.easting, here.northing, this.ground);
    if (near === null) return;
    this.ground = near;
    const far = this.stage.heightAt(...there, near) ?? near;
    // Seams and missing tiles do not shake the camera.
    const share = this.heights ? 1 - Math.exp(-seconds * 6) : 1;
    const before = this.heights ?? [near, far, ...there];
    this.heights = [near, far, ...there].map((value, i) => before[i] + share * (value - before[i]));
    const [eyeHeight, farHeight, east, north] = this.heights;
    const lift = EYE_M / this.stage.look.z;
    this.stage.camera.position.copy(this.stage.toScene(here.easting, here.northing, eyeHeight + lift));
    this.stage.controls.target.copy(this.stage.toScene(east, north, farHeight + lift * 0.6));
    this.stage.camera.lookAt(this.stage.controls.target);
    this.stage.moved();
  }

  ahead() {
    const length = this.along[this.along.length - 1];
    if (this.at + AHEAD_M <= length) {
      const { easting, northing } = placeAt(this.points, this.along, this.at + AHEAD_M);
      return [easting, northing];
    }
    const { easting, northing, direction } = placeAt(this.points, this.along, length);
    const rest = this.at + AHEAD_M - length;
    return [easting + rest * direction[0], northing + rest * direction[1]];
  }
}
