// The viewer: mesh and camera live here, colors come from Python. The same module runs in notebooks (anywidget calls
// `render`) and on a page of its own (`mount`). No libraries.

const HELP = `drag: orbit · right drag or Ctrl: pan · wheel, pinch: zoom · double-click: look at a point
Shift-drag: turn the light · drop an HDR or EXR file: another light
arrows: orbit · Shift-arrows: pan · + -: zoom · [ ]: turn the light · , .: exposure · L: next light · S: next system
B: bounces · G: background · P: picture at rest · E: exact picture · C: clear the lamps · R: reset · H: this help`;

const VERTEX = `#version 300 es
layout(location=0) in vec3 position; layout(location=1) in vec3 color; uniform mat4 matrix; out vec3 c;
void main(){ c = color; gl_Position = matrix * vec4(position, 1); }`;
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
// The curves of jaxprt/image/tonemap.py. Matrices stand in rows, to the right of vectors.
vec3 display(vec3 x){ if (encoded) return x; x = clamp(x * gain, 0., 1e6);
  x = clamp(tone == 1 ? hable(2. * x) / hable(vec3(11.2)) : tone == 2 ? agx(x) : tone == 3 ? aces(x) : x, 0., 1.);
  return mix(12.92 * x, 1.055 * pow(max(x, vec3(1e-6)), vec3(1. / 2.4)) - .055, step(.0031308, x)); }`;
const MESH = `#version 300 es
precision highp float; in vec3 c; out vec4 o; ${DISPLAY}
void main(){ o = vec4(gl_FrontFacing ? display(c) : vec3(0), 1); } // backs are black, as in pictures`;
const QUAD = `#version 300 es
out vec2 at; void main(){ at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.; gl_Position = vec4(at * 2. - 1., .99999, 1); }`;
const SKY = `#version 300 es
precision highp float; in vec2 at; out vec4 o; uniform sampler2D image; uniform mat3 ray; uniform float turn, lod; ${DISPLAY}
void main(){ vec3 d = normalize(ray * vec3(at * 2. - 1., 1));
  float lon = atan(d.x, d.z) - turn; vec2 uv = vec2(.5 - lon / 6.283185307, .5 - asin(clamp(d.y, -1., 1.)) / 3.141592654);
  o = vec4(display(textureLod(image, uv, lod).rgb), 1); }`; // of derivatives there would be a seam
const STILL = `#version 300 es
precision highp float; in vec2 at; out vec4 o; uniform sampler2D image; uniform float alpha; ${DISPLAY}
void main(){ o = vec4(display(textureLod(image, vec2(at.x, 1. - at.y), 0.).rgb), alpha); }`;

const TONES = ["srgb", "filmic", "agx", "aces"];
const SKY_ROWS = 1024; // of the picture of a light at rest, if its file has so many
const FADE = 200; // milliseconds in which a picture at rest appears
const SLOW = 500; // milliseconds of a whole picture from which on a coarse one comes first

const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (v) => { const l = Math.hypot(...v) || 1; return v.map((x) => x / l); };
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
const toLinear = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
const toDisplay = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
const hex = (color) => "#" + color.map((x) => Math.round(255 * toDisplay(clamp(x, 0, 1))).toString(16).padStart(2, "0")).join("");
const unhex = (text) => [1, 3, 5].map((i) => toLinear(parseInt(text.slice(i, i + 2), 16) / 255));

function element(tag, parent, fields = {}) {
  const made = document.createElement(tag);
  Object.assign(made, fields);
  parent.appendChild(made);
  return made;
}

// Colors that Python has exposed, made bytes, and compressed: differences, channel by channel. Where a mask comes with
// them, one bit for each entry, they are those of its entries alone; the others stay as they were.
async function inflate(data, count, before, mask) {
  const stream = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate"));
  const plane = new Uint8Array(await new Response(stream).arrayBuffer()), entries = plane.length / 3;
  const result = mask ? before : new Uint8Array(3 * count), bit = (i) => !mask || (mask.getUint8(i >> 3) >> (7 - (i & 7))) & 1;
  for (let c = 0; c < 3; c++) for (let i = 0, from = c * entries, value = 0; i < count; i++) if (bit(i)) result[3 * i + c] = value = (value + plane[from++]) & 255;
  return result;
}

// A message and its arrays from one string of bytes, as Python's `messages.pack` has made it.
export function unpack(data) {
  const size = new DataView(data).getUint32(0, true), head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
  let place = 4 + size;
  const buffers = head.lengths.map((each) => {
    const view = new DataView(data, place, each);
    place += each + ((8 - (each % 8)) % 8);
    return view;
  });
  return { content: head.content, buffers };
}

class Camera {
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

class Drawing {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = (this.gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true }));
    if (!gl) throw new Error("this browser has no WebGL2, which the viewer needs");
    this.build();
  }
  build() {
    const gl = this.gl;
    const program = (vertex, fragment) => {
      const made = gl.createProgram();
      for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, text);
        gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
        gl.attachShader(made, shader);
      }
      gl.linkProgram(made);
      return { made, at: (name) => gl.getUniformLocation(made, name) };
    };
    this.mesh = program(VERTEX, MESH);
    this.sky = program(QUAD, SKY);
    this.still = program(QUAD, STILL);
    this.empty = gl.createVertexArray();
    this.array = gl.createVertexArray();
    [this.position, this.color, this.index] = [0, 1, 2].map(() => gl.createBuffer());
    this.skyImage = null;
    this.stills = []; // pictures at rest: the last one appears over the one before
  }
  setMesh(position, face, backs) { // of faces after the first `backs` no backs are seen
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
    this.colored = false;
  }
  setColor(data, encoded, scale) {
    const gl = this.gl;
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.color);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STREAM_DRAW);
    gl.enableVertexAttribArray(1);
    if (encoded) gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 3, 0);
    else gl.vertexAttribPointer(1, 3, gl.HALF_FLOAT, false, 6, 0);
    this.encoded = encoded;
    this.scale = scale;
    this.colored = true;
  }
  texture(data, width, height, encoded, repeat) {
    const gl = this.gl, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    if (encoded) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, width, height, 0, gl.RGB, gl.UNSIGNED_BYTE, data);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB16F, width, height, 0, gl.RGB, gl.HALF_FLOAT, data);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, repeat ? gl.REPEAT : gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return made;
  }
  setSky(data, { width, height, scale, levels = 1 }) { // levels: pictures of half the size follow, as mip maps
    const gl = this.gl;
    if (this.skyImage) gl.deleteTexture(this.skyImage);
    this.skyImage = this.texture(data, width, height, false, true);
    for (let level = 1, first = 3 * width * height; level < levels; level++) {
      const [w, h] = [width >> level, height >> level];
      gl.texImage2D(gl.TEXTURE_2D, level, gl.RGB16F, w, h, 0, gl.RGB, gl.HALF_FLOAT, data.subarray(first, first += 3 * w * h));
    }
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, levels - 1);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    [this.skyScale, this.skyHeight] = [scale, height];
  }
  addStill(data, width, height, encoded, scale) {
    this.dropStills(1);
    this.stills.push({ image: this.texture(data, width, height, encoded, false), encoded, scale, since: performance.now() });
  }
  dropStills(kept) { while (this.stills.length > kept) this.gl.deleteTexture(this.stills.shift().image); }
  quad(program, image, gain, encoded, tone) {
    const gl = this.gl;
    gl.useProgram(program.made);
    gl.bindVertexArray(this.empty);
    gl.bindTexture(gl.TEXTURE_2D, image);
    gl.uniform1f(program.at("gain"), gain);
    gl.uniform1i(program.at("encoded"), encoded ? 1 : 0);
    gl.uniform1i(program.at("tone"), tone);
  }
  draw(camera, state, center, now) { // true while a picture at rest appears
    const gl = this.gl, { width, height } = this.canvas, gain = 2 ** state.stops, tone = TONES.indexOf(state.tone);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.1, 0.1, 0.1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    if (state.background && this.skyImage) {
      this.quad(this.sky, this.skyImage, gain * this.skyScale, false, tone);
      gl.uniformMatrix3fv(this.sky.at("ray"), false, camera.ray(width / height));
      gl.uniform1f(this.sky.at("turn"), state.turn);
      gl.uniform1f(this.sky.at("lod"), Math.log2((2 * Math.tan(camera.angle / 2) * this.skyHeight) / (height * Math.PI)));
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    if (this.count && this.colored) {
      gl.enable(gl.DEPTH_TEST);
      gl.useProgram(this.mesh.made);
      gl.bindVertexArray(this.array);
      gl.uniformMatrix4fv(this.mesh.at("matrix"), false, camera.matrix(width / height, center));
      gl.uniform1f(this.mesh.at("gain"), gain * this.scale);
      gl.uniform1i(this.mesh.at("encoded"), this.encoded ? 1 : 0);
      gl.uniform1i(this.mesh.at("tone"), tone);
      // Backs lie a little deeper: at silhouettes they are as deep as the fronts beside them, and would show as dots.
      gl.enable(gl.CULL_FACE);
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(2, 4);
      gl.cullFace(gl.FRONT);
      gl.drawElements(gl.TRIANGLES, this.backs, gl.UNSIGNED_INT, 0);
      gl.disable(gl.POLYGON_OFFSET_FILL);
      gl.cullFace(gl.BACK);
      gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
      gl.disable(gl.CULL_FACE);
      gl.disable(gl.DEPTH_TEST);
    }
    let alpha = 1;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    for (const each of this.stills) {
      alpha = clamp((now - each.since) / FADE, 0, 1);
      this.quad(this.still, each.image, gain * each.scale, each.encoded, tone);
      gl.uniform1f(this.still.at("alpha"), alpha);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    gl.disable(gl.BLEND);
    return alpha < 1;
  }
  close() { this.gl.getExtension("WEBGL_lose_context")?.loseContext(); }
}

// Where a ray meets the mesh first: the distance, or infinity.
function meet(origin, way, position, face) {
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

export function mount(root, ask) {
  const shadow = root.shadowRoot ?? root.attachShadow({ mode: "open" });
  shadow.textContent = "";
  element("style", shadow, { textContent: STYLE });
  const frame = element("div", shadow, { className: "frame" });
  const canvas = element("canvas", frame, { className: "canvas", tabIndex: 0 });
  canvas.setAttribute("aria-label", "jaxprt viewer; press H for its keys");
  const panel = element("div", frame, { className: "panel" });
  const line = element("div", frame, { className: "line" }), told = element("div", frame, { className: "told" });
  const help = element("pre", frame, { className: "help", textContent: HELP, hidden: true });
  const state = { system: "", light: 0, turn: 0, lamps: [], stops: 0, tone: "srgb", background: true, bounces: false, still: true, exact: false, materials: {} };
  const stats = (canvas.stats = { sent: 0, got: 0, errors: 0, stills: 0, coarse: 0, draws: 0, sky: 0, bytes: 0, seq: 0, shown: -1, trip: 0 });
  let scene = null, camera = null, first = null, drawing = null, closed = false;
  // Whether round trips are long: the kernel is far away, or the browser draws slowly. Then colors come as bytes, and
  // those that the eye can see first.
  let long = false, bytes = null, partial = false;
  let seq = 0, flying = false, dirty = false, wanted = 0, stillTimer = 0, stillBusy = false, skyKey = {}, framed = 0;
  let rest = { size: "", made: 0, ms: 0 }; // whole pictures at rest of one size: how many, and what the last one took
  const viewer = `${Date.now()}-${Math.random()}`; // its name, since each viewer of a session counts its own looks

  const tell = (text) => { told.textContent = text; told.hidden = !text; };
  const resize = () => {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), box = canvas.getBoundingClientRect();
    const width = clamp(Math.round(box.width * ratio), 1, 2048), height = clamp(Math.round(box.height * ratio), 1, 2048);
    if (canvas.width !== width || canvas.height !== height) {
      Object.assign(canvas, { width, height });
      moved();
    }
  };
  const redraw = () => { if (!wanted && !closed) wanted = requestAnimationFrame(draw); };
  const draw = (now) => {
    wanted = 0;
    if (!camera || closed || drawing.gl.isContextLost()) return;
    const appears = drawing.draw(camera, state, scene.center, now);
    stats.draws++;
    if (appears) redraw();
  };
  const message = (kind) => ({
    kind, viewer, seq, system: state.system, light: state.light, turn: state.turn, lamps: state.lamps, eye: camera.eye,
    target: camera.target, field_of_view: camera.angle, bounces: state.bounces, materials: state.materials,
    stops: long ? state.stops : null, tone: state.tone,
  });
  // Anything that changes the picture: the newest state is asked for as soon as the last answer has come.
  const moved = () => {
    if (!scene) return;
    seq++;
    stats.seq = seq;
    drawing.dropStills(0);
    clearTimeout(stillTimer);
    redraw();
    look();
  };
  const look = async (vertices = "seen") => {
    if (flying) { dirty = true; return; }
    if (closed) return;
    [flying, dirty] = [true, false];
    const began = performance.now(), own = { ...message("look"), vertices: long && bytes ? vertices : "all" };
    stats.sent++;
    try {
      const { content, buffers } = await ask(own);
      if (closed) return;
      if (content.kind === "error") { stats.errors++; tell(content.message); }
      else {
        const compressed = own.stops !== null, sent = buffers.reduce((total, each) => total + each.byteLength, 0);
        if (compressed) bytes = await inflate(buffers[0], scene.vertices, bytes, buffers[1]);
        const data = compressed ? bytes : new Uint16Array(buffers[0].buffer, buffers[0].byteOffset, buffers[0].byteLength / 2);
        partial = own.vertices === "seen";
        drawing.setColor(data, compressed, content.scale);
        if (first === null) {
          first = compressed ? 0 : exposureFor(data, content.scale);
          state.stops = first;
          controls?.show();
        }
        stats.trip = performance.now() - began;
        const spent = content.ms.light + content.ms.view + content.ms.combine;
        long = long ? stats.trip - spent > 15 : stats.trip - spent > 60 + spent;
        stats.got++;
        stats.bytes += sent;
        stats.shown = content.seq;
        if (content.seq === seq) tell("");
        const rate = framed ? 1000 / (performance.now() - framed) : 0;
        framed = performance.now();
        status(content.ms, rate, sent);
        redraw();
      }
    } catch (error) {
      stats.errors++;
      tell(`no answer from Python: ${error.message}`);
      if (!closed) setTimeout(() => { dirty = false; look(); }, 1000);
    } finally {
      flying = false;
    }
    if (dirty) look();
    else if (stats.shown === seq && partial) look("unseen");
    else if (stats.shown === seq) { sky(); stillTimer = setTimeout(rested, 250); }
  };
  const status = (ms, rate, bytes) => {
    const number = (x) => x.toFixed(x < 10 ? 1 : 0);
    line.textContent = `light ${number(ms.light)} ms · view ${number(ms.view)} ms · combine ${number(ms.combine)} ms · ` +
      `there and back ${number(stats.trip)} ms · ${rate ? number(rate) + "/s · " : ""}${(bytes / 1024).toFixed(0)} kB · ${scene.vertices.toLocaleString()} vertices${scene.note ? ` · ${scene.note}` : ""}`;
  };
  // The light as it is seen: a small picture at once and a fine one at rest, unless the way is long.
  const sky = async (rows = 1) => {
    const key = JSON.stringify([state.light, state.lamps]);
    if (key === skyKey.light && rows <= skyKey.rows) return;
    skyKey = { light: key, rows };
    try {
      const { content, buffers } = await ask({ ...message("sky"), rows });
      if (closed || content.kind === "error" || skyKey.light !== key) return;
      const data = new Uint16Array(buffers[0].buffer, buffers[0].byteOffset, buffers[0].byteLength / 2);
      if (rows === 1) controls?.paint(data, content);
      if (skyKey.rows !== rows) return; // the fine one has been asked for
      drawing.setSky(data, content);
      stats.sky = content.height;
      redraw();
    } catch { skyKey = {}; }
  };
  const rested = () => { if (!long) sky(SKY_ROWS); still(); };
  // At rest: the picture at pixels, then the exact one. Where they take long a coarse one comes first. The first picture
  // of a size does not count: its programs are compiled. Python gives up what it is at when the next look comes.
  const still = async () => {
    if (!state.still || !scene.rests.length || stillBusy || closed || flying) return;
    stillBusy = true;
    const own = seq, size = { width: canvas.width, height: canvas.height }, name = `${size.width} ${size.height}`;
    if (rest.size !== name) rest = { size: name, made: 0, ms: 0 };
    const steps = rest.made > 1 && rest.ms > SLOW ? [["still", true], ["still", false]] : [["still", false]];
    if (state.exact) steps.push(["exact", true], ["exact", false]);
    try {
      for (const [kind, coarse] of steps) {
        if (kind === "exact") tell("the exact picture is on its way");
        const asked = { ...message(kind), ...size, coarse }, { content, buffers } = await ask(asked);
        if (closed || own !== seq || content.kind === "late") break;
        if (content.kind === "error") { tell(content.message); break; }
        const compressed = asked.stops !== null, count = content.width * content.height;
        const data = compressed ? await inflate(buffers[0], count) : new Uint16Array(buffers[0].buffer, buffers[0].byteOffset, buffers[0].byteLength / 2);
        drawing.addStill(data, content.width, content.height, compressed, content.scale);
        stats[coarse ? "coarse" : "stills"]++;
        if (kind === "still" && !coarse) rest = { size: name, made: rest.made + 1, ms: content.ms };
        if (kind === "exact" && !coarse) {
          const error = content.error === undefined ? "" : `: the picture is ${(100 * content.error).toFixed(1)} ± ${(100 * content.spread).toFixed(1)} % off`;
          tell(`exact, direct light of the environment alone${error}`);
        }
        redraw();
      }
    } catch (error) {
      tell(`no answer from Python: ${error.message}`);
    } finally {
      stillBusy = false;
    }
    if (own !== seq && !flying && stats.shown === seq) stillTimer = setTimeout(still, 250);
  };

  const set = (fields) => { Object.assign(state, fields); controls?.show(); moved(); };
  const expose = (stops) => {
    state.stops = clamp(stops, -20, 20);
    controls?.show();
    if (long) moved(); else redraw();
  };
  const map = (tone) => {
    state.tone = tone;
    controls?.show();
    if (long) moved(); else redraw();
  };
  const drop = async (file) => {
    if (file.size > 2 ** 29) return tell(`${file.name} must have at most 512 MiB, and has ${Math.ceil(file.size / 2 ** 20)}`);
    try {
      const { content } = await ask({ kind: "drop", name: file.name }, [await file.arrayBuffer()]);
      if (content.kind === "error") { stats.errors++; return tell(content.message); }
      scene.lights = content.lights;
      set({ light: content.light, lamps: [] });
    } catch (error) { stats.errors++; tell(`no answer from Python: ${error.message}`); }
  };
  const reset = () => { camera = new Camera(scene); set({ turn: 0, lamps: [], materials: {}, stops: first ?? 0 }); };
  const lookAt = (x, y) => {
    const ray = camera.ray(canvas.clientWidth / canvas.clientHeight);
    const way = unit([0, 1, 2].map((i) => ray[i] * x + ray[3 + i] * y + ray[6 + i])), origin = camera.eye;
    const t = meet(origin, way, scene.position, scene.face);
    if (t === Infinity) return;
    camera.target = add(origin, way, t);
    moved();
  };
  let controls = null;
  const start = async () => {
    try {
      const { content, buffers } = await ask({ kind: "scene" });
      if (closed) return;
      if (content.kind === "error") return tell(content.message);
      const view = (buffer, kind) => new kind(buffer.buffer, buffer.byteOffset, buffer.byteLength / 4);
      scene = { ...content, position: view(buffers[0], Float32Array), face: view(buffers[1], Uint32Array) };
      camera ??= new Camera(scene);
      state.system ||= Object.keys(scene.systems)[0];
      state.bounces = scene.systems[state.system].bounces;
      drawing.setMesh(scene.position, scene.face, scene.backs);
      controls = panelOf(panel, scene, state, { set, expose, map, moved });
      controls.show();
      resize();
      moved();
    } catch (error) {
      tell(`no answer from Python: ${error.message}`);
      if (!closed) setTimeout(start, 1000);
    }
  };
  try { drawing = new Drawing(canvas); } catch (error) { tell(error.message); return () => {}; }
  const hands = gestures(canvas, frame, { get camera() { return camera; }, state, scene: () => scene, set, expose, moved, drop, reset, lookAt, help });
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); if (!closed) tell("the graphics context was lost; it comes back by itself"); });
  canvas.addEventListener("webglcontextrestored", () => {
    drawing.build();
    if (scene) drawing.setMesh(scene.position, scene.face, scene.backs);
    skyKey = {};
    moved();
  });
  const watch = new ResizeObserver(resize);
  watch.observe(canvas);
  canvas.state = state;
  canvas.camera = () => camera;
  start();
  return () => { closed = true; watch.disconnect(); hands(); clearTimeout(stillTimer); drawing.close(); };
}

function panelOf(panel, scene, state, { set, expose, map, moved }) {
  panel.textContent = "";
  const row = (text) => { const made = element("label", panel); element("span", made, { textContent: text }); return made; };
  const choice = (text, names, pick) => {
    const made = element("select", row(text));
    made.fill = (every) => { made.textContent = ""; every.forEach((name, i) => element("option", made, { textContent: name, value: i })); };
    made.fill(names);
    made.onchange = () => pick(Number(made.value));
    return made;
  };
  const names = Object.keys(scene.systems);
  const system = names.length > 1 ? choice("system", names, (i) => set({ system: names[i], bounces: state.bounces && scene.systems[names[i]].bounces })) : null;
  const light = choice("light", scene.lights, (i) => set({ light: i }));
  const exposure = element("input", row("exposure"), { type: "range", min: -6, max: 6, step: 0.1 });
  exposure.oninput = () => expose(Number(exposure.value));
  const tone = choice("tone", TONES, (i) => map(TONES[i]));
  const box = (text, key, change) => {
    const made = element("input", row(text), { type: "checkbox" });
    made.onchange = () => change({ [key]: made.checked });
    return [key, made];
  };
  const boxes = [box("background", "background", set)];
  if (scene.rests.includes("still")) boxes.push(box("picture at rest", "still", set));
  if (scene.rests.includes("exact")) boxes.push(box("exact picture", "exact", set));
  if (Object.values(scene.systems).some((each) => each.bounces)) boxes.push(box("bounces", "bounces", set));
  element("div", panel, { className: "title", textContent: "put a sun by a click, paint light by a drag" });
  const sky = element("canvas", panel, { className: "sky", width: 256, height: 128 });
  const tint = element("input", row("its color"), { type: "color", value: "#fff0d8" });
  const clear = element("button", panel, { textContent: "clear the lamps", type: "button" });
  clear.onclick = () => set({ lamps: [] });
  lamps(sky, tint, state, set);
  const parts = scene.parts.filter((part) => part.free).map((part) => materialOf(panel, part, state, moved));
  return {
    show() {
      if (light.length !== scene.lights.length) light.fill(scene.lights);
      light.value = state.light;
      if (system) system.value = names.indexOf(state.system);
      exposure.value = state.stops;
      tone.value = TONES.indexOf(state.tone);
      for (const [key, each] of boxes) each.checked = state[key];
      for (const part of parts) part();
    },
    paint(data, { width, height, scale }) { paintSky(sky, data, width, height, scale, state.stops); },
  };
}

// Stops for what is seen first: none, unless most of it would be white or black.
function exposureFor(data, scale) {
  const value = [], step = 3 * Math.max(1, Math.floor(data.length / 30000));
  for (let i = 0; i + 2 < data.length; i += step) value.push(scale * Math.max(half(data[i]), half(data[i + 1]), half(data[i + 2])));
  const lit = value.filter((x) => x > 0).sort((a, b) => a - b), middle = lit[lit.length >> 1] ?? 0.5;
  return middle > 1 || middle < 0.02 ? clamp(Math.round(10 * Math.log2(0.5 / middle)) / 10, -20, 20) : 0;
}

function half(bits) {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023;
  return exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024);
}

function paintSky(canvas, data, width, height, scale, stops) {
  const context = canvas.getContext("2d"), image = context.createImageData(width, height), gain = scale * 2 ** stops;
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < 3; c++) image.data[4 * i + c] = 255 * toDisplay(clamp(half(data[3 * i + c]) * gain, 0, 1));
    image.data[4 * i + 3] = 255;
  }
  Object.assign(canvas, { width, height });
  context.putImageData(image, 0, 0);
}

// Lamps put on the picture of the environment: a click a small bright one, a drag a wide faint one along the way.
function lamps(canvas, tint, state, set) {
  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    const lon = Math.PI * (1 - (2 * (event.clientX - box.left)) / box.width), lat = Math.PI * (0.5 - (event.clientY - box.top) / box.height);
    return [Math.cos(lat) * Math.sin(lon), Math.sin(lat), Math.cos(lat) * Math.cos(lon)];
  };
  const lamp = (direction, angle, strength) => ({ direction, angle, radiance: unhex(tint.value).map((x) => x * strength) });
  let last = null, painted = false;
  canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); last = at(event); painted = false; };
  canvas.onpointermove = (event) => {
    if (!last || dot(last, at(event)) > Math.cos(0.12) || state.lamps.length >= 200) return;
    if (!painted) state.lamps = [...state.lamps, lamp(last, 0.15, 2)];
    [last, painted] = [at(event), true];
    set({ lamps: [...state.lamps, lamp(last, 0.15, 2)] });
  };
  canvas.onpointerup = (event) => {
    if (last && !painted) set({ lamps: [...state.lamps, lamp(at(event), 0.05, 300)] });
    last = null;
  };
}

// The plane of roughness and reflectance at normal incidence, and the colors, of one part.
function materialOf(panel, part, state, moved) {
  const free = part.free, value = (name) => state.materials[part.name]?.[name] ?? free[name];
  const change = (fields) => { state.materials = { ...state.materials, [part.name]: { ...state.materials[part.name], ...fields } }; show(); moved(); };
  element("div", panel, { className: "title", textContent: part.name });
  // Of Blinn-Phong the exponent falls to the right, as roughness grows.
  const across = free.exponent_range ? "exponent" : "roughness", range = free[`${across}_range`], hasPlane = range || free.f0 !== undefined;
  const low = range?.[0], span = range && range[1] / low;
  const valueAt = (x) => (across === "exponent" ? low * span ** (1 - x) : low + x * (range[1] - low));
  const placeOf = (value) => (across === "exponent" ? 1 - Math.log(value / low) / Math.log(span) : (value - low) / (range[1] - low));
  const plane = hasPlane ? element("canvas", panel, { className: "plane", width: 128, height: 128, title: "roughness to the right (Blinn-Phong: a smaller exponent), reflectance at normal incidence up" }) : null;
  if (plane) {
    const drag = (event) => {
      const area = plane.getBoundingClientRect(), x = clamp((event.clientX - area.left) / area.width, 0, 1), y = clamp(1 - (event.clientY - area.top) / area.height, 0, 1);
      change({ ...(range && { [across]: valueAt(x) }), ...(free.f0 !== undefined && { f0: y * y }) });
    };
    plane.onpointerdown = (event) => { plane.setPointerCapture(event.pointerId); drag(event); };
    plane.onpointermove = (event) => { if (plane.hasPointerCapture(event.pointerId)) drag(event); };
  }
  const pickers = ["diffuse", "specular"].filter((name) => free[name]).map((name) => {
    const made = element("label", panel);
    element("span", made, { textContent: name });
    const input = element("input", made, { type: "color" });
    input.oninput = () => change({ [name]: unhex(input.value) });
    return [name, input];
  });
  const show = () => {
    for (const [name, input] of pickers) input.value = hex(value(name));
    if (!plane) return;
    const c = plane.getContext("2d"), x = range ? placeOf(value(across)) : 0.5, y = free.f0 !== undefined ? Math.sqrt(value("f0")) : 0.5;
    c.fillStyle = "#444";
    c.fillRect(0, 0, 128, 128);
    c.fillStyle = "#aaa";
    c.font = "10px sans-serif";
    c.fillText(across === "exponent" ? "← exponent" : "roughness →", 66, 122);
    c.fillText("↑ F0", 4, 12);
    c.fillStyle = "#fd5";
    c.beginPath();
    c.arc(6 + 116 * x, 122 - 116 * y, 5, 0, 7);
    c.fill();
  };
  return show;
}

function gestures(canvas, frame, on) {
  const points = new Map();
  let pinch = null;
  const spot = (event) => [event.clientX, event.clientY];
  const middle = () => { const [a, b] = [...points.values()]; return { at: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.hypot(a[0] - b[0], a[1] - b[1]) || 1 }; };
  const listen = {
    contextmenu: (event) => event.preventDefault(),
    pointerdown(event) {
      if (!on.camera) return;
      canvas.focus();
      canvas.setPointerCapture(event.pointerId);
      points.set(event.pointerId, spot(event));
      pinch = points.size === 2 ? middle() : null;
    },
    pointermove(event) {
      const from = points.get(event.pointerId);
      if (!from || !on.camera) return;
      const to = spot(event), [dx, dy] = [to[0] - from[0], to[1] - from[1]], height = canvas.clientHeight || 1;
      points.set(event.pointerId, to);
      if (points.size === 2 && pinch) {
        const now = middle();
        on.camera.zoom(pinch.apart / now.apart);
        on.camera.pan((now.at[0] - pinch.at[0]) / height, (now.at[1] - pinch.at[1]) / height);
        pinch = now;
      } else if (event.shiftKey) return on.set({ turn: on.state.turn + 0.01 * dx });
      else if (event.ctrlKey || event.buttons & 2) on.camera.pan(dx / height, dy / height);
      else on.camera.orbit(0.01 * dx, 0.01 * dy);
      on.moved();
    },
    pointerup(event) { points.delete(event.pointerId); pinch = null; },
    pointercancel(event) { points.delete(event.pointerId); pinch = null; },
    dblclick(event) {
      if (!on.camera) return;
      const box = canvas.getBoundingClientRect();
      on.lookAt((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    },
    wheel(event) {
      if (!on.camera) return;
      event.preventDefault();
      on.camera.zoom(Math.exp(0.001 * clamp(event.deltaY, -300, 300)));
      on.moved();
    },
    keydown(event) {
      if (on.camera && !event.altKey && !event.metaKey && !event.ctrlKey && key(event, on)) event.preventDefault();
    },
  };
  for (const [name, each] of Object.entries(listen)) canvas.addEventListener(name, each, { passive: false });
  frame.addEventListener("dragover", (event) => event.preventDefault());
  frame.addEventListener("drop", (event) => { event.preventDefault(); if (on.camera && event.dataTransfer.files[0]) on.drop(event.dataTransfer.files[0]); });
  return () => { for (const [name, each] of Object.entries(listen)) canvas.removeEventListener(name, each); };
}

function key(event, on) {
  const { state } = on, scene = on.scene(), names = Object.keys(scene.systems);
  const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  const next = names[(names.indexOf(state.system) + 1) % names.length];
  if (arrow && event.shiftKey) { on.camera.pan(0.05 * arrow[0], 0.05 * arrow[1]); on.moved(); }
  else if (arrow) { on.camera.orbit(0.1 * arrow[0], 0.1 * arrow[1]); on.moved(); }
  else {
    const act = {
      "+": () => { on.camera.zoom(0.9); on.moved(); }, "=": () => { on.camera.zoom(0.9); on.moved(); },
      "-": () => { on.camera.zoom(1 / 0.9); on.moved(); },
      "[": () => on.set({ turn: state.turn - 0.1 }), "]": () => on.set({ turn: state.turn + 0.1 }),
      ",": () => on.expose(state.stops - 0.5), ".": () => on.expose(state.stops + 0.5),
      l: () => on.set({ light: (state.light + 1) % scene.lights.length }), s: () => on.set({ system: next, bounces: state.bounces && scene.systems[next].bounces }),
      b: () => scene.systems[state.system].bounces && on.set({ bounces: !state.bounces }), g: () => on.set({ background: !state.background }),
      p: () => on.set({ still: !state.still }), e: () => on.set({ exact: !state.exact }), c: () => on.set({ lamps: [] }), r: () => on.reset(),
      h: () => { on.help.hidden = !on.help.hidden; },
    }[event.key.toLowerCase()];
    if (!act) return false;
    act();
  }
  return true;
}

const STYLE = `
:host { display: block; height: 100%; }
.frame { position: relative; display: flex; height: 100%; min-height: 320px; background: #1a1a1a; color: #ddd; font: 12px/1.5 system-ui, sans-serif; }
.canvas { flex: 1; min-width: 0; width: 100%; height: 100%; touch-action: none; outline: none; }
.panel { width: 176px; padding: 8px; overflow-y: auto; box-sizing: border-box; background: #262626; }
.panel label { display: flex; justify-content: space-between; gap: 8px; align-items: center; margin: 2px 0; }
.panel select, .panel input[type=range] { width: 96px; }
.title { margin-top: 8px; color: #fd5; }
.sky, .plane { display: block; width: 160px; touch-action: none; cursor: crosshair; }
.sky { height: 80px; }
.plane { height: 128px; width: 128px; }
.line, .told { position: absolute; left: 8px; pointer-events: none; text-shadow: 0 0 3px #000, 0 0 3px #000; }
.line { bottom: 6px; right: 184px; }
.told { top: 6px; max-width: 60%; color: #fd5; }
.help { position: absolute; left: 8px; top: 28px; margin: 0; padding: 8px; background: #000c; white-space: pre-wrap; max-width: 60%; }
`;

// For anywidget: messages have numbers, by which answers find their questions.
function render({ model, el }) {
  const waiting = new Map();
  let last = 0, lost = false;
  const heard = (content, buffers) => {
    const each = waiting.get(content.id);
    if (!each) return;
    waiting.delete(content.id);
    el.classList.add("jaxprt-live"); // which hides the picture that a notebook without a kernel shows
    each.resolve({ content: content.content, buffers });
  };
  const restarted = () => new Error("the kernel was restarted; run the cell again");
  const cut = () => {
    lost = true;
    for (const each of waiting.values()) each.reject(restarted());
    waiting.clear();
  };
  model.on("msg:custom", heard);
  model.on("comm_live_update", cut); // of JupyterLab, when its kernel is gone
  const ask = (content, buffers = []) =>
    new Promise((resolve, reject) => {
      if (lost) return reject(restarted());
      const id = `${Date.now()}-${Math.random()}-${++last}`;
      waiting.set(id, { resolve, reject });
      setTimeout(() => { if (waiting.delete(id)) reject(new Error("the kernel was restarted, or is busy")); }, 120000);
      model.send({ id, content }, undefined, buffers);
    });
  el.style.height = `${model.get("height")}px`;
  const close = mount(el, ask);
  return () => { model.off("msg:custom", heard); model.off("comm_live_update", cut); close(); };
}
export default { render };
