// The viewer: mesh and camera live here, colors come from Python. The same module runs in notebooks (anywidget calls
// `render`) and on a page of its own (`mount`). No libraries.

import { add, clamp, element, half, inflate, unit } from "./common.js";
import { Camera, meet } from "./camera.js";
import { Drawing } from "./drawing.js";
import { panelOf } from "./panel.js";
import { HELP, gestures } from "./gestures.js";

const SKY_ROWS = 1024; // of the picture of a light at rest, if its file has so many

const SLOW = 500; // milliseconds of a whole picture from which on a coarse one comes first

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

// Stops for what is seen first: none, unless most of it would be white or black.
function exposureFor(data, scale) {
  const value = [], step = 3 * Math.max(1, Math.floor(data.length / 30000));
  for (let i = 0; i + 2 < data.length; i += step) value.push(scale * Math.max(half(data[i]), half(data[i + 1]), half(data[i + 2])));
  const lit = value.filter((x) => x > 0).sort((a, b) => a - b), middle = lit[lit.length >> 1] ?? 0.5;
  return middle > 1 || middle < 0.02 ? clamp(Math.round(10 * Math.log2(0.5 / middle)) / 10, -20, 20) : 0;
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
