// One tile in the 3D scene: its surface, wires and scan points, and values of the surface at a place.

import {
  BufferAttribute,
  BufferGeometry,
  ClampToEdgeWrapping,
  Color,
  DataTexture,
  Group,
  LinearFilter,
  LinearMipmapLinearFilter,
  Mesh,
  MeshBasicMaterial,
  NearestFilter,
  Points,
  PointsMaterial,
  RedFormat,
  Texture,
  UnsignedByteType,
} from "three";

import { surfaceMaterial } from "./material.js";
import { bilinear, centre, nearest, stepAt } from "./raster.js";
import { contains } from "./run.js";

export const OWN = { road: "#565b66", terrain: "#c6bea9" };
/** Colours of scan points by their least height above the surface (m). */
export const POINTS = [
  { above: 0.5, colour: "#d1495b", label: "0.5 m or more above the surface" },
  { above: 0.15, colour: "#edae49", label: "0.15 to 0.5 m above" },
  { above: -0.15, colour: "#7d97a6", label: "within 0.15 m" },
  { above: -Infinity, colour: "#3d5a98", label: "below" },
];

export class TileObject {
  /** Makes the objects of unpacked data; the origin is the run's. */
  constructor(data, origin, shared) {
    this.tile = data.tile;
    this.data = data;
    this.origin = origin;
    this.group = new Group();
    this.textures = {
      photo: data.photo && photoTexture(data.photo),
      support: data.support && cellTexture(data.grid, data.support, NearestFilter),
      estimate: data.estimate && cellTexture(data.grid, data.estimate, NearestFilter),
    };
    this.meshes = {};
    this.wires = {};
    for (const [name, part] of Object.entries(data.parts)) this.addPart(name, part, shared);
  }

  addPart(name, part, shared) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(part.positions, 3));
    geometry.setAttribute("normal", new BufferAttribute(part.normals, 3));
    geometry.setAttribute("uv", new BufferAttribute(part.uvs ?? new Float32Array((part.positions.length / 3) * 2), 2));
    geometry.setIndex(new BufferAttribute(part.indices, 1));
    const { west, north, cell, rows, cols } = this.data.grid;
    const [x, , z] = part.translation;
    const box = [west - this.origin[0] - x, this.origin[1] - north - z, cols * cell, rows * cell];
    const mesh = new Mesh(geometry, surfaceMaterial(shared, OWN[part.kind] ?? OWN.terrain, box, this.textures));
    mesh.position.set(...part.translation);
    mesh.name = part.kind;
    mesh.userData = { owner: this, level: part.level };
    const wire = new Mesh(
      geometry,
      new MeshBasicMaterial({ wireframe: true, color: 0x10222c, transparent: true, opacity: 0.35, depthWrite: false }),
    );
    wire.position.copy(mesh.position);
    wire.visible = false;
    this.meshes[name] = mesh;
    this.wires[name] = wire;
    this.group.add(mesh, wire);
  }

  /** Shows the selected parts and layers. */
  apply({ road, terrain, levels, wire, points }) {
    const wanted = { road, terrain };
    for (const [name, { kind, level }] of Object.entries(this.data.parts)) {
      this.meshes[name].visible = (wanted[kind] ?? true) && (levels || level === 0);
      this.wires[name].visible = wire && this.meshes[name].visible;
    }
    if (points && !this.points) this.points = this.scanPoints();
    if (this.points) this.points.visible = points;
  }

  /** The numbers of its levels: 0, decks and tunnels. */
  get levels() {
    return [...new Set(Object.values(this.data.parts).map(({ level }) => level))];
  }

  /** Returns the meshes of a level. */
  meshesOf(level) {
    return Object.values(this.meshes).filter((mesh) => mesh.userData.level === level);
  }

  /** Returns height (m) and slopes of the surface at a place; null beside the tile. */
  at(easting, northing) {
    if (!contains(this.tile, easting, northing)) return null;
    const { surface, steps } = this.data;
    if (!surface) return null;
    const found = surface(easting, northing);
    return steps ? { ...found, height: found.height + stepAt(steps, easting, northing) } : found;
  }

  /** Returns the values of the rasters at a place: scan and terrain model (m), height source, error estimate (m). */
  cellsAt(easting, northing) {
    const { dsm, dtm, support, estimateAt, grid } = this.data;
    return {
      dsm: dsm ? bilinear(dsm, easting, northing) : NaN,
      dtm: dtm ? bilinear(dtm, easting, northing) : NaN,
      support: support ? nearest({ grid, at: (index) => support[index] }, easting, northing) : 0,
      estimate: estimateAt ? nearest(estimateAt, easting, northing) : NaN,
    };
  }

  /** The lowest height of the mesh (m). */
  get low() {
    let low = Infinity;
    for (const { positions, translation } of Object.values(this.data.parts)) {
      for (let i = 1; i < positions.length; i += 3) low = Math.min(low, positions[i] + translation[1]);
    }
    return low;
  }

  /** The number of triangles. */
  get triangles() {
    return Object.values(this.data.parts).reduce((sum, part) => sum + part.indices.length / 3, 0);
  }

  /** Frees the memory of the graphics card. */
  dispose() {
    for (const texture of Object.values(this.textures)) texture?.dispose();
    this.data.photo?.close();
    this.group.traverse((object) => {
      object.geometry?.dispose();
      object.material?.dispose();
    });
  }

  scanPoints() {
    const { dsm, grid } = this.data;
    const geometry = new BufferGeometry();
    const [x0, z0] = [this.tile.west, this.tile.south];
    const base = this.low;
    const [places, colours] = [[], []];
    for (let index = 0; dsm && index < grid.rows * grid.cols; index++) {
      const height = dsm.at(index);
      if (Number.isNaN(height)) continue;
      const [easting, northing] = centre(grid, index);
      places.push(easting - x0, height - base, z0 - northing);
      const surface = this.data.top?.at(index) ?? this.at(easting, northing)?.height ?? height;
      colours.push(...pointColour(height - surface));
    }
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
    const points = new Points(
      geometry,
      new PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true, toneMapped: false }),
    );
    points.position.set(x0 - this.origin[0], base, this.origin[1] - z0);
    this.group.add(points);
    return points;
  }
}

const RGB = POINTS.map(({ above, colour }) => [above, new Color(colour).toArray()]);

function pointColour(off) {
  return RGB.find(([above]) => off >= above)[1];
}

function photoTexture(image) {
  const texture = new Texture(image);
  texture.flipY = false;
  texture.wrapS = texture.wrapT = ClampToEdgeWrapping;
  texture.minFilter = LinearMipmapLinearFilter;
  texture.magFilter = LinearFilter;
  texture.anisotropy = 8;
  texture.needsUpdate = true;
  return texture;
}

function cellTexture({ rows, cols }, values, filter) {
  const texture = new DataTexture(values, cols, rows, RedFormat, UnsignedByteType);
  texture.unpackAlignment = 1;
  texture.minFilter = texture.magFilter = filter;
  texture.needsUpdate = true;
  return texture;
}
