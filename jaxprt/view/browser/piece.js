// A relit scene without Python: answers the questions of `viewer.js` from what `export` has written, on the GPU.
// Diffuse light by transfer vectors; glossy light by lobes and means of visibility, as the lobe system does, or by transfer
// matrices, as the harmonic system does: harmonics of the visibility are kept, and a light is taken through them once.

import { GATHER, SHADE, WHOLE, WIDTH } from "./shading.js";
import { gathered, harmonics } from "./harmonics.js";
import { Blur, SIDES, grid, halved, readHdr, rimmed, toCubemap, toHalf, toSky, whole } from "./lights.js";

const FINE = 4; // parts along the edge of a texel by which the rim of a lamp is found

class Piece {
  constructor(content, buffers) {
    this.content = content;
    const next = (() => { let i = 0; return (kind) => { const each = buffers[i++]; return new kind(each.buffer, each.byteOffset, each.byteLength / (kind.BYTES_PER_ELEMENT ?? 1)); }; })();
    this.position = next(Float32Array);
    this.face = next(Uint32Array);
    this.normal = next(Int16Array);
    this.vectors = next(Int8Array);
    this.pyramid = next(Uint8Array);
    this.table = next(Float32Array);
    this.weights = next(Float32Array);
    this.visible = next(Int8Array);
    this.bits = next(Uint8Array);
    this.index = new Map(content.rims.map((edge) => [edge, next(Uint32Array)]));
    this.lights = content.scene.lights.map(() => next(Float32Array));
    this.names = [...content.scene.lights];
    this.skies = (content.skies ?? []).map((sky) => sky && { content: sky, buffers: [next(DataView)] });
    this.canvas = document.createElement("canvas");
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.build();
  }
  build() {
    const gl = (this.gl = this.canvas.getContext("webgl2")), { content } = this;
    if (!gl) throw new Error("this browser has no WebGL2, which the viewer needs");
    const bands = Math.max(1, ...content.parts.map((part) => part.bands)), knots = Math.max(2, ...content.parts.map((part) => part.knot.length));
    const text = SHADE.replaceAll("HARMONICS", 2 * Math.ceil(bands ** 2 / 2)).replaceAll("BANDS", bands).replaceAll("KNOTS", knots).replaceAll("TERMS", content.terms).replaceAll("LEVELS", content.edges.length).replaceAll("WIDTHS", content.light.edges.length).replaceAll("STRIDE", content.stride).replaceAll("TEXELS", Math.max(content.texelEdge, 4));
    this.program = this.link(text);
    gl.useProgram(this.program);
    gl.bindVertexArray(gl.createVertexArray());
    const count = content.scene.vertices, place = new Float32Array(8 * count);
    for (let i = 0; i < count; i++) for (let c = 0; c < 3; c++) {
      place[8 * i + c] = this.position[3 * i + c];
      place[8 * i + 4 + c] = this.normal[3 * i + c] / 32767;
    }
    this.unit = 0;
    this.textures = {};
    this.texture("place", gl.RGBA32F, gl.RGBA, gl.FLOAT, place, 4);
    this.texture("vectors", gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, this.vectors, 4);
    this.texture("pyramid", gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, new Uint32Array(this.pyramid.buffer, this.pyramid.byteOffset, this.pyramid.length / 4), 1);
    this.texture("bits", gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, new Uint32Array(this.bits.buffer, this.bits.byteOffset, this.bits.length / 4), 1);
    this.texture("table", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.table, 4);
    this.texture("weights", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.weights, 4);
    const set = { ints: gl.uniform1iv, floats: gl.uniform1fv };
    for (const [kind, name, value] of [["ints", "edges", content.edges], ["ints", "starts", content.starts], ["floats", "spreads", content.spreads],
      ["ints", "lightEdges", content.light.edges], ["ints", "lightStarts", content.light.starts], ["floats", "lightSpreads", content.light.spreads]]) set[kind].call(gl, this.at(name), value);
    this.arrived = this.target(content.arrived, this.unit++);
    gl.uniform1i(this.at("arrived"), this.unit - 1);
    this.color = this.target(count, this.unit++);
    if (content.arrived) {
      this.gather = this.link(GATHER);
      this.texture("visible", gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, this.visible, 4, this.gather);
    }
    this.degree = Math.max(Math.round(Math.sqrt(content.vectorUnit.length)), ...content.parts.map((part) => part.bands)) - 1;
    this.use(this.program, this.color);
    for (const part of content.parts) part.written = "";
    [this.lit, this.turned] = ["", ""];
  }
  link(text) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, WHOLE], [gl.FRAGMENT_SHADER, text]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return program;
  }
  // A texture of so many entries that is drawn into.
  target(entries, unit) {
    const gl = this.gl, made = gl.createTexture(), frame = gl.createFramebuffer(), rows = Math.max(1, Math.ceil(entries / WIDTH));
    this.check(rows);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, WIDTH, rows);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made, 0);
    return { frame, rows };
  }
  use(program, target) {
    const gl = this.gl;
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, WIDTH, target.rows);
  }
  check(rows) {
    const most = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
    if (rows > most) throw new Error(`this browser has textures of ${most} rows, and the scene needs ${rows}`);
  }
  at(name, program = this.program) { return placeOf(this.gl, program, name); }
  texture(name, internal, format, type, data, channels, program = this.program) {
    const gl = this.gl, entries = data.length / channels, rows = Math.max(1, Math.ceil(entries / WIDTH));
    this.check(rows);
    const unit = (this.textures[name] ??= { unit: this.unit++ }).unit;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(this.textures[name].made ?? null);
    gl.bindTexture(gl.TEXTURE_2D, (this.textures[name].made = gl.createTexture()));
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const padded = new data.constructor(WIDTH * rows * channels);
    padded.set(data);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, WIDTH, rows, 0, format, type, padded);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.useProgram(program);
    gl.uniform1i(this.at(name, program), unit);
  }
  // A light with its lamps: disks; one that is smaller than a texel keeps its flux.
  radiance(message) {
    const edge = this.content.mips[0], light = Float32Array.from(this.lights[message.light]), { area } = grid(edge), fine = grid(edge * FINE);
    for (const lamp of message.lamps) {
      const l = Math.hypot(...lamp.direction), d = lamp.direction.map((x) => x / l), flux = new Float64Array(6 * edge * edge);
      const toward = fine.area.map((_, i) => fine.way[3 * i] * d[0] + fine.way[3 * i + 1] * d[1] + fine.way[3 * i + 2] * d[2]);
      const least = Math.min(Math.cos(lamp.angle), toward.reduce((a, b) => Math.max(a, b)));
      let total = 0;
      toward.forEach((each, i) => {
        if (each < least) return;
        flux[whole(i, edge, FINE)] += fine.area[i];
        total += fine.area[i];
      });
      const scale = (2 * Math.PI * (1 - Math.cos(lamp.angle))) / total;
      for (let i = 0; i < 6 * edge * edge; i++) for (let c = 0; c < 3; c++) light[3 * i + c] += ((flux[i] * scale) / area[i]) * lamp.radiance[c];
    }
    return light;
  }
  // The light side: the light blurred, and its harmonics as it is turned.
  shine(message) {
    const { gl, content } = this, key = JSON.stringify([message.light, message.lamps]);
    if (this.lit !== key) {
      this.mips = new Map();
      const all = this.radiance(message);
      let light = this.split(all);
      // Parts without single texels are lit by all of the light.
      this.all = light === all || content.parts.every((part) => part.texels) ? null : all;
      for (let edge = content.mips[0]; this.all && edge > 32 && edge > content.mips.at(-1); edge /= 2) this.all = halved(this.all, edge);
      for (const edge of content.mips) {
        this.mips.set(edge, light);
        if (edge > content.mips.at(-1)) light = halved(light, edge);
      }
      if (content.glossy) {
        this.blur ??= new Blur(content.light, this.index);
        this.texture("light", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.blur.apply(this.mips), 4);
      }
      [this.lit, this.turned] = [key, ""];
    }
    if (this.turned === `${key} ${message.turn}`) return;
    const c = Math.cos(message.turn), s = Math.sin(message.turn);
    const edge = content.mips.find((each) => each <= 32) ?? content.mips.at(-1), rest = this.project(this.mips.get(edge), edge, c, s);
    const all = this.all ? this.project(this.all, edge, c, s) : rest;
    [this.irradiance, this.irradianceOfAll] = [rest, all].map((each) => {
      const result = new Float32Array(3 * content.terms);
      content.vectorUnit.forEach((unit, k) => { for (let j = 0; j < 3; j++) result[3 * k + j] = unit * each[3 * k + j]; });
      return result;
    });
    gl.uniform2f(this.at("turn"), c, s);
    if (content.arrived) this.arrive(all);
    this.turned = `${key} ${message.turn}`;
  }
  // Harmonics of a light that is turned.
  project(light, edge, c, s) {
    const parts = Math.max(1, Math.floor(32 / edge)), { way, area } = grid(edge * parts), basis = new Float64Array((this.degree + 1) ** 2), value = new Float64Array(3 * basis.length);
    for (let i = 0; i < area.length; i++) {
      const [x, y, z] = [way[3 * i], way[3 * i + 1], way[3 * i + 2]], from = whole(i, edge, parts);
      harmonics(c * x + s * z, y, c * z - s * x, this.degree, basis);
      for (let k = 0; k < basis.length; k++) for (let j = 0; j < 3; j++) value[3 * k + j] += basis[k] * area[i] * light[3 * from + j];
    }
    return value;
  }
  // Takes a light through the transfer matrices: what arrives is kept until the light changes.
  arrive(light) {
    const { gl, content } = this;
    let key = "";
    this.use(this.gather, this.arrived);
    for (const part of content.parts) {
      if (!part.bands) continue;
      const own = `${part.bands} ${part.laplacian}`;
      if (own !== key) this.texture("gathered", gl.RGBA32F, gl.RGBA, gl.FLOAT, gathered(light, part, content.visibleUnit), 4, this.gather);
      key = own;
      for (const name of ["count", "bands", "words", "visibleStart", "arrivedStart"]) gl.uniform1i(this.at(name, this.gather), part[name]);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    this.use(this.program, this.color);
  }
  // Takes the brightest texels out of a light, as far as they stand out: `jaxprt.bright_texels.split`.
  split(light) {
    const { gl, content } = this, edge = content.mips[0], { way, area } = grid(edge), count = content.texels;
    if (!count) return light;
    const flux = area.map((each, i) => each * (light[3 * i] + light[3 * i + 1] + light[3 * i + 2]));
    const order = Array.from(flux.keys()).sort((a, b) => flux[b] - flux[a]), rest = light.slice(), data = new Float32Array(8 * count);
    for (let n = 0; n < count; n++) {
      const i = order[n], share = flux[i] > 0 ? Math.max(1 - flux[order[count]] / flux[i], 0) : 0;
      for (let c = 0; c < 3; c++) {
        data[8 * n + c] = way[3 * i + c];
        data[8 * n + 4 + c] = share * light[3 * i + c] * area[i] * (1 - area[i] / (4 * Math.PI)); // as a disk of its solid angle has
        rest[3 * i + c] -= share * light[3 * i + c];
      }
    }
    this.texture("bright", gl.RGBA32F, gl.RGBA, gl.FLOAT, data, 4);
    return rest;
  }
  look(message) {
    const { gl, content } = this;
    if (gl.isContextLost()) { this.canvas = document.createElement("canvas"); this.build(); return this.look(message); }
    const began = performance.now();
    this.shine(message);
    const lit = performance.now();
    gl.uniform3fv(this.at("eye"), message.eye);
    for (const part of content.parts) {
      const { weightStep, log } = this.material(part, message.materials[part.name]);
      for (const name of ["first", "count", "lobes", "channels", "nodes", "tableStart", "weightStart", "pyramidStart", "terms", "bands", "entries", "arrivedStart", "bitStart"]) gl.uniform1i(this.at(name), part[name]);
      gl.uniform1f(this.at("steps"), part.steps);
      gl.uniform1i(this.at("texels"), part.texels ? content.texels : 0);
      gl.uniform3fv(this.at("irradiance"), part.texels ? this.irradiance : this.irradianceOfAll);
      gl.uniform1i(this.at("weightStep"), weightStep);
      gl.uniform1f(this.at("logRoughness"), log);
      gl.uniform1i(this.at("families"), part.family.terms.length);
      if (part.family.terms.length) {
        gl.uniform1iv(this.at("term"), part.family.terms);
        gl.uniform1fv(this.at("scale"), part.family.scale);
      }
      gl.uniform1i(this.at("knots"), Math.max(part.knot.length, 1));
      if (part.knot.length) gl.uniform1fv(this.at("knot"), part.knot);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    const count = content.scene.vertices, found = new Uint32Array(4 * WIDTH * this.color.rows), result = new Uint16Array(3 * count);
    gl.readPixels(0, 0, WIDTH, this.color.rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    for (let i = 0; i < count; i++) {
      result[3 * i] = found[4 * i] & 65535;
      result[3 * i + 1] = found[4 * i] >>> 16;
      result[3 * i + 2] = found[4 * i + 1] & 65535;
    }
    const ms = { light: lit - began, view: 0, combine: performance.now() - lit };
    return { content: { kind: "color", seq: message.seq, scale: 1, ms }, buffers: [new DataView(result.buffer)] };
  }
  // Weights of a part whose material is one for all vertices, as `MetallicRoughness.coefficient` has them.
  material(part, change) {
    const own = part.material;
    if (!own) return { weightStep: part.weightStep, log: 0 };
    const value = { ...own, ...change };
    if (own.exponent !== undefined) {
      const most = Math.max(...own.specular), strength = change?.f0 ?? most;
      const specular = change?.f0 === undefined && !change?.specular ? own.specular : (change.specular ?? own.specular.map((x) => x / Math.max(most, 1e-6))).map((x) => x * strength);
      this.write(part, { 3: value.diffuse, 4: specular });
      return { weightStep: 0, log: Math.log(2 / (value.exponent + 2)) / 2 };
    }
    if (own.slope !== undefined) {
      const most = Math.max(...own.f0), f0 = change?.f0 === undefined ? own.f0 : most > 0 ? own.f0.map((x) => x * change.f0 / most) : own.f0.map(() => change.f0);
      this.write(part, { 3: value.diffuse, 5: value.specular.map((x, c) => x * f0[c]), 6: value.specular.map((x, c) => x * (1 - f0[c])) });
      return { weightStep: 0, log: Math.log(Math.max(value.roughness ?? own.slope, 1e-3)) };
    }
    const white = ((1 - own.ior) / (1 + own.ior)) ** 2, f0White = Math.max(white, 1e-6);
    let tint = own.specular_color;
    if (change?.f0 !== undefined || change?.specular) {
      const most = Math.max(...tint), strength = change.f0 !== undefined ? change.f0 / (own.ior === 0 ? 1 : f0White) : most;
      tint = (change.specular ?? tint.map((x) => x / Math.max(most, 1e-6))).map((x) => x * strength);
    }
    const base = change?.diffuse ?? own.base_color, f0 = tint.map((x) => Math.min(white * x, 1)), dielectric = 1 - value.metallic, layer = dielectric * own.specular;
    const under = 1 - Math.max(...f0), every = [
      base.map((x) => layer * x * under),
      f0.map((x, c) => layer * x + value.metallic * base[c]),
      f0.map((x, c) => layer * (1 - x) + value.metallic * (1 - base[c])),
      base.map((x) => dielectric * (1 - own.specular) * x),
    ];
    this.write(part, every);
    return { weightStep: 0, log: Math.log(Math.max(value.roughness, 1e-3 ** 0.5)) };
  }
  write(part, every) {
    const gl = this.gl, key = JSON.stringify(every);
    if (key === part.written) return;
    part.family.terms.forEach((term, k) => {
      const at = part.weightStart + k;
      gl.activeTexture(gl.TEXTURE0 + this.textures.weights.unit);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, at % WIDTH, Math.floor(at / WIDTH), 1, 1, gl.RGBA, gl.FLOAT, Float32Array.of(...every[term].map((x) => x / part.family.scale[k]), 0));
    });
    part.written = key;
  }
  sky(message) {
    const fine = this.skies[message.light];
    if (message.rows > 1 && fine && !message.lamps.length) return { ...fine, content: { ...fine.content, seq: message.seq } };
    const edge = this.content.mips[0], light = this.radiance(message), height = 128, width = 256, result = new Uint16Array(3 * width * height);
    const rim = new Float32Array(24 * (edge + 2) ** 2), index = this.index.get(edge), m = edge + 2;
    rimmed(light, edge, index, rim, 0);
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const latitude = Math.PI * (0.5 - (y + 0.5) / height), longitude = Math.PI * (1 - (2 * (x + 0.5)) / width), ring = Math.cos(latitude);
      const d = [ring * Math.sin(longitude), Math.sin(latitude), ring * Math.cos(longitude)];
      const size = d.map(Math.abs), axis = size.indexOf(Math.max(...size)), face = 2 * axis + (d[axis] < 0 ? 1 : 0);
      const [S, T, N] = SIDES[face], dot = (A) => A[0] * d[0] + A[1] * d[1] + A[2] * d[2];
      const u = ((dot(S) / dot(N) + 1) / 2) * edge + 0.5, v = ((dot(T) / dot(N) + 1) / 2) * edge + 0.5, i = Math.min(Math.floor(u), edge), j = Math.min(Math.floor(v), edge);
      for (let c = 0; c < 3; c++) {
        const from = (row, column) => rim[4 * ((face * m + row) * m + column) + c];
        const top = from(j, i) + (u - i) * (from(j, i + 1) - from(j, i)), low = from(j + 1, i) + (u - i) * (from(j + 1, i + 1) - from(j + 1, i));
        result[3 * (y * width + x) + c] = toHalf(top + (v - j) * (low - top));
      }
    }
    return { content: { kind: "sky", seq: message.seq, scale: 1, width, height }, buffers: [new DataView(result.buffer)] };
  }
  drop(message, data) {
    const image = readHdr(new Uint8Array(data));
    this.lights.push(toCubemap(image, this.content.mips[0]));
    this.skies[this.lights.length - 1] = toSky(image);
    this.names.push(message.name.replace(/\.[^.]*$/, ""));
    return { content: { kind: "lights", lights: [...this.names], light: this.names.length - 1 }, buffers: [] };
  }
  answer(message, buffers) {
    switch (message.kind) {
      case "scene": return { content: { ...this.content.scene, lights: this.names }, buffers: [this.position, this.face] };
      case "look": return this.look(message);
      case "sky": return this.sky(message);
      default: return this.drop(message, buffers[0]);
    }
  }
}
function placeOf(gl, program, name) {
  const known = (program.places ??= new Map());
  if (!known.has(name)) known.set(name, gl.getUniformLocation(program, name));
  return known.get(name);
}

// What `mount` of `viewer.js` asks: the answers of a scene that `export` has written.
export function answers(content, buffers) {
  const piece = new Piece(content, buffers);
  return async (message, given = []) => {
    try {
      return piece.answer(message, given);
    } catch (error) {
      return { content: { kind: "error", of: message.kind, message: `${message.name ?? "the viewer"} ${error.message}` }, buffers: [] };
    }
  };
}
