// Colours of the surface: by class, photo, height source or error estimate, with hillshading. All colours are sRGB.

import { Color, ColorManagement, DoubleSide, ShaderMaterial, Vector3, Vector4 } from "three";

// Before the first colour is made, so that colours are not converted.
ColorManagement.enabled = false;

export const COLOURS = { class: 0, photo: 1, support: 2, estimate: 3 };
export const SUPPORT_COLOURS = ["#808080", "#4f9d7c", "#e0b04c", "#c8553d"];
export const ESTIMATE_COLOURS = ["#f3efdc", "#eec264", "#d9673c", "#7d1d3f"];
/** The error estimate that has the last colour (m). */
export const ESTIMATE_MOST = 0.3;

const VERTEX = /* glsl */ `
uniform float z;
uniform vec4 box;
varying vec2 onPhoto;
varying vec2 onCells;
varying vec3 up;
varying float away;
void main() {
  onPhoto = uv;
  // x is east and z is south: row 0 of the rasters is in the north.
  onCells = vec2((position.x - box.x) / box.z, (position.z - box.y) / box.w);
  up = normalize(vec3(normal.x, normal.y / z, normal.z));
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  away = -seen.z;
  gl_Position = projectionMatrix * seen;
}`;

const FRAGMENT = /* glsl */ `
uniform int colour;
uniform vec3 own;
uniform bool hasPhoto;
uniform bool hasCells;
uniform bool hasEstimate;
uniform sampler2D photo;
uniform sampler2D support;
uniform sampler2D estimate;
uniform vec3 supports[4];
uniform vec3 estimates[4];
uniform float most;
uniform vec3 light;
uniform vec3 sky;
uniform float far;
varying vec2 onPhoto;
varying vec2 onCells;
varying vec3 up;
varying float away;

vec3 bySupport() {
  int kind = int(texture2D(support, onCells).r * 255.0 + 0.5);
  return kind == 1 ? supports[1] : kind == 2 ? supports[2] : kind == 3 ? supports[3] : supports[0];
}

vec3 byEstimate() {
  float value = texture2D(estimate, onCells).r * 255.0;
  if (value < 0.5) return supports[0];
  float share = clamp((value - 1.0) * 0.002 / most, 0.0, 1.0) * 3.0;
  return share < 1.0 ? mix(estimates[0], estimates[1], share)
    : share < 2.0 ? mix(estimates[1], estimates[2], share - 1.0)
    : mix(estimates[2], estimates[3], share - 2.0);
}

void main() {
  vec3 base = own;
  float strength = 1.5;
  if (colour == 1 && hasPhoto) {
    base = texture2D(photo, onPhoto).rgb;
    strength = 0.6;
  } else if (colour == 2 && hasCells) {
    base = mix(own, bySupport(), 0.8);
  } else if (colour == 3 && hasEstimate) {
    base = mix(own, byEstimate(), 0.85);
  }
  vec3 facing = normalize(gl_FrontFacing ? up : -up);
  float shade = clamp(1.0 + strength * (dot(facing, light) - light.y), 0.35, 1.3);
  float haze = smoothstep(0.55, 1.0, away / far);
  gl_FragColor = vec4(mix(base * shade, sky, haze), 1.0);
}`;

/** The uniforms shared by all tiles. */
export function sharedUniforms() {
  return {
    colour: { value: COLOURS.class },
    z: { value: 1 },
    light: { value: new Vector3(-0.55, 0.66, -0.51).normalize() },
    sky: { value: new Color("#ffffff") },
    far: { value: 1000 },
    supports: { value: SUPPORT_COLOURS.map((text) => new Color(text)) },
    estimates: { value: ESTIMATE_COLOURS.map((text) => new Color(text)) },
    most: { value: ESTIMATE_MOST },
  };
}

/** Returns the material of one class of a tile; box is x and z of the north-west corner, width and depth. */
export function surfaceMaterial(shared, own, box, textures) {
  return new ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    side: DoubleSide,
    // So wires and lines on the surface are in front of it.
    polygonOffset: true,
    polygonOffsetFactor: 1,
    polygonOffsetUnits: 1,
    uniforms: {
      ...shared,
      own: { value: new Color(own) },
      box: { value: new Vector4(...box) },
      photo: { value: textures.photo },
      support: { value: textures.support },
      estimate: { value: textures.estimate },
      hasPhoto: { value: Boolean(textures.photo) },
      hasCells: { value: Boolean(textures.support) },
      hasEstimate: { value: Boolean(textures.estimate) },
    },
  });
}
