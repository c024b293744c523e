// A cloud that is streamed by level of detail, and the material that colours its points.

import { ShaderMaterial, TilesRenderer, Vector2 } from "./vendor.js";
import { RAMPS, classTable, ramp, sessionTable } from "./palette.js";

export const MODES = ["height", "intensity", "class", "session", "camera"];
export const modesOf = (map) => MODES.filter((mode) => mode !== "camera" || map.coloured);

const VERTEX = `
attribute float _intensity;
attribute float _classification;
attribute float _session;
attribute vec3 _normal;
attribute vec4 color;
uniform int mode;
uniform vec2 heights, intensities;
uniform sampler2D heightRamp, intensityRamp, classes, sessions;
uniform float pixels, metres, perMetre, shading;
uniform bool hidden[16];
varying vec3 colour;

float within(vec2 range, float value) { return clamp((value - range.x) / (range.y - range.x), 0.0, 1.0); }

void main() {
  vec4 world = modelMatrix * vec4(position, 1.0);
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  float bright = sqrt(within(intensities, _intensity));
  int number = int(_classification + 0.5);
  if (mode == 0) colour = texture2D(heightRamp, vec2(within(heights, world.z), 0.5)).rgb * (0.62 + 0.38 * bright);
  else if (mode == 1) colour = texture2D(intensityRamp, vec2(bright, 0.5)).rgb;
  else if (mode == 2) colour = texture2D(classes, vec2((_classification + 0.5) / 256.0, 0.5)).rgb * (0.7 + 0.3 * bright);
  else if (mode == 4) colour = color.rgb;
  else colour = texture2D(sessions, vec2((mod(_session, 256.0) + 0.5) / 256.0, 0.5)).rgb * (0.7 + 0.3 * bright);
  float flat_ = dot(_normal, _normal);
  if (flat_ > 0.25 && mode != 4) colour *= 1.0 - shading * 0.35 * (1.0 - abs(dot(_normal * inversesqrt(flat_), vec3(0.41, 0.25, 0.88))));
  // As large as a voxel when near, no smaller than a few pixels when far.
  float near = projectionMatrix[3][3] == 1.0 ? metres * perMetre : metres * perMetre / max(-seen.z, 0.01);
  gl_PointSize = clamp(near, pixels, 24.0 + pixels);
  if (number < 16 && hidden[number]) gl_Position = vec4(2.0, 2.0, 2.0, 0.0);
}`;

const FRAGMENT = `
varying vec3 colour;
uniform bool round_;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (round_ && dot(off, off) > 0.25) discard;
  gl_FragColor = vec4(colour, 1.0);
}`;

export function pointMaterial(map) {
  return new ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms: {
      mode: { value: 0 },
      heights: { value: new Vector2(...map.height_m) },
      intensities: { value: new Vector2(0, map.intensity[1]) },
      heightRamp: { value: ramp(RAMPS.height) },
      intensityRamp: { value: ramp(RAMPS.intensity) },
      classes: { value: classTable() },
      sessions: { value: sessionTable() },
      pixels: { value: 2 },
      metres: { value: map.voxel_size_m },
      perMetre: { value: 1 },
      shading: { value: 1 },
      hidden: { value: new Array(16).fill(false) },
      round_: { value: true },
    },
  });
}

export class Cloud {
  // `base` is where its tileset stands; `changed` is called when another picture is due, `true` when it may wait a little.
  constructor(base, material, changed) {
    this.base = base;
    this.material = material;
    this.loaded = 0;
    this.wanted = 1.2;
    this.failed = 0;
    this.tiles = new TilesRenderer(`${base}tileset.json`);
    this.tiles.errorTarget = this.wanted;
    this.tiles.downloadQueue.maxJobsPerOrigin = 6;
    this.tiles.parseQueue.maxJobs = 24;
    this.tiles.addEventListener("load-model", ({ scene, url }) => {
      scene.traverse((part) => {
        if (!part.isPoints) return;
        part.material = material;
        part.userData.node = nodeOf(base, url);
        this.loaded += part.geometry.attributes.position.count;
      });
      changed(true);
    });
    this.tiles.addEventListener("dispose-model", ({ scene }) => {
      scene.traverse((part) => { if (part.isPoints) this.loaded -= part.geometry.attributes.position.count; });
    });
    this.tiles.addEventListener("load-error", () => { this.failed++; });
    for (const event of ["needs-update", "tile-visibility-change", "tiles-load-end"]) this.tiles.addEventListener(event, () => changed(true));
  }

  get group() { return this.tiles.group; }

  // Points in the picture.
  get shown() {
    let sum = 0;
    for (const part of this.parts()) sum += part.geometry.attributes.position.count;
    return sum;
  }

  get busy() {
    const { queued, downloading, parsing } = this.tiles.stats;
    return !this.tiles.root || queued + downloading + parsing > 0;
  }

  // The pieces in the picture.
  *parts() {
    if (!this.group.visible) return;
    for (const scene of this.group.children) {
      const stack = [scene];
      while (stack.length) {
        const part = stack.pop();
        if (part.isPoints) yield part;
        stack.push(...part.children);
      }
    }
  }

  update(camera, renderer, budget) {
    if (!this.group.visible) return;
    for (const known of [...this.tiles.cameras]) if (known !== camera) this.tiles.deleteCamera(known);
    this.tiles.setCamera(camera);
    this.tiles.setResolutionFromRenderer(camera, renderer);
    this.tiles.lruCache.maxBytesSize = Math.max(budget * 64, 2 ** 28);
    this.tiles.lruCache.minBytesSize = this.tiles.lruCache.maxBytesSize * 0.75;
    this.spend(budget);
    this.tiles.update();
  }

  // Coarser when more is shown than the budget allows, finer again when there is room.
  spend(budget) {
    const shown = this.shown;
    const now = this.tiles.errorTarget;
    if (shown > budget) this.tiles.errorTarget = Math.min(Math.max(now, 0.5) * 1.08, 400);
    else if (now > this.wanted && shown < 0.7 * budget && !this.busy) this.tiles.errorTarget = Math.max(now / 1.05, this.wanted);
  }

  everything() {
    this.wanted = 0;
    this.tiles.errorTarget = 0;
  }
}

function nodeOf(base, url) {
  const path = new URL(url, location.href).pathname;
  return decodeURIComponent(path.slice(path.indexOf(base) + base.length)).replace(/\.glb$/, "");
}
