// The camera, and where a ray through a pixel meets the mesh.

import { add, clamp, cross, dot, unit } from "./common.js";

export class Camera {
  constructor(scene) {
    const offset = add(scene.eye, scene.target, -1);
    this.target = [...scene.target];
    this.distance = Math.hypot(...offset);
    this.azimuth = Math.atan2(offset[0], offset[2]);
    this.elevation = Math.asin(clamp(offset[1] / this.distance, -1, 1));
    this.angle = scene.field_of_view;
    this.radius = scene.radius;
  }
  get back() {
    const c = Math.cos(this.elevation);
    return [Math.sin(this.azimuth) * c, Math.sin(this.elevation), Math.cos(this.azimuth) * c];
  }
  get eye() { return add(this.target, this.back, this.distance); }
  get axes() { const z = this.back, x = unit(cross([0, 1, 0], z)); return [x, cross(z, x), z]; }
  orbit(dx, dy) {
    this.azimuth -= dx;
    this.elevation = clamp(this.elevation + dy, -1.55, 1.55);
  }
  pan(dx, dy) {
    const [x, y] = this.axes, step = 2 * this.distance * Math.tan(this.angle / 2);
    this.target = add(add(this.target, x, -dx * step), y, dy * step);
  }
  zoom(factor) { this.distance = clamp(this.distance * factor, 1e-3 * this.radius, 1e3 * this.radius); }
  ray(aspect) { // columns: to the right, up and forward, for coordinates from -1 to 1
    const [x, y, z] = this.axes, t = Math.tan(this.angle / 2);
    return [...x.map((v) => v * t * aspect), ...y.map((v) => v * t), ...z.map((v) => -v)];
  }
  matrix(aspect, center) {
    const [x, y, z] = this.axes, e = this.eye, f = 1 / Math.tan(this.angle / 2);
    const away = Math.hypot(...add(e, center, -1)), far = away + 2 * this.radius;
    const near = Math.max(away - 2 * this.radius, this.distance / 100, far / 1e5);
    const a = (far + near) / (near - far), b = (2 * far * near) / (near - far), rows = [x, y, z];
    const scale = [f / aspect, f, a], result = new Float32Array(16);
    for (let i = 0; i < 3; i++) {
      for (let j = 0; j < 3; j++) result[4 * i + j] = rows[j][i] * scale[j];
      result[4 * i + 3] = -z[i];
    }
    for (let j = 0; j < 3; j++) result[12 + j] = -dot(rows[j], e) * scale[j] + (j === 2 ? b : 0);
    result[15] = dot(z, e);
    return result;
  }
}

// Where a ray meets the mesh first: the distance, or infinity.
export function meet(origin, way, position, face) {
  let nearest = Infinity;
  for (let i = 0; i < face.length; i += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => position.subarray(3 * face[i + k], 3 * face[i + k] + 3));
    const e1 = [b[0] - a[0], b[1] - a[1], b[2] - a[2]], e2 = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
    const p = cross(way, e2), det = dot(e1, p);
    if (det === 0) continue;
    const s = [origin[0] - a[0], origin[1] - a[1], origin[2] - a[2]], u = dot(s, p) / det;
    if (u < 0 || u > 1) continue;
    const q = cross(s, e1), v = dot(way, q) / det, t = dot(e2, q) / det;
    if (v >= 0 && u + v <= 1 && t > 0 && t < nearest) nearest = t;
  }
  return nearest;
}
