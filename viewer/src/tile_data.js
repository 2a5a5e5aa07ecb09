// The data of a tile's script, unpacked: mesh, photo, surface, rasters, road lines.

import { readGlb } from "./glb.js";
import { lengths } from "./lines.js";
import { heights } from "./raster.js";
import { spline } from "./spline.js";
import { bytesOf, doubles, inflated } from "./unpack.js";

const NO_ESTIMATE = 0;
/** Step of the error estimate in its raster (m). */
export const ESTIMATE_STEP = 0.002;

/** Returns the unpacked data of a tile. */
export async function unpacked(tile, data) {
  const { parts, image, mime } = readGlb(await inflated(data.glb));
  const grid = data.grid;
  const raster = async (packed, cells = grid) => packed && heights(cells, packed.low, packed.step, await inflated(packed.data));
  const cells = async (text) => text && (await inflated(text));
  const estimate = await cells(data.estimate);
  return {
    tile,
    parts,
    photo: image && (await bitmap(image, mime)),
    grid,
    dsm: await raster(data.dsm),
    dtm: await raster(data.dtm),
    support: await cells(data.support),
    estimate,
    estimateAt: estimate && {
      grid,
      at: (index) => (estimate[index] === NO_ESTIMATE ? NaN : (estimate[index] - 1) * ESTIMATE_STEP),
    },
    top: await raster(data.top),
    surface: data.surface && spline(numbers(data.surface)),
    steps: await raster(data.steps, data.steps?.grid),
    corners: data.corners,
    lines: data.lines.map(({ name, points }) => line(tile, name, points)),
  };
}

function bitmap(bytes, type) {
  // glTF's texture coordinates start at the top, like the rows of the image.
  return createImageBitmap(new Blob([bytes], { type }), { imageOrientation: "none", premultiplyAlpha: "none" });
}

function numbers(packed) {
  const array = (text) => text && doubles(bytesOf(text));
  const { degree, bounds, datum } = packed;
  return {
    degree,
    bounds,
    datum,
    knotsU: array(packed.knots_u),
    knotsV: array(packed.knots_v),
    A: array(packed.A),
    W: array(packed.W),
  };
}

function line(tile, name, flat) {
  const points = [];
  for (let i = 0; i < flat.length; i += 2) points.push([tile.west + flat[i], tile.south + flat[i + 1]]);
  return { name, points, along: lengths(points) };
}
