// The camera.

import { add, clamp, cross, dot, unit } from "./common.js";

export class Camera {
  constructor(scene) {
    this.radius = scene.radius;
    this.restore(scene.eye, scene.target, scene.field_of_view);
  }
  restore(eye, target, angle) {
    const offset = add(eye, target, -1);
    this.target = [...target];
    this.distance = Math.hypot(...offset);
    this.azimuth = Math.atan2(offset[0], offset[2]);
    this.elevation = Math.asin(clamp(offset[1] / this.distance, -1, 1));
    this.angle = angle;
  }
  get back() {
    const c = Math.cos(this.elevation);
    return [Math.sin(this.azimuth) * c, Math.sin(this.elevation), Math.cos(this.azimuth) * c];
  }
  get eye() {
    return add(this.target, this.back, this.distance);
  }
  get axes() {
    const z = this.back;
    const x = unit(cross([0, 1, 0], z));
    return [x, cross(z, x), z];
  }
  orbit(dx, dy) {
    this.azimuth -= dx;
    this.elevation = clamp(this.elevation + dy, -1.55, 1.55);
  }
  // The same camera, gone around the target by an angle.
  around(angle) {
    const result = Object.assign(Object.create(Camera.prototype), this);
    result.azimuth += angle;
    return result;
  }
  pan(dx, dy) {
    // of the height of the picture
    const [x, y] = this.axes;
    const step = 2 * this.distance * Math.tan(this.angle / 2);
    this.target = add(add(this.target, x, -dx * step), y, dy * step);
  }
  // What is seen at a place, to the right and down from the middle in heights of the picture, stays there, as far
  // away as the target.
  zoom(factor, [x, y] = [0, 0]) {
    const before = this.distance;
    this.distance = clamp(before * factor, 1e-3 * this.radius, 1e3 * this.radius);
    const share = 1 - before / this.distance;
    this.pan(x * share, y * share);
  }
  // Another angle of view, at the distance at which the target is as large as before.
  widen(angle) {
    this.distance *= Math.tan(this.angle / 2) / Math.tan(angle / 2);
    this.angle = angle;
  }
  // Looks at a box from where it looks now, so that a sphere around it fills the picture.
  frame(low, high, aspect) {
    this.target = add(low, high).map((x) => x / 2);
    const half = Math.min(this.angle / 2, Math.atan(aspect * Math.tan(this.angle / 2)));
    const distance = Math.hypot(...add(high, low, -1)) / 2 / Math.sin(half);
    this.distance = clamp(distance, 1e-3 * this.radius, 1e3 * this.radius);
  }
  ray(aspect) {
    // columns: to the right, up and forward, for coordinates from -1 to 1
    const [x, y, z] = this.axes;
    const t = Math.tan(this.angle / 2);
    return [...x.map((v) => v * t * aspect), ...y.map((v) => v * t), ...z.map((v) => -v)];
  }
  matrix(aspect, center) {
    const [x, y, z] = this.axes;
    const e = this.eye;
    const f = 1 / Math.tan(this.angle / 2);
    const away = Math.hypot(...add(e, center, -1));
    const far = away + 2 * this.radius;
    const near = Math.max(away - 2 * this.radius, this.distance / 100, far / 1e5);
    const a = (far + near) / (near - far);
    const b = (2 * far * near) / (near - far);
    const rows = [x, y, z];
    const scale = [f / aspect, f, a];
    const result = new Float32Array(16);
    for (let i = 0; i < 3; i++) {
      for (let j = 0; j < 3; j++) result[4 * i + j] = rows[j][i] * scale[j];
      result[4 * i + 3] = -z[i];
    }
    for (let j = 0; j < 3; j++) result[12 + j] = -dot(rows[j], e) * scale[j] + (j === 2 ? b : 0);
    result[15] = dot(z, e);
    return result;
  }
}
