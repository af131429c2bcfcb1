// The viewer: mesh and camera live here, colors come from Python. The same module runs in notebooks (anywidget calls
// `render` of widget.js) and on a page of its own (`mount`). No libraries.

import { add, clamp, decompressed, drawnSize, inflate, unit } from "./common.js";
import { Camera, meet } from "./camera.js";
import { History, restored, written } from "./state.js";
import { Drawing } from "./drawing.js";
import { Piece } from "./piece.js";
import { Pixels } from "./pixels.js";
import { panelOf } from "./panel.js";
import { gestures } from "./gestures.js";
import { frameOf } from "./frame.js";
import { drawn, materials, video } from "./saving.js";
import { Waiting, follow } from "./waiting.js";

const MESHES = /\.(glb|gltf|obj|ply|stl|off)$/i; // of files that are scenes
const LIGHTS = /\.(hdr|exr|pic|json)$/i; // what does not belong to scenes
const IMAGES = /\.(png|jpe?g|tiff?|pfm|bmp|webp|ktx2)$/i; // which may be lights
const SMALL = { width: 72, height: 54 }; // pixels of the pictures of lights in the panel
const SKY_ROWS = 1024; // of the picture of a light at rest, if its file has so many

const TRIES = 3; // answers of Python until their time counts: the first ones wait for compilers
const SLOW = 500; // milliseconds of a whole picture from which on a coarse one comes first

// Shows what `ask` answers. A page of the viewer alone has its state in its address.
export function mount(root, ask, { addressed = false } = {}) {
  const shadow = root.shadowRoot ?? root.attachShadow({ mode: "open" });
  shadow.textContent = "";
  root.dataset.lmSuppressShortcuts = "true"; // JupyterLab leaves the keys to the viewer
  const view = frameOf(shadow, {
    reset: () => scene && reset(),
    undo: (by) => scene && past.step(by),
    frame: () => scene && frameAll(),
    save: { make: (...choice) => save(...choice), python: () => scene?.rests.includes("picture") },
  });
  const { frame, canvas, panel, line, help, tell, busy } = view;
  const state = {
    system: "",
    light: 0,
    turn: 0,
    lamps: [],
    stops: 0,
    auto: true,
    tone: "srgb",
    background: "light",
    ground: [0.8, 0.8, 0.8],
    bounces: false,
    still: true,
    exact: false,
    materials: {},
  };
  const stats = (canvas.stats = {
    sent: 0,
    got: 0,
    errors: 0,
    stills: 0,
    coarse: 0,
    draws: 0,
    sky: 0,
    bytes: 0,
    seq: 0,
    shown: -1,
    trip: 0,
  });
  let scene = null;
  let camera = null;
  let drawing = null;
  let closed = false;
  // Whether round trips are long: the kernel is far away, or the browser draws slowly. Then colors come as bytes, and
  // those that the eye can see first.
  let long = false;
  let bytes = null;
  let partial = false;
  let exposed = null; // the light that the exposure has been found for, while it is automatic
  let seq = 0;
  let flying = false;
  let dirty = false;
  let wanted = 0;
  let stillTimer = 0;
  let stillBusy = false;
  let skyKey = {};
  let framed = 0;
  let unanswered = false; // whether the last picture at rest got no answer; it is asked for again
  let rest = { size: "", made: 0, ms: 0 }; // whole pictures at rest of one size: how many, and what the last one took
  const viewer = `${Date.now()}-${Math.random()}`; // its name, since each viewer of a session counts its own looks

  const waiting = new Waiting(busy);
  const resize = () => {
    const { width, height } = drawnSize(canvas.getBoundingClientRect(), window.devicePixelRatio || 1);
    if (canvas.width !== width || canvas.height !== height) {
      Object.assign(canvas, { width, height });
      moved();
    }
  };
  let refined = 0; // samples of the pixels that the status line tells
  let fresh = false; // whether more has changed than what pixels show
  const again = () => {
    if (!wanted && !closed) wanted = requestAnimationFrame(draw);
  };
  const redraw = () => {
    fresh = true;
    again();
  };
  const draw = (now) => {
    wanted = 0;
    if (!camera || closed || drawing.gl.isContextLost()) return;
    const appears = drawing.draw(camera, state, scene.center, now, state.still && scene.rests.length > 0, fresh);
    fresh = false;
    if (drawing.gpu && gpu.stats.samples !== refined) {
      refined = gpu.stats.samples;
      describe();
    }
    controls?.look(camera.azimuth);
    stats.draws++;
    if (appears) again();
  };
  const message = (kind) => ({
    kind,
    viewer,
    seq,
    version: scene.version,
    system: state.system,
    light: state.light,
    turn: state.turn,
    lamps: state.lamps,
    eye: camera.eye,
    target: camera.target,
    field_of_view: camera.angle,
    bounces: state.bounces,
    materials: state.materials,
    stops: long ? state.stops : null,
    tone: state.tone,
  });
  // Anything that changes the picture: the newest state is asked for as soon as the last answer has come.
  const moved = () => {
    if (!scene) return;
    past.changed();
    notice = "";
    seq++;
    stats.seq = seq;
    drawing.dropStills(0);
    clearTimeout(stillTimer);
    redraw();
    look();
  };
  let looked = 0; // answers of Python
  let notice = ""; // what stays said until the next change
  let fault = ""; // why there is no better scene
  // The GPU's scene: what it holds of a system, asked for once. Other states have their colors from Python.
  let gpu = null;
  let asked = "";
  let lacking = "";
  const page = async (from = scene) => {
    const system = state.system;
    if (asked === system) return;
    asked = system;
    try {
      const { content, buffers } = await ask({ kind: "page", viewer, system });
      if (closed || asked !== system) return;
      lacking = content.missing ?? content.message ?? "";
      const piece = content.kind === "page" && !lacking ? new Piece(content, [...from.buffers, ...buffers]) : null;
      await piece?.expand();
      if (closed || asked !== system) return;
      gpu?.close();
      gpu = null;
      if (piece) gpu = new Pixels(drawing.gl, piece, 3 * (from.backs ?? from.face.length / 3));
    } catch (error) {
      lacking = error.message;
    }
    canvas.pixels = () => gpu;
    if (gpu && scene === from) moved();
  };
  // Whether the GPU shades the present state. A slow one leaves it to Python, if that is quicker.
  const shades = () =>
    gpu !== null &&
    asked === state.system &&
    gpu.piece.content.system === state.system &&
    !state.bounces &&
    !gpu.piece.fixed(state.materials) &&
    !(gpu.slow && scene.rests.length && (looked < TRIES || stats.trip < 2 * gpu.stats.ms));
  // Pages hold a row for each harmonic of reflected light, and the last one for lamps.
  const lessLit = () =>
    ["", ", lamps without highlights"][gpu.piece.content.reflectedUnit.length] ??
    ", reflected light without highlights";
  const describe = () => {
    const { level, samples, ms } = gpu.stats;
    const size = samples
      ? `pixels of ${samples} sample${samples > 1 ? "s" : ""}`
      : level
        ? level === 1
          ? "pixels"
          : `pixels of ${level} x ${level}`
        : "vertices";
    line.textContent = `${size} by the browser's GPU${ms ? `, ${ms.toFixed(0)} ms` : ""}${lessLit()} · ${scene.vertices.toLocaleString()} vertices${scene.note ? ` · ${scene.note}` : ""}`;
  };
  const shade = () => {
    stats.sent++;
    gpu.change(message("look"));
    if (state.auto && exposed !== state.light) {
      exposed = state.light;
      drawing.unexposed = true;
    }
    Object.assign(stats, { got: stats.got + 1, shown: seq });
    tell(notice || fault);
    describe();
    redraw();
    sky();
    stillTimer = setTimeout(rested, 250);
  };
  const look = async (vertices = "seen") => {
    page();
    drawing.gpu = shades() ? gpu : null;
    if (drawing.gpu) return shade();
    if (flying) {
      dirty = true;
      return;
    }
    if (closed) return;
    [flying, dirty] = [true, false];
    const began = performance.now();
    const unexposed = state.auto && exposed !== state.light;
    const own = { ...message("look"), vertices: long && bytes && !unexposed ? vertices : "all" };
    if (unexposed) own.stops = null; // radiance, of which the exposure is found
    stats.sent++;
    try {
      const { content, buffers } = await waiting.during("look", "waiting for colors from Python", ask(own));
      if (closed) return;
      if (content.kind === "late") return load(); // there is a better scene
      if (content.kind === "error") {
        stats.errors++;
        tell(content.message);
      } else {
        const compressed = own.stops !== null;
        const sent = buffers.reduce((total, each) => total + each.byteLength, 0);
        if (compressed) bytes = await inflate(buffers[0], scene.vertices, bytes, buffers[1]);
        const data = compressed
          ? bytes
          : new Uint16Array(buffers[0].buffer, buffers[0].byteOffset, buffers[0].byteLength / 2);
        partial = own.vertices === "seen";
        drawing.setColor(data, compressed, content.scale);
        if (unexposed && state.light === own.light) {
          exposed = own.light;
          drawing.unexposed = true;
        }
        stats.trip = performance.now() - began;
        looked++;
        const spent = content.ms.light + content.ms.view + content.ms.combine;
        long = long ? stats.trip - spent > 15 : stats.trip - spent > 60 + spent;
        stats.got++;
        stats.bytes += sent;
        stats.shown = Math.max(stats.shown, content.seq); // the GPU may have shown a newer state
        if (content.seq === seq) tell(notice || fault);
        const rate = framed ? 1000 / (performance.now() - framed) : 0;
        framed = performance.now();
        if (!drawing.gpu) status(content.ms, rate, sent);
        redraw();
      }
    } catch (error) {
      stats.errors++;
      tell(`no answer from Python: ${error.message}`);
      if (!closed)
        setTimeout(() => {
          dirty = false;
          look();
        }, 1000);
    } finally {
      flying = false;
    }
    if (dirty) look();
    else if (stats.shown === seq && partial) look("unseen");
    else if (stats.shown === seq) {
      sky();
      stillTimer = setTimeout(rested, 250);
    }
  };
  const why = () =>
    lacking ||
    (state.bounces
      ? "reflected light"
      : gpu?.piece.fixed(state.materials)
        ? `the material of ${gpu.piece.fixed(state.materials)} is one of vertices`
        : gpu?.slow
          ? "the browser has no quick GPU"
          : "");
  const status = (ms, rate, bytes) => {
    const number = (x) => x.toFixed(x < 10 ? 1 : 0);
    line.textContent =
      `light ${number(ms.light)} ms · view ${number(ms.view)} ms · combine ${number(ms.combine)} ms · ` +
      `there and back ${number(stats.trip)} ms · ${rate ? `${number(rate)}/s · ` : ""}${(bytes / 1024).toFixed(0)} kB · ${scene.vertices.toLocaleString()} vertices${scene.note ? ` · ${scene.note}` : ""}${why() ? ` · colors from Python: ${why()}` : ""}`;
  };
  // The light as it is seen: a small picture at once and a fine one at rest, unless the way is long.
  const sky = async (rows = 1) => {
    const key = JSON.stringify([state.light, state.lamps]);
    if (key === skyKey.light && rows <= skyKey.rows) return;
    skyKey = { light: key, rows };
    try {
      const { content, buffers } = await ask({ ...message("sky"), rows });
      if (content.kind === "late") skyKey = {};
      if (closed || content.kind !== "sky" || skyKey.light !== key) return;
      const data = new Uint16Array(buffers[0].buffer, buffers[0].byteOffset, buffers[0].byteLength / 2);
      if (rows === 1) controls?.paint(data, content);
      if (skyKey.rows !== rows) return; // the fine one has been asked for
      drawing.setSky(data, content, key);
      stats.sky = content.height;
      redraw();
    } catch {
      skyKey = {};
    }
  };
  const rested = async () => {
    if (!long) sky(SKY_ROWS);
    await still();
    if (!long) thumbnails();
  };
  // Small pictures of the scene in each light, while nothing moves: of what was there when each was made.
  const small = new Map();
  const thumbnails = async () => {
    const own = seq;
    const { width, height } = SMALL;
    if (scene.lights.length < 2 || !scene.rests.length) return;
    for (let light = small.size; light < scene.lights.length && own === seq && !closed; light++) {
      try {
        const { content, buffers } = await ask({
          ...message("look"),
          light,
          turn: 0,
          lamps: [],
          stops: null,
          vertices: "all",
        });
        if (closed || content.kind !== "color" || small.has(light)) return;
        const data = new Uint16Array(buffers[0].buffer, buffers[0].byteOffset, buffers[0].byteLength / 2);
        small.set(light, drawing.thumbnail(camera, state, scene.center, SMALL, [data, content.scale]));
        controls?.thumbnail(light, small.get(light), width, height);
        redraw();
      } catch {
        return;
      }
    }
  };
  // At rest: the picture at pixels, then the exact one. Where they take long a coarse one comes first. The first
  // picture of a size does not count: its programs are compiled. Python gives up what it is at when the next look
  // comes.
  const still = async () => {
    if (!(state.still || state.exact) || !scene.rests.length || stillBusy || closed || flying) return;
    stillBusy = true;
    const own = seq;
    const size = { width: canvas.width, height: canvas.height };
    const name = `${size.width} ${size.height}`;
    if (rest.size !== name) rest = { size: name, made: 0, ms: 0 };
    const steps = !state.still
      ? []
      : rest.made > 1 && rest.ms > SLOW
        ? [
            ["still", true],
            ["still", false],
          ]
        : [["still", false]];
    if (state.exact) steps.push(["exact", true], ["exact", false]);
    try {
      for (const [kind, coarse] of steps) {
        const asked = { ...message(kind), ...size, coarse, transparent: state.background !== "light" };
        const words = "computing the picture at pixels";
        const { content, buffers } = await waiting.during(
          "still",
          kind === "still" ? words : "computing the exact picture",
          ask(asked),
        );
        if (closed) break;
        if (unanswered) {
          unanswered = false;
          tell("");
        }
        if (own !== seq || content.kind === "late") break;
        if (content.kind === "error") {
          tell(content.message);
          break;
        }
        const compressed = asked.stops !== null;
        const count = content.width * content.height;
        const data = compressed
          ? await inflate(buffers[0], count)
          : new Uint16Array(buffers[0].buffer, buffers[0].byteOffset, buffers[0].byteLength / 2);
        const cover = asked.transparent ? await decompressed(buffers[1]) : null;
        drawing.addStill(data, content.width, content.height, compressed, content.scale, cover);
        stats[coarse ? "coarse" : "stills"]++;
        if (kind === "still" && !coarse) rest = { size: name, made: rest.made + 1, ms: content.ms };
        if (kind === "exact" && !coarse) {
          const error =
            content.error === undefined
              ? ""
              : `: the picture is ${(100 * content.error).toFixed(1)} ± ${(100 * content.spread).toFixed(1)} % off`;
          tell(`exact, direct light of the environment alone${error}`);
        }
        redraw();
      }
    } catch (error) {
      unanswered = true;
      tell(`no answer from Python: ${error.message}`);
    } finally {
      stillBusy = false;
    }
    if ((own !== seq || unanswered) && !closed && !flying && stats.shown === seq)
      stillTimer = setTimeout(still, unanswered ? 1000 : 250);
  };

  const set = (fields) => {
    Object.assign(state, fields);
    controls?.show();
    moved();
  };
  // The exposure for what is seen: at the start, when the light is another one, or when it is asked for.
  const found = (stops) => {
    if (stops !== null) state.stops = Math.round(10 * stops) / 10;
    controls?.show();
    if (long) moved();
  };
  const automatic = (auto) => {
    [state.auto, exposed] = [auto, null];
    controls?.show();
    past.changed();
    if (auto) moved();
  };
  const expose = (stops) => {
    [state.auto, state.stops] = [false, clamp(stops, -20, 20)];
    controls?.show();
    past.changed();
    if (long) moved();
    else redraw();
  };
  const map = (tone) => {
    state.tone = tone;
    controls?.show();
    past.changed();
    if (long) moved();
    else redraw();
  };
  const widen = (angle) => {
    camera.widen(angle);
    moved();
  };
  // Shows all of the part that was picked last, or of the scene.
  const frameAll = () => {
    const low = [Infinity, Infinity, Infinity];
    const high = low.map((x) => -x);
    const count = scene.position.length / 3;
    let first = 0;
    let last = count;
    if (opened) {
      const number = scene.parts.findIndex((part) => part.name === opened);
      const counts = scene.parts.map((part) => part.vertices);
      first = counts.slice(0, number).reduce((total, each) => total + each, 0);
      last = first + (counts[number] ?? count);
    }
    for (let i = 3 * first; i < 3 * last; i++) {
      low[i % 3] = Math.min(low[i % 3], scene.position[i]);
      high[i % 3] = Math.max(high[i % 3], scene.position[i]);
    }
    camera.frame(low, high, canvas.clientWidth / (canvas.clientHeight || 1));
    moved();
  };
  // The states that the user has gone through, of which the address holds the present one.
  const give = (text) => {
    const lacking = restored(text, state, camera, scene);
    exposed = null;
    controls?.show();
    moved();
    tell((notice = lacking));
  };
  const text = () => written(state, camera, scene, canvas.width / canvas.height);
  const past = new History(
    () => !hands.held && text(),
    give,
    (kept) => {
      view.steps(past.at > 0, past.at < past.states.length - 1);
      if (addressed) history.replaceState(null, "", `#${encodeURIComponent(kept)}`);
    },
  );
  const arrived = () => {
    try {
      give(decodeURIComponent(location.hash.slice(1)));
    } catch (error) {
      tell((notice = `the address holds no state: ${error.message}`));
    }
  };
  if (addressed) window.addEventListener("hashchange", arrived);
  const took = ({ lights, light }, buffers) => {
    // texels of the last ones, from a number on
    scene.lights = lights;
    if (gpu)
      buffers.forEach((each, i) => {
        gpu.piece.lights[light + i] = new Float32Array(each.buffer, each.byteOffset, each.byteLength / 4);
      });
  };
  const sent = async (kind, fields, files) => {
    for (const file of files)
      if (file.size > 2 ** 29)
        throw new Error(`${file.name} must have at most 512 MiB, and has ${Math.ceil(file.size / 2 ** 20)}`);
    const data = await Promise.all(files.map((file) => file.arrayBuffer()));
    const { content, buffers } = await waiting.during(
      "drop",
      `reading ${files.map((file) => file.name).join(", ")}`,
      ask({ kind, ...fields }, data).catch((error) => {
        throw new Error(`no answer from Python: ${error.message}`);
      }),
      0,
    );
    if (content.kind === "error") throw new Error(content.message);
    return { content, buffers };
  };
  // Files that were dropped: a scene with all that belongs to it, or lights, or a state.
  const drop = async (files) => {
    try {
      const opens = files.some(({ place }) => MESHES.test(place));
      const parts = files.filter(({ place }) => opens && !LIGHTS.test(place));
      for (const { file } of files.filter((each) => !parts.includes(each))) {
        if (!IMAGES.test(file.name) && !LIGHTS.test(file.name))
          throw new Error(
            `${file.name} must be a scene (GLB, glTF, OBJ, PLY, STL, OFF), a light (HDR, EXR) or a state (JSON)`,
          );
        if (/\.json$/i.test(file.name)) {
          try {
            give(await file.text());
          } catch (error) {
            throw new Error(`${file.name}: ${error.message}`);
          }
          continue;
        }
        const { content, buffers } = await sent("drop", { name: file.name }, [file]);
        took(content, buffers);
        set({ light: content.light, lamps: [] });
      }
      if (!opens) return;
      fault = "";
      await sent(
        "open",
        { names: parts.map(({ place }) => place) },
        parts.map(({ file }) => file),
      );
      start();
    } catch (error) {
      stats.errors++;
      tell(error.message);
    }
  };
  // The scene's own camera, further away where the picture is higher than wide.
  const home = () => {
    const result = new Camera(scene);
    result.distance /= Math.min(1, canvas.clientWidth / (canvas.clientHeight || 1)) || 1;
    return result;
  };
  const reset = () => {
    camera = home();
    exposed = null;
    set({ light: 0, turn: 0, lamps: [], materials: {}, auto: true, tone: "srgb", background: "light" });
  };
  // What is seen at a place of the picture, from -1 to 1: the point, and the part that it belongs to.
  const seen = (x, y) => {
    const ray = camera.ray(canvas.clientWidth / canvas.clientHeight);
    const way = unit([0, 1, 2].map((i) => ray[i] * x + ray[3 + i] * y + ray[6 + i]));
    const origin = camera.eye;
    const { distance, triangle } = meet(origin, way, scene.position, scene.face);
    if (triangle < 0) return null;
    let vertex = scene.face[3 * triangle];
    return { point: add(origin, way, distance), part: scene.parts.find((part) => (vertex -= part.vertices) < 0) };
  };
  let opened = ""; // the name of the part that was picked last
  const pick = (x, y) => {
    const part = seen(x, y)?.part;
    opened = part?.name ?? "";
    if (!part) return;
    if (controls.pick(part.name)) view.unfold();
    tell(part.free ? "" : `the material of ${part.name} cannot change here`);
  };
  const lookAt = (x, y) => {
    const found = seen(x, y);
    if (!found) return;
    opened = found.part?.name ?? "";
    if (found.part?.free) controls.pick(found.part.name);
    camera.target = found.point;
    moved();
  };
  // A picture of any size as a file: by Python where there is one, else by the graphics card. `from` has a camera, and
  // fields of the message and the state that are others for it.
  const picture = async ({ width, height, transparent, format = "png", samples }, from = { camera, fields: {} }) => {
    if (!scene) throw new Error("there is no scene yet");
    const shows = { ...state, ...from.fields, background: transparent ? "none" : state.background };
    const python = scene.rests.includes("picture");
    if (!python) {
      drawing.gpu?.change({ ...message("look"), ...from.fields, eye: from.camera.eye });
      return drawn(await drawing.picture(from.camera, shows, scene.center, width, height), width, height);
    }
    const over = !transparent && format === "png" && state.background !== "light";
    const asked = {
      ...message("picture"),
      ...from.fields,
      eye: from.camera.eye,
      stops: state.stops,
      width,
      height,
      transparent: transparent || over,
      format,
      samples,
    };
    const answer = await waiting.during("picture", `a picture of ${width} x ${height} pixels`, ask(asked), 0);
    if (answer.content.kind === "late") throw new Error("a better scene has come meanwhile: ask again");
    if (answer.content.kind === "error") throw new Error(answer.content.message);
    const blob = new Blob([answer.buffers[0]], { type: `image/${format}` });
    return over
      ? drawn(
          drawing.backdrop(from.camera, shows, scene.center, width, height),
          width,
          height,
          await createImageBitmap(blob),
        )
      : blob;
  };
  const save = async (choice, told, signal) => {
    const { kind } = choice;
    const json = (text) => new Blob([text], { type: "application/json" });
    if (!scene) throw new Error("there is no scene yet");
    if (kind === "state") return { blob: json(text()), name: "jaxprt.json" };
    if (kind === "materials") return { blob: json(materials(scene, state.materials)), name: "materials.json" };
    if (kind === "glb") {
      const { content, buffers } = await ask(message("glb"));
      if (content.kind === "error") throw new Error(content.message);
      return { blob: new Blob([buffers[0]], { type: "model/gltf-binary" }), name: "jaxprt.glb" };
    }
    const quick = { ...choice, samples: 4, transparent: false };
    const frames = {
      orbit: (share) => picture(quick, { camera: camera.around(2 * Math.PI * share), fields: {} }),
      turn: (share) => picture(quick, { camera, fields: { turn: state.turn + 2 * Math.PI * share } }),
    };
    try {
      if (!frames[kind]) return { blob: await picture({ ...choice, format: kind }), name: `jaxprt.${kind}` };
      const blob = await video(frames[kind], choice, told, signal);
      return { blob, name: `jaxprt.${blob.type.split("/")[1]}` };
    } finally {
      drawing.gpu?.change(message("look"));
      redraw();
    }
  };
  let controls = null;
  // What Python prepares: the page shows how far it is, and takes each better scene.
  let unfollow = () => {};
  let loading = false;
  let panelled = "";
  let bouncing = false;
  const start = () => {
    unfollow();
    resize();
    unfollow = follow(ask, () => ({ width: canvas.width, height: canvas.height }), heard);
  };
  const heard = (content) => {
    if (closed) return;
    if (content.kind === "error") return tell(content.message);
    if (content.error) tell((fault = content.error));
    waiting.set("progress", content.finished ? "" : content.stage, content.fraction);
    if (content.version > (scene?.version ?? 0)) load();
    else if (scene && content.lights > scene.lights.length) more();
    else if (content.finished && bouncing) {
      bouncing = false;
      set({ bounces: true });
    }
  };
  // Names and texels of lights that the page does not have.
  const more = async () => {
    try {
      const { content, buffers } = await ask({ kind: "lights", first: scene.lights.length });
      if (!closed && content.kind === "lights") took(content, buffers);
      controls?.show();
    } catch {
      /* the next look tells */
    }
  };
  // A light may have been dropped on another page of the same scene.
  const returned = async () => {
    if (!closed)
      try {
        heard((await ask({ kind: "progress" })).content);
      } catch {
        /* the next look tells */
      }
  };
  frame.addEventListener("pointerenter", returned);
  const load = async () => {
    if (loading) return;
    loading = true;
    try {
      const { content, buffers } = await ask({ kind: "scene" });
      if (closed) return;
      if (content.kind === "error") return tell(content.message);
      tell("");
      const array = (buffer, kind) => new kind(buffer.buffer, buffer.byteOffset, buffer.byteLength / 4);
      const loaded = {
        ...content,
        buffers,
        position: array(buffers[0], Float32Array),
        face: array(buffers[1], Uint32Array),
      };
      if (!loaded.systems[state.system]) state.system = Object.keys(loaded.systems)[0];
      asked = "";
      await page(loaded); // before Python is asked for colors, whose programs may have to be compiled
      // Controls stay as they are where they show the same, because a hand may be at one.
      const controlled = JSON.stringify([
        loaded.parts.map(({ name, free }) => [name, free]),
        loaded.lights,
        Object.keys(loaded.systems),
        loaded.rests,
      ]);
      const had = scene?.systems[state.system]?.bounces;
      const has = loaded.systems[state.system].bounces;
      // The GPU goes on with direct light until the programs of bounces are compiled.
      if (had !== has) [bouncing, state.bounces] = [has && gpu !== null && !loaded.finished, has];
      if (bouncing) state.bounces = false;
      const another = scene && loaded.scene !== scene.scene;
      scene = Object.assign(scene ?? {}, loaded);
      [bytes, exposed] = [null, null]; // an automatic exposure is found for each better scene
      const first = !camera;
      if (another) {
        [camera, state.materials, opened] = [null, {}, ""];
        past.forget();
        view.steps(false, false);
      }
      camera ??= home();
      drawing.setMesh(scene.position, scene.face, scene.backs);
      if (controlled !== panelled) {
        controls = panelOf(panel, scene, state, {
          set,
          expose,
          automatic,
          map,
          moved,
          widen,
          camera: () => camera,
          open: (files) => drop(files.map((file) => ({ place: file.name, file }))),
        });
        if (root.parentElement === document.body && document.activeElement === document.body)
          canvas.focus({ preventScroll: true }); // a page of the viewer alone: keys work at once
        [panelled, skyKey] = [controlled, {}];
      }
      small.clear(); // of a scene with fewer shadows
      controls.show();
      resize();
      moved();
      if (first && addressed && location.hash.length > 1) arrived();
      past.amend();
    } catch (error) {
      tell(`no answer from Python: ${error.message}`);
      if (!closed) setTimeout(load, 1000);
    } finally {
      loading = false;
    }
  };
  try {
    drawing = new Drawing(canvas);
  } catch (error) {
    tell(error.message);
    return () => {};
  }
  drawing.exposed = found;
  const hands = gestures(canvas, frame, {
    get camera() {
      return camera;
    },
    state,
    scene: () => scene,
    set,
    expose,
    automatic,
    moved,
    drop,
    reset,
    lookAt,
    pick,
    undo: (by) => past.step(by),
    frame: frameAll,
    help,
    toggleHelp: view.toggleHelp,
  });
  frame.addEventListener("theme", () => controls?.show());
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    if (!closed) tell("the graphics context was lost; it comes back by itself");
  });
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
  return () => {
    closed = true;
    unfollow();
    past.close();
    if (addressed) window.removeEventListener("hashchange", arrived);
    watch.disconnect();
    view.close();
    hands.close();
    clearTimeout(stillTimer);
    drawing.close();
  };
}
