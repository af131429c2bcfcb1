// Cubemaps of lights: texels, mip maps, blurring, and files.

import { dot } from "./common.js";

export const toHalf = (() => {
  const float = new Float32Array(1);
  const bits = new Uint32Array(float.buffer);
  return (value) => {
    float[0] = Math.min(Math.max(value, -65504), 65504);
    const x = bits[0];
    const sign = (x >>> 16) & 0x8000;
    const exponent = ((x >>> 23) & 255) - 112;
    if (exponent <= 0)
      return sign | (exponent < -10 ? 0 : (((x & 0x7fffff) | 0x800000) + (1 << (13 - exponent))) >> (14 - exponent));
    return sign | ((exponent << 10) + ((x & 0x7fffff) >> 13) + ((x >> 12) & 1));
  };
})();

// Directions and solid angles of the texels of cubemaps.
export const SIDES = [
  [
    [0, 0, -1],
    [0, -1, 0],
    [1, 0, 0],
  ],
  [
    [0, 0, 1],
    [0, -1, 0],
    [-1, 0, 0],
  ],
  [
    [1, 0, 0],
    [0, 0, 1],
    [0, 1, 0],
  ],
  [
    [1, 0, 0],
    [0, 0, -1],
    [0, -1, 0],
  ],
  [
    [1, 0, 0],
    [0, -1, 0],
    [0, 0, 1],
  ],
  [
    [-1, 0, 0],
    [0, -1, 0],
    [0, 0, -1],
  ],
];
const grids = new Map();
export function grid(edge) {
  if (grids.has(edge)) return grids.get(edge);
  const way = new Float32Array(18 * edge * edge);
  const area = new Float32Array(6 * edge * edge);
  const corner = (s, t) => Math.atan2(s * t, Math.sqrt(1 + s * s + t * t));
  const step = 2 / edge;
  for (let face = 0, i = 0; face < 6; face++)
    for (let row = 0; row < edge; row++)
      for (let column = 0; column < edge; column++, i++) {
        const s = (column + 0.5) * step - 1;
        const t = (row + 0.5) * step - 1;
        const length = Math.sqrt(1 + s * s + t * t);
        for (let c = 0; c < 3; c++)
          way[3 * i + c] = (s * SIDES[face][0][c] + t * SIDES[face][1][c] + SIDES[face][2][c]) / length;
        const [u, v, s1, t1] = [s - step / 2, t - step / 2, s + step / 2, t + step / 2];
        area[i] = corner(s1, t1) - corner(u, t1) - corner(s1, v) + corner(u, v);
      }
  grids.set(edge, { way, area });
  return { way, area };
}
// The texel that a part of one lies in, where each has `parts` x `parts`.
export const whole = (i, edge, parts) => {
  const m = edge * parts;
  const row = Math.floor(i / m);
  return Math.floor(row / parts) * edge + Math.floor((i % m) / parts);
};

// A light at half the resolution: means over the sphere.
export function halved(light, edge) {
  const { area } = grid(edge);
  const half = edge / 2;
  const result = new Float32Array(18 * half * half);
  const total = grid(half).area;
  for (let face = 0; face < 6; face++)
    for (let row = 0; row < edge; row++)
      for (let column = 0; column < edge; column++) {
        const from = (face * edge + row) * edge + column;
        const to = (face * half + (row >> 1)) * half + (column >> 1);
        for (let c = 0; c < 3; c++) result[3 * to + c] += (light[3 * from + c] * area[from]) / total[to];
      }
  return result;
}

// Faces with a rim of their neighbours' texels; the corners are means of the three that meet.
export function rimmed(light, edge, index, result, start) {
  const m = edge + 2;
  const outer = [0, m - 1];
  const inner = [1, m - 2];
  for (let i = 0; i < 6 * m * m; i++) for (let c = 0; c < 3; c++) result[4 * (start + i) + c] = light[3 * index[i] + c];
  for (let face = 0; face < 6; face++)
    for (let p = 0; p < 2; p++)
      for (let q = 0; q < 2; q++)
        for (let c = 0; c < 3; c++) {
          const from = (row, column) => result[4 * (start + (face * m + row) * m + column) + c];
          result[4 * (start + (face * m + outer[p]) * m + outer[q]) + c] =
            (from(inner[p], inner[q]) + from(inner[p], outer[q]) + from(outer[p], inner[q])) / 3;
        }
}

// Blurs a light to all widths, as `jaxprt.lobe.prefilter` does; which texels each takes, and how much, is found once,
// for a quarter of the first face: all others take those that lie to them as these do to it.
const blurs = new Map();
export class Blur {
  static of(scale, index) {
    const key = JSON.stringify(scale);
    if (!blurs.has(key)) blurs.set(key, new Blur(scale, index));
    return blurs.get(key);
  }
  constructor(scale, index) {
    this.scale = scale;
    this.index = index;
    this.quarters = new Map(scale.sources.map((edge) => [edge, quarters(edge)]));
    this.levels = scale.edges.map((edge, i) =>
      i ? this.taps(edge, scale.sources[i], scale.concentrations[i], scale.reaches[i]) : null,
    );
  }
  taps(edge, source, concentration, reach) {
    const to = grid(edge).way;
    const { way, area } = grid(source);
    const least = Math.cos(reach);
    const from = [0];
    const index = [];
    const weight = [];
    // Blocks of texels out of reach are left out: of the directions of blocks, none is further from their texels than `wide`.
    const parts = Math.min(4, source);
    const blocks = grid(source / parts).way;
    const wide = reach + (1.5 * parts) / source;
    const nearest = wide < Math.PI ? Math.cos(wide) : -1;
    const members = Array.from({ length: blocks.length / 3 }, () => []);
    const near = (a, i, b, j) => a[3 * i] * b[3 * j] + a[3 * i + 1] * b[3 * j + 1] + a[3 * i + 2] * b[3 * j + 2];
    area.forEach((_, j) => members[whole(j, source / parts, parts)].push(j));
    for (let n = 0; n < (edge * edge) / 4; n++) {
      const i = 2 * n - (n % (edge / 2));
      let total = 0;
      for (let block = 0; block < members.length; block++) {
        if (near(to, i, blocks, block) < nearest) continue;
        for (const j of members[block]) {
          const cosine = near(to, i, way, j);
          if (cosine < least) continue;
          const share = area[j] * Math.exp(concentration * (cosine - 1));
          index.push(j);
          weight.push(share);
          total += share;
        }
      }
      for (let k = from[n]; k < index.length; k++) weight[k] /= total;
      from.push(index.length);
    }
    return { from: Uint32Array.from(from), index: Uint16Array.from(index), weight: Float32Array.from(weight) };
  }
  apply(mips) {
    const { edges, starts, sources, total } = this.scale;
    const result = new Float32Array(4 * total);
    edges.forEach((edge, n) => {
      let value = mips.get(edge);
      if (n) {
        const { from, index, weight } = this.levels[n];
        const source = mips.get(sources[n]);
        value = new Float32Array(18 * edge * edge);
        const half = edge / 2;
        for (const { face, right, down, texel } of this.quarters.get(sources[n]))
          for (let i = 0; i < half * half; i++) {
            const row = Math.floor(i / half);
            const column = i % half;
            const to = (face * edge + (down ? edge - 1 - row : row)) * edge + (right ? edge - 1 - column : column);
            let [r, g, b] = [0, 0, 0];
            for (let k = from[i]; k < from[i + 1]; k++) {
              const j = 3 * texel[index[k]];
              r += weight[k] * source[j];
              g += weight[k] * source[j + 1];
              b += weight[k] * source[j + 2];
            }
            value.set([r, g, b], 3 * to);
          }
      }
      rimmed(value, edge, this.index.get(edge), result, starts[n]);
    });
    return result;
  }
}

// For each quarter of each face, the texels that lie to it as all texels do to the first quarter of the first face. Within
// a face they follow one another in steps.
function quarters(edge) {
  const { way } = grid(edge);
  const place = (x) => Math.floor(((x + 1) / 2) * edge);
  const turned = (i, face, right, down) => {
    const [s, t, n] = SIDES[0].map((axis) => dot(axis, way.subarray(3 * i, 3 * i + 3)));
    const [S, T, N] = SIDES[face];
    const d = N.map((x, c) => n * x + (right ? -s : s) * S[c] + (down ? -t : t) * T[c]);
    const forward = d.reduce((a, x, c) => (Math.abs(x) > Math.abs(d[a]) ? c : a), 0);
    const to = 2 * forward + (d[forward] < 0 ? 1 : 0);
    const [u, v, w] = SIDES[to].map((axis) => dot(axis, d));
    return (to * edge + place(v / w)) * edge + place(u / w);
  };
  return SIDES.flatMap((_, face) =>
    [0, 1, 2, 3].map((quarter) => {
      const [right, down] = [quarter & 1, quarter >> 1];
      const texel = new Uint16Array(6 * edge * edge);
      for (let start = 0; start < texel.length; start += edge * edge) {
        const [first, next, below] = [start, start + 1, start + edge].map((i) => turned(i, face, right, down));
        for (let row = 0, i = start; row < edge; row++)
          for (let column = 0; column < edge; column++)
            texel[i++] = first + column * (next - first) + row * (below - first);
      }
      return { face, right, down, texel };
    }),
  );
}

// Radiance HDR: lines of RGBE, plain or by runs of either kind, from the top left. Pixels divided by the exposures
// are radiance.
export function readHdr(data) {
  const text = new TextDecoder("latin1").decode(data.subarray(0, 4096));
  const size = /\n\s*\n?-Y (\d+) \+X (\d+)\n/.exec(text);
  if (!text.startsWith("#?") || !size || !text.includes("32-bit_rle_rgbe"))
    throw new Error("must be a Radiance HDR environment with its first line on top (EXR files need Python)");
  const height = Number(size[1]);
  const width = Number(size[2]);
  if (width !== 2 * height) throw new Error(`must be twice as wide as high, got ${width} x ${height} pixels`);
  const head = text.slice(0, size.index);
  const factor = [1, 1, 1];
  if (/^PRIMARIES=/m.test(head))
    throw new Error("must have the primaries of Rec. 709 and not state others, which need Python");
  for (const [, value] of head.matchAll(/^(?:EXPOSURE|COLORCORR)=(.*)$/gm)) {
    const number = value.trim().split(/\s+/).map(Number);
    for (let c = 0; c < 3; c++) factor[c] /= number[number.length > 1 ? c : 0];
  }
  if (!factor.every((value) => value > 0 && value < Infinity))
    throw new Error("must have positive exposures, got others");
  if (width * height > 2 ** 26) throw new Error(`must have at most ${2 ** 26} pixels, got ${width} x ${height}`);
  const pixel = new Float32Array(3 * width * height);
  const line = new Uint8Array(4 * width);
  let place = size.index + size[0].length;
  for (let y = 0; y < height; y++) {
    if (width >= 8 && width < 32768 && data[place] === 2 && data[place + 1] === 2 && data[place + 2] < 128) {
      place += 4;
      for (let c = 0; c < 4; c++)
        for (let x = 0; x < width; ) {
          const count = data[place++];
          const run = count > 128;
          const length = run ? count - 128 : count;
          if (!length || x + length > width || place >= data.length)
            throw new Error("must be a whole Radiance HDR file, got a damaged one");
          for (let k = 0; k < length; k++, x++) line[4 * x + c] = run ? data[place] : data[place + k];
          place += run ? 1 : length;
        }
    } else {
      // 1, 1, 1, n repeats the pixel before n times; consecutive ones are the digits of n to the base 256.
      for (let x = 0, unit = 1; x < width; place += 4) {
        if (place + 4 > data.length) throw new Error("must be a whole Radiance HDR file, got a part of one");
        const repeats = x > 0 && data[place] === 1 && data[place + 1] === 1 && data[place + 2] === 1;
        const count = repeats ? unit * data[place + 3] : 1;
        if (x + count > width) throw new Error("must be a whole Radiance HDR file, got a damaged one");
        unit = repeats ? 256 * unit : 1;
        for (const end = x + count; x < end; x++)
          line.set(repeats ? line.subarray(4 * x - 4, 4 * x) : data.subarray(place, place + 4), 4 * x);
      }
    }
    for (let x = 0; x < width; x++)
      for (let c = 0; c < 3; c++)
        pixel[3 * (y * width + x) + c] = line[4 * x + 3]
          ? factor[c] * line[4 * x + c] * 2 ** (line[4 * x + 3] - 136)
          : 0;
  }
  return { pixel, width, height };
}

// A latitude-longitude image as a cubemap: each texel the mean of some points in it.
export function toCubemap({ pixel, width, height }, edge) {
  const parts = Math.max(1, Math.ceil(width / (4 * edge)));
  const fine = grid(edge * parts);
  const result = new Float32Array(18 * edge * edge);
  const { area } = grid(edge);
  for (let i = 0; i < fine.area.length; i++) {
    const [x, y, z] = fine.way.subarray(3 * i, 3 * i + 3);
    const to = whole(i, edge, parts);
    const u = ((((0.5 - Math.atan2(x, z) / (2 * Math.PI)) * width) % width) + width) % width;
    const v = (Math.acos(Math.min(Math.max(y, -1), 1)) / Math.PI) * height;
    const from = Math.min(Math.floor(v), height - 1) * width + Math.min(Math.floor(u), width - 1);
    for (let c = 0; c < 3; c++) result[3 * to + c] += (pixel[3 * from + c] * fine.area[i]) / area[to];
  }
  grids.delete(edge * parts);
  return result;
}

// A latitude-longitude image of at most 2048 columns as a picture of a light: half floats, and its mip maps.
export function toSky({ pixel, width, height }) {
  const levels = [];
  for (;;) {
    if (width <= 2048 || width % 2 || height % 2) levels.push({ pixel, width, height });
    if (height <= 128 || width % 2 || height % 2) break;
    const coarse = new Float32Array((3 * width * height) / 4);
    const from = (x, y, c) => pixel[3 * (y * width + x) + c];
    for (let y = 0, to = 0; y < height; y += 2)
      for (let x = 0; x < width; x += 2)
        for (let c = 0; c < 3; c++)
          coarse[to++] = (from(x, y, c) + from(x + 1, y, c) + from(x, y + 1, c) + from(x + 1, y + 1, c)) / 4;
    [pixel, width, height] = [coarse, width / 2, height / 2];
  }
  const data = new Uint16Array(levels.reduce((total, level) => total + level.pixel.length, 0));
  const [first] = levels;
  let brightest = 1;
  let place = 0;
  for (const value of first.pixel) brightest = Math.max(brightest, value);
  const scale = Math.max(1, brightest / 65504);
  for (const level of levels) for (const value of level.pixel) data[place++] = toHalf(value / scale);
  return {
    content: { kind: "sky", scale, width: first.width, height: first.height, levels: levels.length },
    buffers: [new DataView(data.buffer)],
  };
}
