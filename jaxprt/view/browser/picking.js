// What is under the pointer, and all of a part.

import { add, unit } from "./common.js";

export class Picking {
  /** @param {import("./viewer.js").Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    this.opened = ""; // the name of the part that was picked last
  }
  // What is seen at a place of the picture, from -1 to 1: the point, and the part that it belongs to.
  at(x, y) {
    const { camera, canvas, scene } = this.viewer;
    const ray = camera.ray(canvas.clientWidth / canvas.clientHeight);
    const way = unit([0, 1, 2].map((i) => ray[i] * x + ray[3 + i] * y + ray[6 + i]));
    const { distance, triangle } = meet(camera.eye, way, scene.position, scene.face);
    if (triangle < 0) return null;
    let vertex = scene.face[3 * triangle];
    const part = scene.parts.find(({ vertices }) => (vertex -= vertices) < 0);
    return { point: add(camera.eye, way, distance), part };
  }
  pick(x, y) {
    const { controls, view } = this.viewer;
    const part = this.at(x, y)?.part;
    this.opened = part?.name ?? "";
    if (!part) return;
    if (controls.pick(part.name)) view.unfold();
    this.viewer.tell(part.free ? "" : `the material of ${part.name} cannot change here`);
  }
  lookAt(x, y) {
    const { camera, controls } = this.viewer;
    const hit = this.at(x, y);
    if (!hit) return;
    this.opened = hit.part?.name ?? "";
    if (hit.part?.free) controls.pick(hit.part.name);
    camera.target = hit.point;
    this.viewer.moved();
  }
  // Shows all of the part that was picked last, or of the scene.
  frame() {
    const { camera, canvas, scene } = this.viewer;
    if (!scene) return;
    const low = [Infinity, Infinity, Infinity];
    const high = low.map((x) => -x);
    const place = scene.parts.findIndex(({ name }) => name === this.opened);
    const before = scene.parts.slice(0, Math.max(place, 0)).reduce((total, { vertices }) => total + vertices, 0);
    const count = scene.parts[place]?.vertices ?? scene.position.length / 3;
    for (let i = 3 * before; i < 3 * (before + count); i++) {
      low[i % 3] = Math.min(low[i % 3], scene.position[i]);
      high[i % 3] = Math.max(high[i % 3], scene.position[i]);
    }
    camera.frame(low, high, canvas.clientWidth / (canvas.clientHeight || 1));
    this.viewer.moved();
  }
}

// Where a ray meets the mesh first: the distance, or infinity, and the number of the triangle.
function meet(origin, way, position, face) {
  let nearest = Infinity;
  let triangle = -1;
  const [dx, dy, dz] = way;
  for (let i = 0; i < face.length; i += 3) {
    const a = 3 * face[i];
    const b = 3 * face[i + 1];
    const c = 3 * face[i + 2];
    const ax = position[a];
    const ay = position[a + 1];
    const az = position[a + 2];
    const ex = position[b] - ax;
    const ey = position[b + 1] - ay;
    const ez = position[b + 2] - az;
    const fx = position[c] - ax;
    const fy = position[c + 1] - ay;
    const fz = position[c + 2] - az;
    const px = dy * fz - dz * fy;
    const py = dz * fx - dx * fz;
    const pz = dx * fy - dy * fx;
    const det = ex * px + ey * py + ez * pz;
    if (det === 0) continue;
    const sx = origin[0] - ax;
    const sy = origin[1] - ay;
    const sz = origin[2] - az;
    const u = (sx * px + sy * py + sz * pz) / det;
    if (u < 0 || u > 1) continue;
    const qx = sy * ez - sz * ey;
    const qy = sz * ex - sx * ez;
    const qz = sx * ey - sy * ex;
    const v = (dx * qx + dy * qy + dz * qz) / det;
    const t = (fx * qx + fy * qy + fz * qz) / det;
    if (v >= 0 && u + v <= 1 && t > 0 && t < nearest) [nearest, triangle] = [t, i / 3];
  }
  return { distance: nearest, triangle };
}
