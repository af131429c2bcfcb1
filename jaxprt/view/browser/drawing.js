// Draws the sky, the mesh with colors at its vertices, and pictures at rest.

import { clamp, half } from "./common.js";
import { toHalf } from "./lights.js";
import { WIDTH } from "./shading.js";
import { drawSides } from "./pixels.js";

const MOST_STOPS = 20; // luminances are measured from its negative on
const VERTEX = `#version 300 es
layout(location=0) in vec3 position; layout(location=1) in vec3 color; uniform mat4 matrix; out vec3 c;
void main(){ c = color; gl_Position = matrix * vec4(position, 1); }`;
const COLORED = `#version 300 es
precision highp usampler2D; layout(location=0) in vec3 position; uniform usampler2D color; uniform mat4 matrix; out vec3 c;
void main(){ uvec2 packed = texelFetch(color, ivec2(gl_VertexID & ${WIDTH - 1}, gl_VertexID >> 12), 0).rg;
  c = vec3(unpackHalf2x16(packed.r), unpackHalf2x16(packed.g).r); gl_Position = matrix * vec4(position, 1); }`;
const DISPLAY = `
uniform float gain; uniform bool encoded; uniform int tone;
vec3 hable(vec3 x){ return (x * (.15 * x + .05) + .004) / (x * (.15 * x + .5) + .06) - .02 / .3; }
vec3 aces(vec3 x){ x = x / .6 * mat3(.59719, .35458, .04823, .076, .90834, .01566, .0284, .13383, .83777);
  x = (x * (x + .0245786) - .000090537) / (x * (.983729 * x + .432951) + .238081);
  return x * mat3(1.60475, -.53108, -.07367, -.10208, 1.10813, -.00605, -.00327, -.07276, 1.07602); }
vec3 agx(vec3 x){
  const mat3 back = mat3(1.6605, -.5876, -.0728, -.1246, 1.1329, -.0083, -.0182, -.1006, 1.1187);
  x = max(x * inverse(back), 0.) * mat3(.856627153, .0951212405, .0482516061, .137318973, .761241991, .101439036, .111898213, .0767994186, .811302368);
  x = clamp((log2(max(x, 1e-10)) + 12.47393) / 16.499999, 0., 1.);
  x = (((((15.5 * x - 40.14) * x + 31.96) * x - 6.868) * x + .4298) * x + .1191) * x - .00232;
  x = x * inverse(mat3(.899796956, .0871996192, .0130034249, .111420989, .875575586, .0130034249, .111420989, .0871996192, .801379392));
  return pow(max(x, 1e-6), vec3(2.2)) * back; }
vec3 neutral(vec3 x){ float least = min(x.r, min(x.g, x.b));
  x -= least < .08 ? least - 6.25 * least * least : .04;
  float peak = max(max(x.r, max(x.g, x.b)), .76), high = 1. - .0576 / (peak - .52), share = 1. / (.15 * (peak - high) + 1.);
  return mix(vec3(high), x * high / peak, share); }
vec3 measured(vec3 x){ // the logarithm of luminance, in two bytes
  float code = clamp(log2(max(dot(x, vec3(.2126, .7152, .0722)), 1e-20)) * 255. / ${2 * MOST_STOPS}. + 127.5, 0., 255.);
  return vec3(floor(code) / 255., fract(code), 0.); }
// The curves of jaxprt/image/tonemap.py. Matrices stand in rows, to the right of vectors.
vec3 display(vec3 x){ if (encoded) return x; x = clamp(x * gain, 0., 1e6); if (tone < 0) return measured(x);
  x = clamp(tone == 1 ? hable(2. * x) / hable(vec3(11.2)) : tone == 2 ? agx(x) : tone == 3 ? aces(x) : tone == 4 ? neutral(x) : x, 0., 1.);
  return mix(12.92 * x, 1.055 * pow(max(x, vec3(1e-6)), vec3(1. / 2.4)) - .055, step(.0031308, x)); }`;
const MESH = `#version 300 es
precision highp float; in vec3 c; out vec4 o; ${DISPLAY}
void main(){ o = vec4(gl_FrontFacing ? display(c) : vec3(0), 1); } // backs are black, as in pictures`;
const QUAD = `#version 300 es
out vec2 at; void main(){ at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.; gl_Position = vec4(at * 2. - 1., .99999, 1); }`;
const TOWARDS = `vec2 place() { vec3 d = normalize(ray * vec3(at * 2. - 1., 1));
  return vec2(.5 - (atan(d.x, d.z) - turn) / 6.283185307, .5 - asin(clamp(d.y, -1., 1.)) / 3.141592654); }`;
const SKY = `#version 300 es
precision highp float; in vec2 at; out vec4 o; uniform sampler2D image; uniform mat3 ray; uniform float turn, lod; ${DISPLAY}
${TOWARDS}
void main(){ o = vec4(display(textureLod(image, place(), lod).rgb), 1); }`; // of derivatives there would be a seam
const SHADED = `#version 300 es
precision highp float; in vec2 at; out vec4 o; uniform sampler2D image; ${DISPLAY}
void main(){ vec4 c = textureLod(image, at, 0.); o = vec4(display(c.rgb / max(c.a, 1e-3)), c.a); }`; // colors times coverage
const THROUGH = `#version 300 es
precision highp float; in vec2 at; out vec4 o; uniform sampler2D image, behind; uniform mat3 ray; uniform float turn, lod, bright; ${DISPLAY}
${TOWARDS}
void main(){ vec4 c = textureLod(image, at, 0.); o = vec4(display(c.rgb + (1. - c.a) * bright * textureLod(behind, place(), lod).rgb), 1); }`;
const STILL = `#version 300 es
precision highp float; in vec2 at; out vec4 o; uniform sampler2D image; uniform float alpha; ${DISPLAY}
void main(){ vec4 c = textureLod(image, vec2(at.x, 1. - at.y), 0.); o = vec4(display(c.rgb), alpha * c.a); }`;

export const BACKGROUNDS = ["light", "blurred light", "color", "none"]; // what is seen behind the scene
const BLURRED = 32; // rows of the blurred light
const WIDE = 0.2; // radians: the deviation by which it is blurred
export const TONES = ["srgb", "filmic", "agx", "aces", "neutral"];

const MOST_PIXELS = 2 ** 24; // of a picture that is saved
const FADE = 200; // milliseconds in which a picture at rest appears

export class Drawing {
  constructor(canvas) {
    this.canvas = canvas;
    this.gpu = null; // shades pixels; null where colors come from Python
    this.unexposed = false; // whether the next picture is measured
    this.exposed = null; // what is called with its exposure
    this.coarseSky = null;
    this.encoded = this.drawn = false; // whether colors are those of the display, and whether there are any
    this.scale = 1;
    const gl = (this.gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true }));
    if (!gl) throw new Error("this browser has no WebGL2, which the viewer needs");
    this.build();
  }
  build() {
    const gl = this.gl;
    gl.programs = new Map(); // those of a context that was lost are gone
    const program = (vertex, fragment) => {
      const handle = gl.createProgram();
      for (const text of [vertex, fragment]) {
        const shader = gl.createShader(text === vertex ? gl.VERTEX_SHADER : gl.FRAGMENT_SHADER);
        gl.shaderSource(shader, text);
        gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
          throw new Error(gl.getShaderInfoLog(shader));
        gl.attachShader(handle, shader);
      }
      gl.linkProgram(handle);
      return { handle, at: (name) => gl.getUniformLocation(handle, name) };
    };
    this.mesh = program(VERTEX, MESH);
    this.colored = program(COLORED, MESH);
    this.shaded = program(QUAD, SHADED);
    this.sky = program(QUAD, SKY);
    this.through = program(QUAD, THROUGH);
    this.still = program(QUAD, STILL);
    this.empty = gl.createVertexArray();
    this.array = gl.createVertexArray();
    this.position = gl.createBuffer();
    this.color = gl.createBuffer();
    this.index = gl.createBuffer();
    this.seen = this.blurredImage = null; // the picture of the light
    this.gpu?.build();
    this.stills = []; // pictures at rest: the last one appears over the one before
  }
  setMesh(position, face, backs) {
    // of faces after the first `backs` no backs are seen
    const gl = this.gl;
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.position);
    gl.bufferData(gl.ARRAY_BUFFER, position, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.index);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, face, gl.STATIC_DRAW);
    this.count = face.length;
    this.backs = 3 * (backs ?? face.length / 3);
    this.drawn = false;
  }
  setColor(data, encoded, scale) {
    const gl = this.gl;
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.color);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STREAM_DRAW);
    gl.enableVertexAttribArray(1);
    if (encoded) gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 3, 0);
    else gl.vertexAttribPointer(1, 3, gl.HALF_FLOAT, false, 6, 0);
    [this.encoded, this.scale, this.drawn] = [encoded, scale, true];
    this.given = [data, encoded, scale];
  }
  texture(data, width, height, encoded, repeat, alpha = false) {
    const gl = this.gl;
    const handle = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, handle);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const [form, bytes, halves] = alpha ? [gl.RGBA, gl.RGBA8, gl.RGBA16F] : [gl.RGB, gl.RGB8, gl.RGB16F];
    const [inside, type] = encoded ? [bytes, gl.UNSIGNED_BYTE] : [halves, gl.HALF_FLOAT];
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, form, type, data);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, repeat ? gl.REPEAT : gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return handle;
  }
  setSky(data, { width, height, scale, levels = 1 }, of) {
    // levels: pictures of half the size follow, as mip maps; of: the light and lamps, as `Piece` calls them
    const gl = this.gl;
    if (this.seen) gl.deleteTexture(this.seen.image);
    this.seen = { image: this.texture(data, width, height, false, true), scale, height, of };
    for (let level = 1, first = 3 * width * height; level < levels; level++) {
      const [w, h] = [width >> level, height >> level];
      const pixel = data.subarray(first, (first += 3 * w * h));
      gl.texImage2D(gl.TEXTURE_2D, level, gl.RGB16F, w, h, 0, gl.RGB, gl.HALF_FLOAT, pixel);
    }
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, levels - 1);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    // The last and smallest of the pictures is what is blurred.
    const [w, h] = [width >> (levels - 1), height >> (levels - 1)];
    if (this.blurredImage) gl.deleteTexture(this.blurredImage);
    [this.blurredImage, this.coarseSky] = [null, { data: data.subarray(data.length - 3 * w * h), width: w, height: h }];
  }
  // The light as it is seen, its brightness, and the level of detail of its image; null where it is not the background.
  behind(camera, state, height) {
    const { seen } = this;
    if (!seen || !["light", "blurred light"].includes(state.background)) return null;
    const lod = Math.log2((2 * Math.tan(camera.angle / 2) * seen.height) / (height * Math.PI));
    if (state.background === "light") return { image: seen.image, lod };
    this.blurredImage ??= this.texture(blurred(this.coarseSky), 2 * BLURRED, BLURRED, false, true);
    return { image: this.blurredImage, lod: 0 };
  }
  // What the mesh is drawn on, in colors of the display.
  ground(state) {
    return [...(state.background === "color" ? state.ground : [0.1, 0.1, 0.1]), 1];
  }
  addStill(data, width, height, encoded, scale, cover = null) {
    // cover: bytes of alpha, where no background is seen
    this.dropStills(1);
    let all = data;
    if (cover) {
      all = new data.constructor(4 * width * height);
      for (let i = 0; i < width * height; i++) {
        for (let c = 0; c < 3; c++) all[4 * i + c] = data[3 * i + c];
        all[4 * i + 3] = encoded ? cover[i] : toHalf(cover[i] / 255);
      }
    }
    const clear = cover !== null;
    const image = this.texture(all, width, height, encoded, false, clear);
    this.stills.push({ image, encoded, scale, clear, since: performance.now() });
  }
  dropStills(kept) {
    while (this.stills.length > kept) this.gl.deleteTexture(this.stills.shift().image);
  }
  quad(program, image, gain, encoded, tone) {
    const gl = this.gl;
    gl.useProgram(program.handle);
    gl.bindVertexArray(this.empty);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, image);
    gl.uniform1f(program.at("gain"), gain);
    gl.uniform1i(program.at("encoded"), encoded ? 1 : 0);
    gl.uniform1i(program.at("tone"), tone);
  }
  // The sky and the mesh, on a ground of one color, in the framebuffer of the moment: an image of shaded pixels, or
  // colors at vertices without one.
  paint(camera, state, center, { width, height }, ground, image = null, surfaces = true) {
    const gl = this.gl;
    const gpu = this.gpu;
    const gain = 2 ** state.stops;
    const tone = TONES.indexOf(state.tone);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...ground);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const sky = this.behind(camera, state, height);
    const through = sky && image && gpu.piece.blends && surfaces; // light adds up before it is displayed
    if (sky) {
      const program = through ? this.through : this.sky;
      if (through) this.quad(program, image.handle, gain, false, tone);
      else this.quad(program, sky.image, gain * this.seen.scale, false, tone);
      gl.uniformMatrix3fv(program.at("ray"), false, camera.ray(width / height));
      gl.uniform1f(program.at("turn"), state.turn);
      gl.uniform1f(program.at("lod"), sky.lod);
      if (through) {
        gl.activeTexture(gl.TEXTURE0 + gpu.stencilUnit);
        gl.bindTexture(gl.TEXTURE_2D, sky.image);
        gl.uniform1i(program.at("behind"), gpu.stencilUnit);
        gl.uniform1f(program.at("bright"), this.seen.scale);
      }
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (through || !surfaces) return;
    if (image) {
      gl.enable(gl.BLEND);
      this.quad(this.shaded, image.handle, gain, false, tone);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      gl.disable(gl.BLEND);
    } else if (this.count && (gpu ? gpu.message : this.drawn)) {
      const program = gpu ? this.colored : this.mesh;
      gl.useProgram(program.handle);
      gl.bindVertexArray(this.array);
      gl.uniformMatrix4fv(program.at("matrix"), false, camera.matrix(width / height, center));
      gl.uniform1f(program.at("gain"), gpu ? gain : gain * this.scale);
      gl.uniform1i(program.at("encoded"), !gpu && this.encoded ? 1 : 0);
      gl.uniform1i(program.at("tone"), tone);
      if (gpu) gl.uniform1i(program.at("color"), gpu.piece.textures.color.unit);
      drawSides(gl, this.backs, this.count, (vertices) => gl.drawElements(gl.TRIANGLES, vertices, gl.UNSIGNED_INT, 0));
    }
  }
  // Draws a frame: true if another one is to follow. `python` says whether pictures at rest come from there, and `fresh`
  // whether more has changed than what pixels show.
  draw(camera, state, center, now, python, fresh) {
    const { gl, gpu } = this;
    const { width, height } = this.canvas;
    if (gpu?.busy) {
      this.late ||= fresh;
      return true;
    }
    gpu?.see(this.seen);
    const more = gpu?.work(now, camera.matrix(width / height, center), width, height, python) ?? false;
    if (more && !fresh && !this.late && !gpu.fresh && !this.stills.length) return true;
    this.late = false;
    if (this.unexposed && (gpu ? gpu.message : this.drawn)) {
      this.unexposed = false;
      this.exposed(this.exposure(camera, state, center));
    }
    const gain = 2 ** state.stops;
    const tone = TONES.indexOf(state.tone);
    this.paint(camera, state, center, this.canvas, this.ground(state), gpu?.shown);
    let alpha = 1;
    gl.enable(gl.BLEND);
    for (const each of this.stills) {
      alpha = clamp((now - each.since) / FADE, 0, 1);
      if (each.clear && alpha === 1) {
        // edges of what was drawn before lie beside its own
        gl.disable(gl.BLEND);
        this.paint(camera, state, center, this.canvas, this.ground(state), null, false);
        gl.enable(gl.BLEND);
      }
      this.quad(this.still, each.image, gain * each.scale, each.encoded, tone);
      gl.uniform1f(this.still.at("alpha"), alpha);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    gl.disable(gl.BLEND);
    return more || alpha < 1;
  }
  // What is behind the scene, as `picture` has it.
  backdrop(camera, state, center, width, height) {
    return { pixel: this.pixels(camera, state, center, { width, height }, null, 4, false), parts: 1 };
  }
  // A picture of any size as rows of RGBA from below, colors times alpha, and how many of its pixels make one along
  // an edge.
  async picture(camera, state, center, width, height) {
    const { gl, gpu } = this;
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (Math.max(width, height) > most || width * height > MOST_PIXELS)
      throw new Error(
        `a picture must have at most ${MOST_PIXELS} pixels, and ${most} along an edge in this browser, got ${width} x ${height}`,
      );
    if (!gpu?.floats)
      return { pixel: this.pixels(camera, state, center, { width: 2 * width, height: 2 * height }), parts: 2 };
    const image = await gpu.whole(camera.matrix(width / height, center), width, height);
    const pixel = this.pixels(camera, state, center, { width, height }, image);
    gpu.dispose();
    return { pixel, parts: 1 };
  }
  // Bytes, RGBA from the lower left, of what is painted at a size of its own: an image of shaded pixels, or colors at
  // vertices without one. Alpha is 0 where there is only the ground.
  pixels(camera, state, center, { width, height }, image = null, mostSamples = 4, surfaces = true) {
    const gl = this.gl;
    const most = gl.getParameter(gl.MAX_RENDERBUFFER_SIZE);
    const samples = Math.min(mostSamples, gl.getParameter(gl.MAX_SAMPLES));
    if (Math.max(width, height) > most)
      throw new Error(
        `a picture must have at most ${most} pixels along an edge in this browser, got ${width} x ${height}`,
      );
    const buffer = (count, kind, place) => {
      const handle = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, handle);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, count, kind, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, handle);
      return handle;
    };
    const [many, one] = [gl.createFramebuffer(), gl.createFramebuffer()];
    const result = new Uint8Array(4 * width * height);
    if (this.gpu && !image) this.gpu.piece.vertices(this.gpu.message);
    gl.bindFramebuffer(gl.FRAMEBUFFER, many);
    const buffers = [buffer(samples, gl.RGBA8, gl.COLOR_ATTACHMENT0)];
    buffers.push(buffer(samples, gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT));
    const ground = state.background === "color" ? this.ground(state) : [0, 0, 0, 0];
    this.paint(camera, state, center, { width, height }, ground, image, surfaces);
    gl.bindFramebuffer(gl.FRAMEBUFFER, one);
    buffers.push(buffer(0, gl.RGBA8, gl.COLOR_ATTACHMENT0));
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, many);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, one);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, result);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    for (const frame of [many, one]) gl.deleteFramebuffer(frame);
    for (const each of buffers) gl.deleteRenderbuffer(each);
    return result;
  }
  // A small picture in another light, at an exposure of its own: by colors of the vertices in half floats, or by those
  // that the GPU makes for a message.
  thumbnail(camera, state, center, size, { message = null, color = null, scale = 1 }) {
    const { gpu, given } = this;
    const { message: now, shown } = gpu ?? {};
    if (message) Object.assign(gpu, { message, shown: null });
    else {
      this.gpu = null;
      this.setColor(color, false, scale);
    }
    const stops = this.exposure(camera, state, center) ?? 0;
    const pixel = this.pixels(camera, { ...state, stops, background: "none" }, center, size);
    if (message) Object.assign(gpu, { message: now, shown });
    else {
      this.gpu = gpu;
      if (given) this.setColor(...given);
      else this.drawn = false;
    }
    return pixel;
  }
  // Stops at which the brightest surfaces that are seen come near white, as `jaxprt.image.automatic_exposure` has them:
  // the 99th percentile of luminance over pixels that surfaces fill is 0.9. Null where no surface is seen, or all is
  // black.
  exposure(camera, state, center) {
    const height = 96;
    const width = Math.max(1, Math.round((height * this.canvas.width) / this.canvas.height));
    const measured = { ...state, stops: 0, tone: "", background: "none" };
    const pixel = this.pixels(camera, measured, center, { width, height }, this.gpu?.shown, 0);
    const lit = [];
    for (let i = 0; i < pixel.length; i += 4)
      if (pixel[i + 3] === 255 && pixel[i] + pixel[i + 1]) lit.push(pixel[i] + pixel[i + 1] / 255);
    const bright = lit.sort((x, y) => x - y)[Math.round(0.99 * (lit.length - 1))];
    return bright === undefined ? null : Math.log2(0.9) - ((bright - 127.5) * 2 * MOST_STOPS) / 255;
  }
  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

// A latitude-longitude picture of half floats, blurred over the sphere.
function blurred({ data, width, height }) {
  const rows = BLURRED;
  const columns = 2 * rows;
  const small = new Float32Array(3 * rows * columns);
  const result = new Uint16Array(small.length);
  const step = height / rows;
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++)
      for (let c = 0; c < 3; c++)
        small[3 * (Math.floor(y / step) * columns + Math.floor(x / step)) + c] +=
          half(data[3 * (y * width + x) + c]) / step ** 2;
  const latitude = (row) => Math.PI * (0.5 - (row + 0.5) / rows);
  const concentration = 1 / WIDE ** 2;
  for (let y = 0; y < rows; y++)
    for (let x = 0; x < columns; x++) {
      const sum = [0, 0, 0];
      const up = latitude(y);
      let total = 0;
      for (let v = 0; v < rows; v++)
        for (let u = 0; u < columns; u++) {
          const at = latitude(v);
          const cosine =
            Math.sin(up) * Math.sin(at) + Math.cos(up) * Math.cos(at) * Math.cos((2 * Math.PI * (u - x)) / columns);
          const weight = Math.cos(at) * Math.exp(concentration * (cosine - 1));
          if (weight < 1e-3) continue;
          total += weight;
          for (let c = 0; c < 3; c++) sum[c] += weight * small[3 * (v * columns + u) + c];
        }
      for (let c = 0; c < 3; c++) result[3 * (y * columns + x) + c] = toHalf(sum[c] / total);
    }
  return result;
}
