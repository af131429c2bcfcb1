// Shades the pixels of a picture on the GPU: first which triangle each pixel shows, then its light, part by part.
// Translucent surfaces are shaded before it, layer by layer from the eye on, and each hides its share of what follows.

import { clamp, floats } from "./common.js";
import { AT, WHOLE } from "./shading.js";

const RASTER = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform usampler2D faces; uniform sampler2D place, opacities; uniform mat4 matrix; flat out uvec3 triangle; out vec2 part; out vec3 clear, spot, upright;
${AT}
void main() {
  int corner = gl_VertexID % 3;
  triangle = texelFetch(faces, at(gl_VertexID / 3), 0).rgb;
  part = vec2(corner == 0, corner == 1);
  clear = texelFetch(opacities, at(int(triangle[corner])), 0).xyz;
  spot = texelFetch(place, at(2 * int(triangle[corner])), 0).xyz;
  upright = texelFetch(place, at(2 * int(triangle[corner]) + 1), 0).xyz;
  gl_Position = matrix * vec4(spot, 1);
}`;
const STENCIL = `
uniform sampler2D stencil; uniform bool holes, imaged; uniform float cutoff;
float opacityOf(vec3 clear) { return clear.z * (imaged ? textureLod(stencil, vec2(clear.x, 1. - clear.y), 0.).r : 1.); }`;
const TRIANGLE = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; flat in uvec3 triangle; in vec2 part; in vec3 clear; out uvec4 o;
uniform sampler2D solid, before; uniform bool peeled;
${STENCIL}
void main() {
  float opacity = 1.;
  if (holes) {
    opacity = opacityOf(clear);
    ivec2 here = ivec2(gl_FragCoord.xy);
    if (cutoff >= 0.) {
      if (opacity < cutoff) discard;
      opacity = 1.;
    } else if (opacity < ${1 / 512} || gl_FragCoord.z >= texelFetch(solid, here, 0).r || (peeled && gl_FragCoord.z <= texelFetch(before, here, 0).r)) discard;
  }
  uint hides = uint(255. * opacity + .5) << 24;
  o = gl_FrontFacing ? uvec4(triangle.x | hides, triangle.yz, packUnorm2x16(part)) : uvec4(0xfffffeu | hides, 0u, 0u, 0u);
}`;
// Coarse colors on the surfaces of each pixel: from the pixels about it that show the same surface.
const SHARP = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D; in vec3 clear, spot, upright; out vec4 o;
uniform sampler2D image, place; uniform usampler2D shown; uniform ivec2 size; uniform float step, width; uniform vec3 eye; // width: of a coarse pixel at a distance of one
${AT} ${STENCIL}
void main() {
  if (holes && opacityOf(clear) < cutoff) discard;
  o = vec4(0, 0, 0, 1);
  if (!gl_FrontFacing) return;
  vec2 middle = gl_FragCoord.xy / step - .5, low = floor(middle), part = middle - low;
  vec4 sum = vec4(0);
  float total = 0., reach = width * distance(spot, eye);
  vec3 normal = normalize(upright);
  for (int ring = 0; ring < 2 && total == 0.; ring++) for (int j = -ring; j < 2 + ring; j++) for (int i = -ring; i < 2 + ring; i++) {
    ivec2 pixel = clamp(ivec2(low) + ivec2(i, j), ivec2(0), size - 1);
    int vertex = int(texelFetch(shown, pixel, 0).r & 0xffffffu);
    if (vertex >= 0xfffffe) continue;
    vec3 facing = texelFetch(place, at(2 * vertex + 1), 0).xyz;
    vec2 near = max(1. - abs(vec2(i, j) - part), 0.);
    float off = dot(facing, spot - texelFetch(place, at(2 * vertex), 0).xyz) / reach, like = max(dot(facing, normal), 0.);
    float weight = (near.x * near.y + 1e-3) * (pow(like, 8.) + 1e-3) / (1. + off * off);
    sum += weight * texelFetch(image, pixel, 0);
    total += weight;
  }
  if (total == 0.) discard;
  o = sum / total;
}`;
const BARE = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D; uniform usampler2D shown; out vec4 o;
void main() { // pixels without light: backs are black, and the others show the sky
  uint both = texelFetch(shown, ivec2(gl_FragCoord.xy), 0).r, vertex = both & 0xffffffu;
  if (vertex < 0xfffffeu) discard;
  o = vec4(0, 0, 0, vertex == 0xfffffeu ? float(both >> 24) / 255. : 0.);
}`;
const COPY = `#version 300 es
precision highp float; uniform sampler2D image; out vec4 o;
void main() { o = texelFetch(image, ivec2(gl_FragCoord.xy), 0); }`;
const EMPTY = Uint32Array.of(0xffffffff, 0, 0, 0);
const LAYERS = 4; // translucent surfaces that a pixel shows
const STRIPS = 8; // of a picture with layers, at most

const PIXEL_EDGES = [0, 8, 4, 2, 1]; // while something moves: colors at vertices, or edges of pixels
const SLUGGISH = 45;
const BRISK = 22; // milliseconds of a frame from which on there are fewer pixels, and up to which more are tried
const PAUSE = 150; // milliseconds without a change until a picture at rest begins
const PATIENCE = 3000; // milliseconds of a first picture at rest after which it is left to Python, where there is one
// Where in a pixel samples lie, from its middle: the middle itself, and then eight on as many rows and columns.
const JITTER = [
  [0, 0],
  [1, -3],
  [-1, 3],
  [5, 1],
  [-3, -5],
  [-5, 5],
  [-7, -1],
  [3, 7],
  [7, -7],
].map((each) => each.map((x) => x / 16));

export class Pixels {
  constructor(gl, piece, backs) {
    // of faces after the first `backs` no backs are seen
    this.gl = gl;
    this.piece = piece;
    this.backs = backs;
    this.level = 1; // of PIXEL_EDGES
    this.least = 0;
    this.sample = this.row = 0; // of the picture at rest
    this.patient = false; // whether slow frames are shown in any case
    this.trial = PIXEL_EDGES.map(() => ({ after: 0, pause: 2000 })); // when a finer level may be tried again
    this.quick = 0; // quick frames one after another
    this.strip = 1 << 14; // pixels at rest that are shaded in one call
    this.stats = { level: PIXEL_EDGES[this.level], samples: 0, ms: 0 };
    this.build();
  }
  build() {
    const { gl, piece } = this;
    piece.build(gl);
    this.raster = piece.link(RASTER, TRIANGLE);
    this.rest = piece.link(WHOLE, BARE);
    this.copy = piece.link(WHOLE, COPY);
    this.sharp = piece.link(RASTER, SHARP);
    this.unit = piece.unit++;
    this.layerUnit = piece.unit++;
    this.solidUnit = piece.unit++;
    this.beforeUnit = piece.unit++;
    this.stencilUnit = piece.unit++;
    piece.ints(this.sharp, { image: 0, shown: this.unit, stencil: this.stencilUnit });
    gl.useProgram(this.raster);
    piece.ints(this.raster, { solid: this.solidUnit, before: this.beforeUnit, stencil: this.stencilUnit });
    this.floats = floats(gl);
    this.images = {};
    this.triangles = this.many = null;
    this.fence = null;
    this.used = new Set(); // levels that have been seen once
    this.shown = null; // the image that is seen; none while colors at vertices are
    this.stale = Boolean(this.message);
    this.boxes = piece.content.parts.map(({ first, count }) => {
      const low = [Infinity, Infinity, Infinity];
      const high = [-Infinity, -Infinity, -Infinity];
      for (let i = 3 * first; i < 3 * (first + count); i++) {
        low[i % 3] = Math.min(low[i % 3], piece.position[i]);
        high[i % 3] = Math.max(high[i % 3], piece.position[i]);
      }
      return [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high : low)[axis]));
    });
  }
  close() {
    const { gl, piece } = this;
    for (const { handle, frame } of Object.values(this.images)) {
      gl.deleteTexture(handle);
      gl.deleteFramebuffer(frame);
    }
    this.release();
    this.forget();
    if (this.fence) gl.deleteSync(this.fence.sync);
    piece.close();
  }
  release() {
    const { gl, triangles } = this;
    if (!triangles) return;
    for (const { handle, depths, frames } of triangles.sets) {
      for (const texture of [handle, ...depths]) gl.deleteTexture(texture);
      for (const frame of frames) gl.deleteFramebuffer(frame);
    }
    this.triangles = null;
  }
  // Whether frames take long even where they are coarsest.
  get slow() {
    return !this.patient && this.level <= this.least && this.used.has(this.level) && this.stats.ms > 2 * SLUGGISH;
  }
  // The picture has changed: its light, view, materials or size.
  change(message) {
    this.message = message;
    this.stale = true;
    this.stats.samples = 0;
  }
  // A picture of the light, which smooth metals show.
  see(sky) {
    const { piece } = this;
    if (piece.sky === sky) return;
    piece.sky = sky;
    if (piece.content.glossy && this.message) this.change(this.message);
  }
  // Whether the GPU is still at what it was given.
  get busy() {
    return this.held || this.working;
  }
  get working() {
    const { gl, fence } = this;
    if (!fence) return false;
    if (gl.getSyncParameter(fence.sync, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    gl.deleteSync(fence.sync);
    this.fence = null;
    this.learn(performance.now() - fence.since, fence.moving);
    return false;
  }
  sent(moving) {
    const { gl } = this;
    this.fence = { sync: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), since: performance.now(), moving };
    gl.flush();
  }
  learn(ms, moving) {
    if (!moving) {
      this.strip = clamp(ms < BRISK ? 2 * this.strip : ms > 2 * SLUGGISH ? this.strip / 2 : this.strip, 4096, 1 << 22);
      return;
    }
    this.stats.ms = ms;
    if (!this.used.has(this.level)) {
      this.used.add(this.level);
      return;
    } // with the compiler's work
    const now = performance.now();
    const finer = this.trial[this.level + 1];
    this.quick = ms < BRISK ? this.quick + 1 : 0;
    if (ms > SLUGGISH && this.level > this.least) {
      const { pause } = this.trial[this.level];
      this.trial[this.level] = { after: now + pause, pause: Math.min(2 * pause, 60000) };
      this.level--;
    } else if (finer && this.floats && this.quick > 2 && now > finer.after) {
      this.level++;
      this.quick = 0;
    }
  }
  // Gives the GPU the work of a frame. True if there is more to do.
  work(now, matrix, width, height, python) {
    this.fresh = false; // whether more is seen after it
    this.least =
      this.floats && (this.piece.opacities.length || this.piece.count > (width * height) / PIXEL_EDGES[1] ** 2) ? 1 : 0; // vertices show no holes, and may be more than pixels
    this.level = this.floats ? Math.max(this.level, this.least) : 0;
    if (this.stale) {
      this.stale = false;
      this.since = now + PAUSE;
      this.sample = this.row = 0;
      // At rest pixels become finer step by step.
      this.steps = this.sharpens ? PIXEL_EDGES.filter((each, level) => each > 1 && level > this.level) : [];
      this.move(matrix, width, height);
      return true;
    }
    if (!this.message || !this.floats || this.sample >= JITTER.length) return false;
    if (now < this.since) return true;
    if (python && !this.steps.length && !this.sample && now - this.since > PATIENCE) return false;
    this.refine(matrix, width, height);
    return this.sample < JITTER.length;
  }
  move(matrix, width, height) {
    const step = PIXEL_EDGES[this.level];
    this.fresh = true;
    this.stats.level = step;
    if (step) {
      const size = [width, height].map((x) => Math.ceil(x / step));
      this.piece.shine(this.message);
      this.find(matrix, ...size, width, height);
      const image = this.image(`step ${step}`, ...size);
      this.shade(image, matrix, 0, size[1], 1);
      this.shown = step > 1 && this.sharpens ? this.sharpened(image, matrix, step, width, height) : image;
    } else {
      this.piece.vertices(this.message);
      this.shown = null;
    }
    this.sent(true);
  }
  // One strip of the picture at rest: of finer pixels, or of a sample, which counts as much as those before.
  refine(matrix, width, height) {
    this.piece.shine(this.message);
    const step = this.steps[0] ?? 1;
    const size = [width, height].map((x) => Math.ceil(x / step));
    const moved = step > 1 ? matrix : jittered(matrix, JITTER[this.sample], width, height);
    if (!this.row) this.find(moved, ...size, width, height);
    const image = this.image(step > 1 ? `step ${step}` : "rest", ...size);
    const rows = this.rows(this.row, ...size);
    this.shade(image, moved, this.row, rows, step > 1 ? 1 : 1 / (this.sample + 1));
    this.row += rows;
    this.fresh = this.row >= size[1];
    if (this.fresh) {
      this.row = 0;
      this.shown = step > 1 ? this.sharpened(image, matrix, step, width, height) : image;
      if (step > 1) this.stats.level = this.steps.shift();
      else this.stats.samples = ++this.sample;
    }
    this.sent(false);
  }
  // A framebuffer of several samples a pixel, which are drawn together.
  multisampled(width, height) {
    const { gl, many } = this;
    if (many?.width === width && many.height === height) return many.frame;
    this.forget();
    const frame = gl.createFramebuffer();
    const buffers = [
      [gl.RGBA16F, gl.COLOR_ATTACHMENT0],
      [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT],
    ].map(([form, place]) => {
      const handle = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, handle);
      gl.renderbufferStorageMultisample(
        gl.RENDERBUFFER,
        Math.min(4, gl.getInternalformatParameter(gl.RENDERBUFFER, gl.RGBA16F, gl.SAMPLES)[0] ?? 0),
        form,
        width,
        height,
      );
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, handle);
      return handle;
    });
    this.many = { frame, buffers, width, height };
    return frame;
  }
  forget() {
    const { gl, many } = this;
    if (many) gl.deleteFramebuffer(many.frame);
    for (const each of many?.buffers ?? []) gl.deleteRenderbuffer(each);
    this.many = null;
  }
  // Whether coarse pixels can be made fine along the edges of surfaces.
  get sharpens() {
    return this.floats && !this.piece.blends;
  }
  // A picture of fine edges with the colors of coarse pixels, whose triangles have just been found.
  sharpened(coarse, matrix, step, width, height) {
    const { gl, piece, sharp } = this;
    const image = this.image("sharp", width, height);
    const frame = this.multisampled(width, height);
    gl.useProgram(sharp);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, coarse.handle);
    gl.uniform2i(piece.at("size", sharp), coarse.width, coarse.height);
    gl.uniform1f(piece.at("step", sharp), step);
    gl.uniform1f(piece.at("width", sharp), (2 * step * Math.tan(this.message.field_of_view / 2)) / height);
    gl.uniform3fv(piece.at("eye", sharp), this.message.eye);
    this.rasterize(frame, matrix, width, height, false, sharp);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, frame);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, image.frame);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    piece.finish();
    return image;
  }
  // Rows of the next strip. Each has layers of its own, whatever its height, so that with layers there are few.
  rows(row, width, height) {
    return clamp(
      Math.floor(this.strip / width),
      this.piece.blends ? Math.min(Math.ceil(height / STRIPS), height - row) : 1,
      height - row,
    );
  }
  // A picture of a size of its own, as at rest. Frames wait for it. `dispose` is to be called once it has been read.
  async whole(matrix, width, height) {
    const { gl } = this;
    while (this.busy) await new Promise(requestAnimationFrame);
    this.held = true;
    try {
      for (const [sample, jitter] of JITTER.entries()) {
        const moved = jittered(matrix, jitter, width, height);
        this.piece.shine(this.message);
        this.find(moved, width, height, width, height);
        if (gl.getError() === gl.OUT_OF_MEMORY)
          throw new Error(`this browser's GPU has no memory for ${width} x ${height} pixels`);
        const image = this.image("saved", width, height);
        for (let row = 0, rows; row < height; row += rows) {
          rows = this.rows(row, width, height);
          this.shade(image, moved, row, rows, 1 / (sample + 1));
          this.sent(false);
          while (this.working) await new Promise(requestAnimationFrame);
        }
      }
      return this.images.saved;
    } finally {
      this.held = false;
      this.stale = true; // the triangles of frames are lost
    }
  }
  dispose() {
    const { handle, frame } = this.images.saved;
    this.gl.deleteTexture(handle);
    this.gl.deleteFramebuffer(frame);
    delete this.images.saved;
  }
  image(name, width, height) {
    const gl = this.gl;
    const held = this.images[name];
    if (held?.width === width && held.height === height) return held;
    if (held) {
      gl.deleteTexture(held.handle);
      gl.deleteFramebuffer(held.frame);
    }
    const handle = gl.createTexture();
    const frame = gl.createFramebuffer();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, handle);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, handle, 0);
    return (this.images[name] = { handle, frame, width, height });
  }
  // Textures of triangles with depths of their own, of which one is drawn to while another one is read.
  targets(width, height, unit, depthUnits) {
    const { gl } = this;
    const texture = (form, to) => {
      const handle = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0 + to);
      gl.bindTexture(gl.TEXTURE_2D, handle);
      gl.texStorage2D(gl.TEXTURE_2D, 1, form, width, height);
      for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
        gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
      return handle;
    };
    const handle = texture(gl.RGBA32UI, unit);
    const depths = depthUnits.map((to) => texture(gl.DEPTH_COMPONENT32F, to));
    const frames = depths.map((depth) => {
      const frame = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, handle, 0);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);
      return frame;
    });
    return { handle, depths, frames };
  }
  // The vertices of the triangle that each pixel shows, and where the pixel lies between them.
  find(matrix, columns, rows, width, height) {
    if (this.triangles?.width !== width || this.triangles.height !== height) {
      this.release();
      const sets = [this.targets(width, height, this.unit, [this.solidUnit])];
      if (this.piece.blends) sets.push(this.targets(width, height, this.layerUnit, [this.beforeUnit, this.beforeUnit]));
      this.triangles = { sets, width, height };
    }
    const { gl } = this;
    const [{ frames, depths }] = this.triangles.sets;
    const bind = (texture) => {
      gl.activeTexture(gl.TEXTURE0 + this.solidUnit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    };
    bind(null); // what is drawn to must not be read
    this.rasterize(frames[0], matrix, columns, rows, false);
    bind(depths[0]);
  }
  // Draws the triangles of solid parts, or those of translucent ones.
  rasterize(frame, matrix, columns, rows, blending, raster = this.raster) {
    const { gl, piece } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.viewport(0, 0, columns, rows);
    if (raster === this.raster) gl.clearBufferuiv(gl.COLOR, 0, EMPTY);
    else gl.clearBufferfv(gl.COLOR, 0, new Float32Array(4));
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(raster);
    gl.bindVertexArray(piece.empty);
    gl.uniformMatrix4fv(piece.at("matrix", raster), false, matrix);
    drawSides(gl, this.backs, piece.face.length, (vertices) => {
      for (const { part, first, count } of piece.runs) {
        if (first >= vertices || part?.opacity.cutoff < 0 !== blending) continue;
        piece.ints(raster, { holes: part ? 1 : 0, imaged: part?.stencil ? 1 : 0 });
        if (part) gl.uniform1f(piece.at("cutoff", raster), part.opacity.cutoff);
        if (part?.stencil) {
          gl.activeTexture(gl.TEXTURE0 + this.stencilUnit);
          gl.bindTexture(gl.TEXTURE_2D, part.stencil);
        }
        gl.drawArrays(gl.TRIANGLES, first, Math.min(count, vertices - first));
      }
    });
  }
  // Shades rows of an image; `weight` is what the new colors count beside the old ones.
  shade(image, matrix, row, rows, weight) {
    const { gl, piece } = this;
    gl.bindVertexArray(piece.empty);
    gl.enable(gl.SCISSOR_TEST);
    const layers = piece.blends && this.layers(image, matrix, row, rows);
    this.on(image, row, rows);
    if (weight < 1) {
      gl.enable(gl.BLEND);
      gl.blendColor(0, 0, 0, weight);
      gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
    }
    if (layers) {
      gl.useProgram(this.copy);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, layers.handle);
      gl.uniform1i(piece.at("image", this.copy), 0);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    } else this.surfaces(image, matrix, row, rows, this.unit, false);
    gl.disable(gl.BLEND);
    piece.finish();
  }
  // Rows of translucent surfaces from the eye on, and of what is solid behind them, in an image of their own.
  layers({ width, height }, matrix, row, rows) {
    const { gl } = this;
    const image = this.image("layers", width, height);
    const surfaces = (unit, blending) => {
      this.on(image, row, rows);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
      this.surfaces(image, matrix, row, rows, unit, blending);
      gl.disable(gl.BLEND);
    };
    this.on(image, row, rows);
    gl.clearBufferfv(gl.COLOR, 0, new Float32Array(4));
    for (let layer = 0; layer < LAYERS; layer++) {
      gl.scissor(0, row - 1, width, rows + 2); // textures are read by what is beside a pixel
      this.peel(layer, matrix, width, height);
      surfaces(this.layerUnit, true);
    }
    surfaces(this.unit, false);
    return image;
  }
  on({ frame, width, height }, row, rows) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.viewport(0, 0, width, height);
    gl.scissor(0, row, width, rows);
  }
  // The next translucent surfaces from the eye on: behind the last ones, and before all that is solid.
  peel(layer, matrix, columns, rows) {
    const { gl, piece } = this;
    const { frames, depths } = this.triangles.sets[1];
    const now = layer % 2;
    gl.activeTexture(gl.TEXTURE0 + this.beforeUnit);
    gl.bindTexture(gl.TEXTURE_2D, depths[1 - now]);
    gl.useProgram(this.raster);
    gl.uniform1i(piece.at("peeled", this.raster), layer > 0 ? 1 : 0);
    this.rasterize(frames[now], matrix, columns, rows, true);
  }
  // Shades what `shown` has: backs and the sky first, then the solid parts or the translucent ones.
  surfaces({ width, height }, matrix, row, rows, shown, blending) {
    const { gl, piece } = this;
    const { pixel } = piece.programs;
    gl.useProgram(this.rest);
    gl.uniform1i(piece.at("shown", this.rest), shown);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.useProgram(pixel);
    gl.uniform1i(piece.at("shown", pixel), shown);
    piece.shade(pixel, this.message, (part) => {
      if (part.opacity?.cutoff < 0 !== blending) return;
      const [left, low, right, high] = bounds(this.boxes[piece.content.parts.indexOf(part)], matrix, width, height);
      const [from, to] = [Math.max(low, row), Math.min(high, row + rows)];
      if (left >= right || from >= to) return;
      gl.scissor(left, from, right - left, to - from);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    });
  }
  // Colors and coverage of the picture at rest, from its lowest row.
  read() {
    const { gl } = this;
    const { frame, width, height } = this.images.rest;
    const data = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, data);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return { data, width, height };
  }
}

// Draws faces with what is seen of their backs. Backs lie a little deeper: at silhouettes they are as deep as the
// fronts beside them, and would show as dots.
export function drawSides(gl, backs, count, draw) {
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.CULL_FACE);
  gl.enable(gl.POLYGON_OFFSET_FILL);
  gl.polygonOffset(2, 4);
  gl.cullFace(gl.FRONT);
  draw(backs);
  gl.disable(gl.POLYGON_OFFSET_FILL);
  gl.cullFace(gl.BACK);
  draw(count);
  gl.disable(gl.CULL_FACE);
  gl.disable(gl.DEPTH_TEST);
}

// The matrix of a camera whose pixels lie a little aside.
function jittered(matrix, jitter, width, height) {
  const moved = Float32Array.from(matrix);
  for (let j = 0; j < 4; j++)
    for (let c = 0; c < 2; c++) moved[4 * j + c] += ((2 * jitter[c]) / [width, height][c]) * matrix[4 * j + 3];
  return moved;
}

// The rectangle of pixels in which a box is seen: left, low, right, high.
function bounds(box, matrix, width, height) {
  const result = [Infinity, Infinity, -Infinity, -Infinity];
  for (const corner of box) {
    const [x, y, , w] = [0, 1, 2, 3].map(
      (k) => matrix[k] * corner[0] + matrix[4 + k] * corner[1] + matrix[8 + k] * corner[2] + matrix[12 + k],
    );
    if (w <= 0) return [0, 0, width, height];
    [x, y].forEach((each, c) => {
      const place = ((each / w + 1) / 2) * [width, height][c];
      result[c] = Math.min(result[c], place);
      result[2 + c] = Math.max(result[2 + c], place);
    });
  }
  return result.map((x, i) => clamp(i < 2 ? Math.floor(x) - 1 : Math.ceil(x) + 1, 0, i % 2 ? height : width));
}
