// Exported pages: what the viewer asks Python for, answered in the browser.

import { SIDES, readHdr, rimmed, toCubemap, toHalf, toSky } from "./lights.js";
import { Piece } from "./piece.js";

// Answers the questions of `viewer.js` in an exported page, in place of Python.
class Answers {
  constructor(content, buffers) {
    this.piece = new Piece(content, buffers);
    this.names = [...content.scene.lights];
    this.skies = content.skies.map(
      (sky, i) =>
        sky && { content: sky, buffers: [buffers[buffers.length - content.skies.slice(i).filter(Boolean).length]] },
    );
  }
  // Colors of the vertices, for who has no picture.
  async look(message) {
    const began = performance.now();
    const { piece } = this;
    await piece.expand();
    if (!piece.gl || piece.gl.isContextLost()) {
      const gl = document.createElement("canvas").getContext("webgl2");
      if (!gl) throw new Error("this browser has no WebGL2, which the viewer needs");
      piece.build(gl);
    }
    piece.shine(message);
    const lit = performance.now();
    piece.vertices(message);
    const result = piece.read();
    const ms = { light: lit - began, view: 0, combine: performance.now() - lit };
    return { content: { kind: "color", seq: message.seq, scale: 1, ms }, buffers: [new DataView(result.buffer)] };
  }
  sky(message) {
    const fine = this.skies[message.light];
    if (message.rows > 1 && fine && !message.lamps.length)
      return { ...fine, content: { ...fine.content, seq: message.seq } };
    const edge = this.piece.content.mips[0];
    const light = this.piece.radiance(message);
    const height = 128;
    const width = 256;
    const result = new Uint16Array(3 * width * height);
    const rim = new Float32Array(24 * (edge + 2) ** 2);
    const index = this.piece.index.get(edge);
    const m = edge + 2;
    rimmed(light, edge, index, rim, 0);
    for (let y = 0; y < height; y++)
      for (let x = 0; x < width; x++) {
        const latitude = Math.PI * (0.5 - (y + 0.5) / height);
        const longitude = Math.PI * (1 - (2 * (x + 0.5)) / width);
        const ring = Math.cos(latitude);
        const d = [ring * Math.sin(longitude), Math.sin(latitude), ring * Math.cos(longitude)];
        const size = d.map(Math.abs);
        const axis = size.indexOf(Math.max(...size));
        const face = 2 * axis + (d[axis] < 0 ? 1 : 0);
        const [S, T, N] = SIDES[face];
        const dot = (A) => A[0] * d[0] + A[1] * d[1] + A[2] * d[2];
        const u = ((dot(S) / dot(N) + 1) / 2) * edge + 0.5;
        const v = ((dot(T) / dot(N) + 1) / 2) * edge + 0.5;
        const i = Math.min(Math.floor(u), edge);
        const j = Math.min(Math.floor(v), edge);
        for (let c = 0; c < 3; c++) {
          const from = (row, column) => rim[4 * ((face * m + row) * m + column) + c];
          const top = from(j, i) + (u - i) * (from(j, i + 1) - from(j, i));
          const low = from(j + 1, i) + (u - i) * (from(j + 1, i + 1) - from(j + 1, i));
          result[3 * (y * width + x) + c] = toHalf(top + (v - j) * (low - top));
        }
      }
    return {
      content: { kind: "sky", seq: message.seq, scale: 1, width, height },
      buffers: [new DataView(result.buffer)],
    };
  }
  drop(message, data) {
    const image = readHdr(new Uint8Array(data));
    const light = toCubemap(image, this.piece.content.mips[0]);
    const { lights } = this.piece;
    lights.push(light);
    this.skies[lights.length - 1] = toSky(image);
    this.names.push(message.name.replace(/\.[^.]*$/, ""));
    return {
      content: { kind: "lights", lights: [...this.names], light: this.names.length - 1 },
      buffers: [new DataView(light.buffer)],
    };
  }
  answer(message, buffers) {
    const { content, buffers: all } = this.piece;
    switch (message.kind) {
      case "progress":
        return { content: { kind: "progress", version: content.scene.version, finished: true }, buffers: [] };
      case "scene":
        return { content: { ...content.scene, lights: this.names }, buffers: all.slice(0, 2) };
      case "page":
        return {
          content: { ...content, kind: "page", system: Object.keys(content.scene.systems)[0] },
          buffers: all.slice(2),
        };
      case "look":
        return this.look(message);
      case "sky":
        return this.sky(message);
      case "open":
        throw new Error("other scenes are opened by jaxprt view; drop a light");
      default:
        return this.drop(message, buffers[0]);
    }
  }
}

// What `mount` of `viewer.js` asks: the answers of a scene that `export` has written.
export function answers(content, buffers) {
  const piece = new Answers(content, buffers);
  return async (message, given = []) => {
    try {
      return await piece.answer(message, given);
    } catch (error) {
      return {
        content: { kind: "error", of: message.kind, message: `${message.name ?? "the viewer"} ${error.message}` },
        buffers: [],
      };
    }
  };
}
