// Which point is under the cursor: the nearest one that lies within a few pixels of the ray.

import { Matrix4, Sphere, Vector3 } from "./vendor.js";

const REACH_PIXELS = 7;

export function pick(view, clouds, x, y) {
  const camera = view.camera;
  const at = { x: (x / view.size.x) * 2 - 1, y: 1 - (y / view.size.y) * 2 };
  const flat = view.isTop;
  const origin = flat ? new Vector3(at.x, at.y, -1).unproject(camera) : camera.position.clone();
  const direction = new Vector3(at.x, at.y, 0.5).unproject(camera);
  if (flat) direction.set(0, 0, -1); else direction.sub(origin).normalize();
  const ratio = view.renderer.getPixelRatio();
  const perPixel = ratio / view.perMetre; // metres of a pixel: per metre of distance, or as such from above
  const wide = REACH_PIXELS * perPixel;
  let best = null;
  for (const cloud of clouds) {
    const hidden = cloud.material.uniforms.hidden.value;
    for (const part of cloud.parts()) {
      const found = nearest(part, origin, direction, wide, perPixel, flat, hidden);
      if (found && (!best || found.score < best.score)) best = { ...found, cloud };
    }
  }
  return best && { ...best, point: best.local.applyMatrix4(best.part.matrixWorld) };
}

function nearest(part, origin, direction, wide, perPixel, flat, hidden) {
  const inverse = new Matrix4().copy(part.matrixWorld).invert();
  const o = origin.clone().applyMatrix4(inverse);
  const d = direction.clone().transformDirection(inverse);
  if (!part.geometry.boundingSphere) part.geometry.computeBoundingSphere();
  const ball = new Sphere().copy(part.geometry.boundingSphere);
  const along = ball.center.clone().sub(o).dot(d);
  const slack = flat ? wide : wide * Math.max(along + ball.radius, 0);
  const off = ball.center.clone().sub(o).addScaledVector(d, -along).length();
  if (off > ball.radius + slack || along < -ball.radius) return null;
  const { position, _classification } = part.geometry.attributes;
  const { array } = position.data ?? position;
  const stride = position.data ? position.data.stride : 3;
  const start = position.data ? position.offset : 0;
  let best = null;
  for (let i = 0, k = start; i < position.count; i++, k += stride) {
    const dx = array[k] - o.x, dy = array[k + 1] - o.y, dz = array[k + 2] - o.z;
    const t = dx * d.x + dy * d.y + dz * d.z;
    if (t <= 0) continue;
    const aside = Math.sqrt(Math.max(dx * dx + dy * dy + dz * dz - t * t, 0));
    const pixels = aside / (flat ? perPixel : perPixel * t);
    if (pixels > REACH_PIXELS) continue;
    if (hidden[_classification.getX(i)]) continue;
    // A pixel aside counts as much as two metres in a hundred further away: the surface in front wins over what is behind.
    const score = flat ? pixels * 0.15 + t * 0.2 : t * (1 + 0.02 * pixels);
    if (!best || score < best.score) best = { score, row: i, part, local: new Vector3(array[k], array[k + 1], array[k + 2]) };
  }
  return best;
}
