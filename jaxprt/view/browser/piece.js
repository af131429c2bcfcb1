// A relit scene on the GPU: its transport, materials and lights, from what Python has written or sent.
// Diffuse light by transfer vectors; glossy light by lobes and means of visibility, as the lobe system does, or by
// transfer matrices, as the harmonic system does: harmonics of the visibility are kept, and a light is taken through
// them once.

import { floats, pause } from "./common.js";
import { ARRIVE, FINER, GATHER, SHADE, SIGHT, WHOLE, WIDTH } from "./shading.js";
import { gathered, harmonics } from "./harmonics.js";
import { Blur, grid, halved, whole } from "./lights.js";

const TEXTURES = ["base_color", "roughness", "metallic", "emissive", "normal"]; // that are read at pixels
const COLORS = ["base_color", "emissive"]; // of these, those in sRGB
const SLICE = 8; // milliseconds of computing, after which the page may draw a frame
const FINE = 4; // parts along the edge of a texel by which the rim of a lamp is found

export class Piece {
  constructor(content, buffers) {
    // positions and faces come first
    this.content = content;
    this.buffers = buffers;
    this.blur = this.expanding = this.decoding = null;
    this.sky = null; // a fine picture of a light: its image, scale, height, and the light and lamps that it shows
    const next = (() => {
      let i = 0;
      return (kind) => {
        const each = buffers[i++];
        return new kind(each.buffer, each.byteOffset, each.byteLength / (kind.BYTES_PER_ELEMENT ?? 1));
      };
    })();
    this.position = next(Float32Array);
    this.face = next(Uint32Array);
    this.normal = next(Int16Array);
    this.vectors = next(Int8Array);
    this.pyramid = next(Uint8Array);
    this.table = next(Float32Array);
    this.weights = next(Float32Array);
    this.visible = next(Int8Array);
    this.bits = next(Uint8Array);
    this.coordinates = next(Float32Array);
    this.tangents = next(Int8Array);
    this.opacities = next(Float32Array); // place in the image, and factor, of each vertex
    this.images = content.images.map(() => next(Uint8Array));
    this.reflected = next(Int8Array);
    this.index = new Map(content.rims.map((edge) => [edge, next(Uint32Array)]));
    this.lights = Array.from({ length: content.lights }, () => next(Float32Array));
    this.count = this.position.length / 3;
    this.runs = runs(content.parts, this.face, this.count);
    this.blends = content.parts.some((part) => part.opacity?.cutoff < 0);
  }
  // Images that came as files.
  async decode() {
    const { images } = this.content;
    await Promise.all(
      images.map(async (image, i) => {
        if (image.file) this.images[i] = await decoded(this.images[i], image);
      }),
    );
  }
  // Means of visibility, where only bits were sent: to await before `build`.
  async expand() {
    await (this.decoding ??= this.decode());
    const { content } = this;
    if (content.means > this.pyramid.length)
      this.pyramid = await (this.expanding ??= means(content, this.bits, this.index));
  }
  build(gl) {
    // in a context, whose first texture unit stays free
    const { content } = this;
    this.gl = gl;
    this.empty = gl.createVertexArray();
    this.unit = 1;
    this.textures = {};
    const place = new Float32Array(8 * this.count);
    for (let i = 0; i < this.count; i++)
      for (let c = 0; c < 3; c++) {
        place[8 * i + c] = this.position[3 * i + c];
        place[8 * i + 4 + c] = this.normal[3 * i + c] / 32767;
      }
    for (let i = 0; 4 * i < this.tangents.length; i++) {
      // with the handedness as sign, in components that are free: WebGL2 promises 16 textures
      const [x, y, z, hand] = this.tangents.subarray(4 * i, 4 * i + 4);
      place[8 * i + 3] = Math.sign(hand) * (1 + (x + 127) + 255 * (y + 127) + 255 ** 2 * (z + 127));
    }
    this.texture("faces", gl.RGB32UI, gl.RGB_INTEGER, gl.UNSIGNED_INT, this.face, 3);
    const words = (bytes) => new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.length / 4);
    const none = new Float32Array(8);
    this.texture("place", gl.RGBA32F, gl.RGBA, gl.FLOAT, place, 4);
    this.texture("vectors", gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, this.vectors, 4);
    this.texture("pyramid", gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, words(this.pyramid), 1);
    this.texture("bits", gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, words(this.bits), 1);
    this.texture("table", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.table, 4);
    this.texture("weights", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.weights, 4);
    this.texture("coordinates", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.coordinates, 4);
    this.texture("opacities", gl.RGB32F, gl.RGB, gl.FLOAT, this.opacities, 3);
    this.texture("visible", gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, this.visible, 4);
    this.texture("reflected", gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, this.reflected, 4);
    for (const name of ["light", "bright", "gathered"]) this.texture(name, gl.RGBA32F, gl.RGBA, gl.FLOAT, none, 4);
    this.texture("share", gl.R32F, gl.RED, gl.FLOAT, none, 1);
    this.sights = Math.ceil(content.texels / 16) || 1;
    const shadows = content.visibility;
    this.arriving = this.target("arriving", shadows ? this.count : 0);
    this.sight = this.target("sight", shadows && content.texels ? this.count * this.sights : 0);
    this.arrived = this.target("arrived", content.arrived);
    this.color = this.target("color", this.count);
    const bands = Math.max(1, ...content.parts.map((part) => part.bands));
    const knots = Math.max(2, ...content.parts.map((part) => part.knot.length));
    const sizes = {
      SHADOWS: shadows ? 1 : 0,
      SIGHTS: this.sights,
      HARMONICS: 2 * Math.ceil(bands ** 2 / 2),
      BANDS: bands,
      KNOTS: knots,
      TERMS: content.terms,
      REFLECTIONS: content.reflectedUnit.length,
      LEVELS: content.edges.length,
      WIDTHS: content.finer.edges.length + content.light.edges.length,
      STRIDE: content.stride,
      TEXELS: Math.max(content.texelEdge, 4),
    };
    const sized = (text, corners) =>
      Object.entries({ ...sizes, CORNERS: corners }).reduce(
        (result, [name, value]) => result.replaceAll(name, value),
        text,
      );
    this.programs = {
      vertex: sized(SHADE, 1),
      pixel: sized(SHADE, 3),
      arrive: sized(ARRIVE),
      sight: sized(SIGHT),
      gather: GATHER,
      finer: FINER,
    };
    for (const [name, text] of Object.entries(this.programs)) this.programs[name] = this.link(WHOLE, text);
    const lists = {
      edges: content.edges,
      starts: content.starts,
      lightEdges: [...content.finer.edges, ...content.light.edges],
      lightStarts: [...content.finer.starts, ...content.light.starts],
    };
    for (const program of [this.programs.vertex, this.programs.pixel]) {
      gl.useProgram(program);
      for (const [name, list] of Object.entries(lists)) gl.uniform1iv(this.at(name, program), list);
      gl.uniform1fv(this.at("spreads", program), content.spreads);
      gl.uniform1fv(this.at("lightSpreads", program), [...content.finer.spreads, ...content.light.spreads]);
    }
    // The last row of reflections is the light of lamps, which no environment changes.
    this.degree =
      Math.max(
        Math.round(Math.sqrt(content.vectorUnit.length)),
        1,
        Math.floor(Math.sqrt(content.reflectedUnit.length)),
        ...content.parts.map((part) => part.bands),
      ) - 1;
    for (const part of content.parts) {
      part.written = "";
      part.samplers = TEXTURES.map((name) => part.textures?.[name] && this.sampler(part.textures[name], name));
      part.stencil = part.opacity?.wrap && this.sampler(part.opacity, "opacity");
    }
    this.sampling = TEXTURES.map(() => this.unit++);
    for (const program of [this.programs.vertex, this.programs.pixel]) {
      gl.useProgram(program);
      TEXTURES.forEach((name, i) => gl.uniform1i(this.at(`${name}Image`, program), this.sampling[i]));
    }
    this.lit = this.turned = ""; // the light of the moment, and its turn
    this.fine = null; // the picture that finer texels are of
    this.colored = null; // the message that vertices have colors of
  }
  // The image of a texture, with mip maps.
  sampler({ image, wrap }, name) {
    const { gl } = this;
    const { width, height, channels } = this.content.images[image];
    const data = this.images[image];
    const handle = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, handle);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    if (name === "normal")
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.FLOAT, normals(data));
    else if (channels === 3) {
      const colors = new Uint8Array(4 * width * height);
      for (let i = 0, to = 0; i < data.length; i += 3, to += 4)
        [colors[to], colors[to + 1], colors[to + 2], colors[to + 3]] = [data[i], data[i + 1], data[i + 2], 255];
      gl.texImage2D(
        gl.TEXTURE_2D,
        0,
        COLORS.includes(name) ? gl.SRGB8_ALPHA8 : gl.RGBA8,
        width,
        height,
        0,
        gl.RGBA,
        gl.UNSIGNED_BYTE,
        colors,
      );
    } else gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, width, height, 0, gl.RED, gl.UNSIGNED_BYTE, data);
    const levels = name !== "normal" || floats(gl);
    if (levels) gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, levels ? gl.LINEAR_MIPMAP_LINEAR : gl.LINEAR);
    const many = gl.getExtension("EXT_texture_filter_anisotropic");
    if (many)
      gl.texParameterf(
        gl.TEXTURE_2D,
        many.TEXTURE_MAX_ANISOTROPY_EXT,
        Math.min(8, gl.getParameter(many.MAX_TEXTURE_MAX_ANISOTROPY_EXT)),
      );
    [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T].forEach((side, i) =>
      gl.texParameteri(
        gl.TEXTURE_2D,
        side,
        { repeat: gl.REPEAT, mirror: gl.MIRRORED_REPEAT, clamp: gl.CLAMP_TO_EDGE }[wrap[i]],
      ),
    );
    return handle;
  }
  close() {
    const { gl } = this;
    for (const part of this.content.parts)
      for (const handle of [...part.samplers, part.stencil]) if (handle) gl.deleteTexture(handle);
    for (const { handle, frame } of Object.values(this.textures)) {
      gl.deleteTexture(handle);
      if (frame) gl.deleteFramebuffer(frame);
    }
    gl.deleteVertexArray(this.empty);
  }
  // A program, which later scenes of the context use again.
  link(vertex, fragment) {
    const gl = this.gl;
    const kept = (gl.programs ??= new Map());
    const key = vertex + fragment;
    if (!kept.has(key)) kept.set(key, this.compile(vertex, fragment));
    const program = kept.get(key);
    gl.useProgram(program);
    for (const [name, { unit }] of Object.entries(this.textures)) gl.uniform1i(this.at(name, program), unit);
    return program;
  }
  compile(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [
      [gl.VERTEX_SHADER, vertex],
      [gl.FRAGMENT_SHADER, fragment],
    ]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
        throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return program;
  }
  allocate(name, internal, entries) {
    const gl = this.gl;
    const rows = Math.max(1, Math.ceil(entries / WIDTH));
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (rows > most) throw new Error(`this browser has textures of ${most} rows, and the scene needs ${rows}`);
    const held = (this.textures[name] ??= { unit: this.unit++ });
    gl.activeTexture(gl.TEXTURE0 + held.unit);
    if (held.rows === rows) return held;
    gl.deleteTexture(held.handle ?? null);
    gl.bindTexture(gl.TEXTURE_2D, (held.handle = gl.createTexture()));
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, WIDTH, rows);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    held.rows = rows;
    return held;
  }
  // A texture of so many entries that is drawn into.
  target(name, entries) {
    const gl = this.gl;
    const held = this.allocate(name, gl.RGBA32UI, entries);
    gl.bindFramebuffer(gl.FRAMEBUFFER, (held.frame = gl.createFramebuffer()));
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, held.handle, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return held;
  }
  // A texture of some entries, or of more, of which the first ones are written.
  texture(name, internal, format, type, data, channels, room = data.length / channels) {
    const gl = this.gl;
    const entries = data.length / channels;
    const full = Math.floor(entries / WIDTH);
    const rest = entries - full * WIDTH;
    this.allocate(name, internal, room);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    if (full)
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, full, format, type, data.subarray(0, full * WIDTH * channels));
    if (rest)
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, rest, 1, format, type, data.subarray(full * WIDTH * channels));
  }
  use(program, target) {
    const gl = this.gl;
    gl.useProgram(program);
    gl.bindVertexArray(this.empty);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, WIDTH, target.rows);
    gl.enable(gl.SCISSOR_TEST);
  }
  // Draws the rows of a target in which some entries lie.
  over(start, count) {
    const gl = this.gl;
    const row = Math.floor(start / WIDTH);
    gl.scissor(0, row, WIDTH, Math.ceil((start + count) / WIDTH) - row);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  finish() {
    this.gl.disable(this.gl.SCISSOR_TEST);
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
  }
  at(name, program) {
    return placeOf(this.gl, program, name);
  }
  ints(program, values) {
    for (const name in values) this.gl.uniform1i(this.at(name, program), values[name]);
  }
  // A light with its lamps: disks; one that is smaller than a texel keeps its flux.
  radiance(message) {
    const edge = this.content.mips[0];
    const light = Float32Array.from(this.lights[message.light]);
    const { area } = grid(edge);
    const fine = grid(edge * FINE);
    for (const lamp of message.lamps) {
      const l = Math.hypot(...lamp.direction);
      const d = lamp.direction.map((x) => x / l);
      const flux = new Float64Array(6 * edge * edge);
      const toward = fine.area.map(
        (_, i) => fine.way[3 * i] * d[0] + fine.way[3 * i + 1] * d[1] + fine.way[3 * i + 2] * d[2],
      );
      const least = Math.min(
        Math.cos(lamp.angle),
        toward.reduce((a, b) => Math.max(a, b)),
      );
      let total = 0;
      toward.forEach((each, i) => {
        if (each < least) return;
        flux[whole(i, edge, FINE)] += fine.area[i];
        total += fine.area[i];
      });
      const scale = (2 * Math.PI * (1 - Math.cos(lamp.angle))) / total;
      for (let i = 0; i < 6 * edge * edge; i++)
        for (let c = 0; c < 3; c++) light[3 * i + c] += ((flux[i] * scale) / area[i]) * lamp.radiance[c];
    }
    return light;
  }
  // The light side: the light blurred, and what arrives of it at vertices as it is turned.
  shine(message) {
    const { gl, content, programs } = this;
    const key = JSON.stringify([message.light, message.lamps]);
    if (this.lit !== key) {
      this.mips = new Map();
      const all = this.radiance(message);
      let light = this.split(all);
      // All of the light is reflected by other parts, and lights parts without single texels.
      this.all =
        light === all || (!content.reflectedUnit.length && content.parts.every((part) => part.texels)) ? null : all;
      for (let edge = content.mips[0]; this.all && edge > 32 && edge > content.mips.at(-1); edge /= 2)
        this.all = halved(this.all, edge);
      for (const edge of content.mips) {
        this.mips.set(edge, light);
        if (edge > content.mips.at(-1)) light = halved(light, edge);
      }
      if (content.glossy) {
        this.blur ??= Blur.of(content.light, this.index);
        const blurred = this.blur.apply(this.mips);
        this.texture("light", gl.RGBA32F, gl.RGBA, gl.FLOAT, blurred, 4, blurred.length / 4 + content.finer.total);
      }
      [this.lit, this.turned, this.fine] = [key, "", null];
      this.sharpen();
    }
    if (this.fine !== this.sky) this.sharpen();
    if (this.turned === `${key} ${message.turn}`) return;
    this.turned = `${key} ${message.turn}`;
    const c = Math.cos(message.turn);
    const s = Math.sin(message.turn);
    for (const program of [programs.vertex, programs.pixel, programs.sight]) {
      gl.useProgram(program);
      gl.uniform2f(this.at("turn", program), c, s);
    }
    if (!content.visibility) return;
    const edge = content.mips.find((each) => each <= 32) ?? content.mips.at(-1);
    const rest = this.project(this.mips.get(edge), edge, c, s);
    const all = this.all ? this.project(this.all, edge, c, s) : rest;
    const [irradiance, irradianceOfAll] = [rest, all].map((each) => {
      const result = new Float32Array(3 * content.terms);
      content.vectorUnit.forEach((unit, k) => {
        for (let j = 0; j < 3; j++) result[3 * k + j] = unit * each[3 * k + j];
      });
      return result;
    });
    this.use(programs.arrive, this.arriving);
    const last = content.reflectedUnit.length - 1;
    const reflected = content.reflectedUnit.flatMap((unit, k) =>
      [0, 1, 2].map((j) => unit * (k < last ? all[3 * k + j] : 1)),
    );
    if (reflected.length) gl.uniform3fv(this.at("reflectedLight", programs.arrive), reflected);
    for (const part of content.parts) {
      gl.uniform3fv(this.at("irradiance", programs.arrive), part.texels ? irradiance : irradianceOfAll);
      this.ints(programs.arrive, { first: part.first, count: part.count, terms: part.terms });
      this.over(part.first, part.count);
    }
    this.use(programs.sight, this.sight);
    for (const part of content.parts) {
      if (!part.texels) continue;
      this.ints(programs.sight, { first: part.first, count: part.count, texels: this.texels, bitStart: part.bitStart });
      this.over(part.first * this.sights, part.count * this.sights);
    }
    this.arrive(all);
    this.finish();
  }
  // What narrow lobes see: texels that are finer than those of the light, where there is a fine picture of it.
  sharpen() {
    const { gl, content, programs, sky } = this;
    const { edges, starts } = content.finer;
    const size = content.light.edges[0];
    this.fine = sky;
    const has =
      content.glossy && sky?.of === this.lit && sky.height > 2 * size && gl.getExtension("EXT_color_buffer_float");
    if (has) {
      const { light } = this.textures;
      const { finer } = programs;
      if (!light.frame) {
        gl.bindFramebuffer(gl.FRAMEBUFFER, (light.frame = gl.createFramebuffer()));
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, light.handle, 0);
      }
      this.use(finer, light);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, sky.image);
      gl.uniform1f(this.at("scale", finer), sky.scale);
      edges.forEach((edge, i) => {
        gl.uniform1f(this.at("level", finer), Math.max(Math.log2(sky.height / (2 * edge)), 0));
        this.ints(finer, { sky: 0, edge, start: starts[i], coarse: content.mips[0] });
        this.over(starts[i], 6 * (edge + 2) ** 2);
      });
      this.finish();
    }
    for (const program of [programs.vertex, programs.pixel]) {
      gl.useProgram(program);
      gl.uniform1i(this.at("finest", program), has ? 0 : edges.length);
    }
  }
  // Harmonics of a light that is turned.
  project(light, edge, c, s) {
    const parts = Math.max(1, Math.floor(32 / edge));
    const { way, area } = grid(edge * parts);
    const basis = new Float64Array((this.degree + 1) ** 2);
    const value = new Float64Array(3 * basis.length);
    for (let i = 0; i < area.length; i++) {
      const [x, y, z] = [way[3 * i], way[3 * i + 1], way[3 * i + 2]];
      const from = whole(i, edge, parts);
      harmonics(c * x + s * z, y, c * z - s * x, this.degree, basis);
      for (let k = 0; k < basis.length; k++)
        for (let j = 0; j < 3; j++) value[3 * k + j] += basis[k] * area[i] * light[3 * from + j];
    }
    return value;
  }
  // Takes a light through the transfer matrices: what arrives is kept until the light changes.
  arrive(light) {
    const { gl, content, programs } = this;
    let key = "";
    this.use(programs.gather, this.arrived);
    for (const part of content.parts) {
      if (!part.bands) continue;
      const own = `${part.bands} ${part.laplacian}`;
      if (own !== key)
        this.texture("gathered", gl.RGBA32F, gl.RGBA, gl.FLOAT, gathered(light, part, content.visibleUnit), 4);
      key = own;
      for (const name of ["count", "bands", "words", "visibleStart", "arrivedStart"])
        gl.uniform1i(this.at(name, programs.gather), part[name]);
      this.over(part.arrivedStart, part.count * Math.ceil(part.bands ** 2 / 2));
    }
  }
  // Takes the brightest texels out of a light, as far as they stand out: `jaxprt.bright_texels.split`.
  split(light) {
    const { gl, content } = this;
    const edge = content.mips[0];
    const { way, area } = grid(edge);
    const count = content.texels;
    const left = new Float32Array(area.length).fill(1);
    this.texels = 0; // those that stand out
    const flux = area.map((x, i) => x * (light[3 * i] + light[3 * i + 1] + light[3 * i + 2]));
    const order = count ? Array.from(flux.keys()).sort((a, b) => flux[b] - flux[a]) : [];
    const rest = light.slice();
    const data = new Float32Array(8 * count);
    for (let n = 0; n < count; n++) {
      const i = order[n];
      const share = flux[i] > 0 ? Math.max(1 - flux[order[count]] / flux[i], 0) : 0;
      if (share > 0) this.texels = n + 1;
      left[i] -= share;
      for (let c = 0; c < 3; c++) {
        data[8 * n + c] = way[3 * i + c];
        data[8 * n + 4 + c] = share * light[3 * i + c] * area[i] * (1 - area[i] / (4 * Math.PI)); // as a disk of its solid angle has
        rest[3 * i + c] -= share * light[3 * i + c];
      }
    }
    this.texture("share", gl.R32F, gl.RED, gl.FLOAT, left, 1);
    if (!count) return light;
    this.texture("bright", gl.RGBA32F, gl.RGBA, gl.FLOAT, data, 4);
    return rest;
  }
  // Draws each part by a program that shades. `over` draws one part's share of the target.
  shade(program, message, over) {
    const { gl, content } = this;
    gl.uniform3fv(this.at("eye", program), message.eye);
    for (const part of content.parts) {
      const { weightStep, log, factors } = this.material(part, message.materials[part.name]);
      this.sample(program, part, factors);
      for (const name of [
        "first",
        "count",
        "lobes",
        "channels",
        "nodes",
        "tableStart",
        "weightStart",
        "pyramidStart",
        "bands",
        "entries",
        "arrivedStart",
      ])
        gl.uniform1i(this.at(name, program), part[name]);
      gl.uniform1f(this.at("steps", program), part.steps);
      gl.uniform1f(this.at("logRoughness", program), log);
      this.ints(program, {
        glass: part.opacity?.glass ? 1 : 0,
        texels: part.texels ? this.texels : 0,
        weightStep,
        families: part.family.terms.length,
        knots: Math.max(part.knot.length, 1),
      });
      if (part.family.terms.length) {
        gl.uniform1iv(this.at("term", program), part.family.terms);
        gl.uniform1fv(this.at("scale", program), part.family.scale);
      }
      if (part.knot.length) gl.uniform1fv(this.at("knot", program), part.knot);
      over(part);
    }
  }
  // Has a program read the textures of a part, which its factors multiply.
  sample(program, part, factors) {
    const { gl } = this;
    const at = (name) => this.at(name, program);
    const found = part.samplers.map((handle, i) => (handle ? 1 << i : 0));
    gl.uniform1i(
      at("sampled"),
      found.reduce((a, b) => a + b),
    );
    if (!found.some(Boolean)) return;
    gl.uniform3fv(at("emissive"), part.material.emissive);
    gl.uniform1f(at("slope"), part.material.normal_scale);
    gl.uniform3fv(at("baseColor"), factors.base);
    gl.uniform3fv(at("f0"), factors.f0);
    gl.uniform4f(at("factors"), factors.specular, factors.metallic, factors.roughness, factors.passing);
    TEXTURES.forEach((name, i) => {
      if (!part.samplers[i]) return;
      const { transform, set } = part.textures[name];
      gl.activeTexture(gl.TEXTURE0 + this.sampling[i]);
      gl.bindTexture(gl.TEXTURE_2D, part.samplers[i]);
      gl.uniform1i(at(`sets[${i}]`), set);
      gl.uniform3fv(at(`across[${i}]`), transform[0]);
      gl.uniform3fv(at(`upward[${i}]`), transform[1]);
    });
  }
  // Radiance of the vertices into the texture of colors.
  vertices(message) {
    if (message === this.colored) return;
    this.colored = message;
    this.shine(message);
    this.use(this.programs.vertex, this.color);
    this.shade(this.programs.vertex, message, (part) => this.over(part.first, part.count));
    this.finish();
  }
  // The colors that `vertices` has computed, in half floats.
  read() {
    const { gl, count } = this;
    const found = new Uint32Array(4 * WIDTH * this.color.rows);
    const result = new Uint16Array(3 * count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.color.frame);
    gl.readPixels(0, 0, WIDTH, this.color.rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    for (let i = 0; i < count; i++) {
      result[3 * i] = found[4 * i] & 65535;
      result[3 * i + 1] = found[4 * i] >>> 16;
      result[3 * i + 2] = found[4 * i + 1] & 65535;
    }
    return result;
  }
  // The first of some parts that have a material for each vertex, which cannot change; none if all can.
  fixed(names) {
    return this.content.parts.find((part) => !part.material && Object.keys(names[part.name] ?? {}).length)?.name;
  }
  // Weights of a part whose material is one for all vertices, as `MetallicRoughness.coefficient` has them.
  material(part, change) {
    const own = part.material;
    if (!own) return { weightStep: part.weightStep, log: 0 };
    const value = { ...own, ...change };
    if (own.exponent !== undefined) {
      const most = Math.max(...own.specular);
      const strength = change?.f0 ?? most;
      const specular =
        change?.f0 === undefined && !change?.specular
          ? own.specular
          : (change.specular ?? own.specular.map((x) => x / Math.max(most, 1e-6))).map((x) => x * strength);
      this.write(part, { 3: value.diffuse, 4: specular });
      return { weightStep: 0, log: Math.log(2 / (value.exponent + 2)) / 2 };
    }
    if (own.slope !== undefined) {
      const most = Math.max(...own.f0);
      const f0 =
        change?.f0 === undefined
          ? own.f0
          : most > 0
            ? own.f0.map((x) => (x * change.f0) / most)
            : own.f0.map(() => change.f0);
      this.write(part, {
        3: value.diffuse,
        5: value.specular.map((x, c) => x * f0[c]),
        6: value.specular.map((x, c) => x * (1 - f0[c])),
      });
      return { weightStep: 0, log: Math.log(Math.max(value.roughness ?? own.slope, 1e-3)) };
    }
    const white = ((1 - own.ior) / (1 + own.ior)) ** 2;
    const f0White = Math.max(white, 1e-6);
    let tint = own.specular_color;
    if (change?.f0 !== undefined || change?.specular) {
      const most = Math.max(...tint);
      const strength = change.f0 !== undefined ? change.f0 / (own.ior === 0 ? 1 : f0White) : most;
      tint = (change.specular ?? tint.map((x) => x / Math.max(most, 1e-6))).map((x) => x * strength);
    }
    const base = change?.diffuse ?? own.base_color;
    const f0 = tint.map((x) => Math.min(white * x, 1));
    const dielectric = 1 - value.metallic;
    const layer = dielectric * own.specular;
    const passing = 1 - own.transmission;
    const under = 1 - Math.max(...f0);
    const every = [
      base.map((x) => passing * layer * x * under),
      f0.map((x, c) => layer * x + value.metallic * base[c]),
      f0.map((x, c) => layer * (1 - x) + value.metallic * (1 - base[c])),
      base.map((x) => passing * dielectric * (1 - own.specular) * x),
    ];
    this.write(part, every);
    const factors = { base, f0, specular: own.specular, metallic: value.metallic, roughness: value.roughness, passing };
    return { weightStep: 0, log: Math.log(Math.max(value.roughness, 1e-3 ** 0.5)), factors };
  }
  write(part, every) {
    const gl = this.gl;
    const key = JSON.stringify(every);
    if (key === part.written) return;
    part.family.terms.forEach((term, k) => {
      const at = part.weightStart + k;
      gl.activeTexture(gl.TEXTURE0 + this.textures.weights.unit);
      gl.texSubImage2D(
        gl.TEXTURE_2D,
        0,
        at % WIDTH,
        Math.floor(at / WIDTH),
        1,
        1,
        gl.RGBA,
        gl.FLOAT,
        Float32Array.of(...every[term].map((x) => x / part.family.scale[k]), 0),
      );
    });
    part.written = key;
  }
}

// The texels of an image from its file, as bytes of so many channels.
async function decoded(file, { width, height, channels }) {
  const bitmap = await createImageBitmap(new Blob([file]), { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(bitmap, 0, 0);
  const { data } = context.getImageData(0, 0, width, height);
  const result = new Uint8Array(width * height * channels);
  for (let i = 0, to = 0; i < data.length; i += 4) for (let c = 0; c < channels; c++) result[to++] = data[i + c];
  return result;
}

// Runs of corners of faces: of a part with holes or of translucent material, or of any others.
function runs(parts, face, vertices) {
  const number = new Int32Array(vertices).fill(-1);
  const result = [];
  parts.forEach((part, i) => {
    if (part.opacity) number.fill(i, part.first, part.first + part.count);
  });
  for (let i = 0; i < face.length; i += 3) {
    const part = parts[number[face[i]]] ?? null;
    const last = result.at(-1);
    if (last && last.part === part) last.count += 3;
    else result.push({ part, first: i, count: 3 });
  }
  return result;
}

// Means of visibility at all scales, from the bits of texels: see `pyramid` in jaxprt/systems/lobe/pyramid.py. A byte has
// two rows of four texels, and the bytes of all vertices of a part stand together. Frames come between slices of the
// work.
async function means(content, bits, index) {
  const { texelEdge: size, edges, stride } = content;
  const result = new Uint8Array(4 * Math.ceil((content.means + 1) / 4));
  const { area } = grid(size);
  const across = size / 4;
  const whole = [];
  const table = new Float32Array(256 * (size / 2) * across);
  for (let edge = across; edge >= 1; edge /= 2)
    whole.push({ edge, area: grid(edge).area, value: new Float32Array(6 * edge * edge) });
  let due = performance.now() + SLICE;
  const rest = async () => {
    await pause();
    due = performance.now() + SLICE;
  };
  for (let byte = 0; byte < (size / 2) * across; byte++)
    for (let bit = 0; bit < 8; bit++) {
      if (performance.now() > due) await rest();
      const row = 2 * Math.floor(byte / across) + ((bit >> 1) & 1);
      const column = 4 * (byte % across) + 2 * (bit >> 2) + (bit & 1);
      const share = area[row * size + column] / whole[0].area[(row >> 2) * across + (column >> 2)];
      for (let value = 0; value < 256; value++) if ((value >> bit) & 1) table[256 * byte + value] += share;
    }
  for (const part of content.parts)
    for (let vertex = 0; part.lobes && vertex < part.count; vertex++) {
      if (performance.now() > due) await rest();
      const { value: finest } = whole[0];
      for (let face = 0, to = 0, byte = 0; face < 6; face++)
        for (let row = 0; row < across; row++, byte += across)
          for (let column = 0; column < across; column++, to++, byte++) {
            const on = byte - face * (size / 2) * across;
            const from = part.bitStart + byte * part.count + vertex;
            finest[to] = table[256 * on + bits[from]] + table[256 * (on + across) + bits[from + across * part.count]];
          }
      for (let level = 1; level < whole.length; level++) {
        const { edge, area: large, value } = whole[level];
        const { area: small, value: fine } = whole[level - 1];
        for (let row = 0, to = 0; row < 6 * edge; row++)
          for (let column = 0; column < edge; column++, to++) {
            const a = 4 * row * edge + 2 * column;
            const b = a + 2 * edge;
            value[to] =
              (fine[a] * small[a] + fine[a + 1] * small[a + 1] + fine[b] * small[b] + fine[b + 1] * small[b + 1]) /
              large[to];
          }
      }
      edges.forEach((edge, level) => {
        const { value } = whole.find((each) => each.edge === edge);
        const from = index.get(edge);
        const m = edge + 2;
        const to = part.pyramidStart + vertex * stride + content.starts[level];
        for (let i = 0; i < 6 * m * m; i++) result[to + i] = 255 * value[from[i]] + 0.5;
        for (let face = 0; face < 6; face++)
          for (let k = 0; k < 4; k++) {
            const [row, column] = [k >> 1 ? m - 1 : 0, k & 1 ? m - 1 : 0];
            const [up, left] = [row ? row - 1 : 1, column ? column - 1 : 1];
            const at = (y, x) => value[from[(face * m + y) * m + x]];
            result[to + (face * m + row) * m + column] =
              (255 * (at(up, left) + at(up, column) + at(row, left))) / 3 + 0.5;
          }
      });
    }
  return result;
}

// The normals of a map, whose lengths matter where they are means. Lengths that are off one by less than bytes tell
// are one.
function normals(data) {
  const result = new Float32Array((data.length / 3) * 4);
  for (let i = 0, to = 0; i < data.length; i += 3, to += 4) {
    const way = [0, 1, 2].map((c) => data[i + c] / 127 - 1);
    const length = Math.hypot(...way);
    const scale = length > 0.99 ? 1 / length : 1;
    for (let c = 0; c < 3; c++) result[to + c] = scale * way[c];
  }
  return result;
}

function placeOf(gl, program, name) {
  const known = (program.places ??= new Map());
  if (!known.has(name)) known.set(name, gl.getUniformLocation(program, name));
  return known.get(name);
}
