// The viewer: its state and what follows from a change of it. The same module runs in notebooks (anywidget calls
// `render` of widget.js) and on a page of its own (`mount`). No libraries.

import { drawnSize } from "./common.js";
import { Camera } from "./camera.js";
import { History, initial, restored, written } from "./state.js";
import { Drawing } from "./drawing.js";
import { gestures } from "./gestures.js";
import { frameOf } from "./frame.js";
import { Waiting } from "./waiting.js";
import { Picking } from "./picking.js";
import { Gpu } from "./gpu.js";
import { Colors } from "./colors.js";
import { Rests } from "./rests.js";
import { Scenes } from "./scenes.js";

/** @typedef {{ kind: string, [field: string]: any }} Message */
/** @typedef {{ content: any, buffers: DataView<ArrayBuffer>[] }} Answer */
/** @typedef {(message: Message, files?: ArrayBuffer[]) => Promise<Answer>} Ask */

// What all modules share. They change the state by `set`, and the camera by its own methods and `moved`.
export class Viewer {
  /** @param {HTMLElement} root @param {Ask} ask @param {boolean} addressed */
  constructor(root, ask, addressed) {
    const shadow = root.shadowRoot ?? root.attachShadow({ mode: "open" });
    shadow.textContent = "";
    root.dataset.lmSuppressShortcuts = "true"; // JupyterLab leaves the keys to the viewer
    this.root = root;
    this.ask = ask;
    this.addressed = addressed; // whether the address holds the state
    this.name = `${Date.now()}-${Math.random()}`; // since each viewer of a session counts its own looks
    this.state = initial();
    /** @type {Camera | null} */
    this.camera = null;
    /** @type {import("./scenes.js").Scene | null} */
    this.scene = null;
    this.exposed = null; // the light that the exposure has been found for, while it is automatic
    this.notice = ""; // what stays said until the next change
    this.fault = ""; // why there is no better scene
    this.closed = false;
    this.wanted = 0; // the frame that is asked for
    this.fresh = false; // whether more has changed than what pixels show
    // `seq` counts changes, and `shown` is that of the colors that are seen.
    const counts = { sent: 0, got: 0, errors: 0, stills: 0, coarse: 0, draws: 0, sky: 0, bytes: 0 };
    this.stats = { ...counts, seq: 0, shown: -1, trip: 0 };
    this.view = frameOf(shadow, this);
    this.canvas = this.view.canvas;
    this.waiting = new Waiting(this.view.busy);
    this.picking = new Picking(this);
    this.gpu = new Gpu(this);
    this.colors = new Colors(this);
    this.rests = new Rests(this);
    this.scenes = new Scenes(this);
    /** @type {ReturnType<typeof import("./panel.js").panelOf> | null} */
    this.controls = null;
    // The states that the user has gone through, of which the address holds the present one.
    this.past = new History(
      () => !this.hands.held && this.text(),
      (text) => this.give(text),
      (text) => {
        this.view.steps(this.past.at > 0, this.past.at < this.past.states.length - 1);
        if (addressed) history.replaceState(null, "", `#${encodeURIComponent(text)}`);
      },
    );
    const { state, stats } = this;
    Object.assign(this.canvas, { state, stats, camera: () => this.camera, pixels: () => this.gpu.pixels });
    this.arrived = () => this.arrive();
  }
  start() {
    const { canvas, view } = this;
    this.drawing = new Drawing(canvas);
    this.drawing.exposed = (stops) =>
      this.set({ stops: stops === null ? this.state.stops : Math.round(10 * stops) / 10 });
    this.hands = gestures(canvas, view.frame, this);
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(canvas);
    if (this.addressed) window.addEventListener("hashchange", this.arrived);
    view.frame.addEventListener("pointerenter", () => this.closed || this.scenes.look());
    view.frame.addEventListener("theme", () => this.controls?.show());
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      if (!this.closed) this.tell("the graphics context was lost; it comes back by itself");
    });
    canvas.addEventListener("webglcontextrestored", () => {
      this.drawing.build();
      if (this.scene) this.drawing.setMesh(this.scene.position, this.scene.face, this.scene.backs);
      this.rests.forgetSky();
      this.moved();
    });
    this.scenes.follow();
  }
  close() {
    this.closed = true;
    this.scenes.close();
    this.rests.end();
    this.past.close();
    window.removeEventListener("hashchange", this.arrived);
    this.watch.disconnect();
    this.view.close();
    this.hands.close();
    this.drawing.close();
  }
  // Changes what the user has chosen. What the page displays by itself is drawn anew, and new colors are asked for where
  // they are needed: an exposure is found in them, and over a long way they come as they are displayed.
  /** @param {Partial<import("./state.js").State>} fields */
  set(fields) {
    const { state, colors } = this;
    Object.assign(state, fields);
    if ("auto" in fields) this.exposed = null;
    this.controls?.show();
    const asks = { auto: state.auto, stops: colors.long, tone: colors.long };
    if (Object.keys(fields).some((name) => asks[name] ?? true)) return this.moved();
    this.past.changed();
    this.redraw();
  }
  // The camera, or anything else that changes the picture, is another one.
  moved() {
    if (!this.scene) return;
    this.past.changed();
    this.notice = "";
    this.stats.seq++;
    this.rests.end();
    this.redraw();
    this.look();
  }
  // Colors of the present state: by the browser's GPU where it shades it, else from Python.
  look(vertices = "seen") {
    this.gpu.load();
    this.drawing.gpu = this.gpu.shades ? this.gpu.pixels : null;
    if (this.drawing.gpu) this.gpu.shade();
    else this.colors.ask(vertices);
  }
  // Whether the exposure is to be found: at the start, when the light is another one, or when it is asked for.
  get unexposed() {
    return this.state.auto && this.exposed !== this.state.light;
  }
  // Finds the exposure in the next picture, whose colors are those of a light.
  measure(light) {
    if (!this.unexposed || this.state.light !== light) return;
    this.exposed = light;
    this.drawing.unexposed = true;
  }
  message(kind) {
    const { eye, target, angle } = this.camera;
    const { seq } = this.stats;
    const stops = this.colors.long ? this.state.stops : null;
    const { version } = this.scene;
    return { ...this.state, kind, viewer: this.name, seq, version, eye, target, field_of_view: angle, stops };
  }
  // An answer of Python. What keeps it from one is thrown in words.
  async demand(message, files = []) {
    const answer = await this.ask(message, files).catch((error) => {
      throw new Error(`no answer from Python: ${error.message}`);
    });
    if (answer.content.kind === "error") throw new Error(answer.content.message);
    return answer;
  }
  tell(text = this.notice || this.fault) {
    this.view.tell(text);
  }
  // Says in the status line where colors come from.
  describe(text, ending = "") {
    const { vertices, note } = this.scene;
    const notes = [text, `${vertices.toLocaleString()} vertices`, ...(note ? [note] : [])];
    this.view.line.textContent = notes.join(" · ") + ending;
  }
  resize() {
    const { canvas } = this;
    const { width, height } = drawnSize(canvas.getBoundingClientRect(), window.devicePixelRatio || 1);
    if (canvas.width === width && canvas.height === height) return;
    Object.assign(canvas, { width, height });
    this.moved();
  }
  redraw() {
    this.fresh = true;
    this.again();
  }
  again() {
    if (!this.wanted && !this.closed) this.wanted = requestAnimationFrame((now) => this.draw(now));
  }
  draw(now) {
    const { camera, drawing, gpu, scene, state } = this;
    this.wanted = 0;
    if (!camera || this.closed || drawing.gl.isContextLost()) return;
    const appears = drawing.draw(camera, state, scene.center, now, state.still && scene.rests.length > 0, this.fresh);
    this.fresh = false;
    if (drawing.gpu && gpu.told !== gpu.pixels.stats.samples) gpu.describe();
    this.controls?.look(camera);
    this.stats.draws++;
    if (appears) this.again();
  }
  text() {
    return written(this.state, this.camera, this.scene, this.canvas.width / this.canvas.height);
  }
  // Shows a state that was written.
  give(text) {
    const lacking = restored(text, this.state, this.camera, this.scene);
    this.exposed = null;
    this.controls?.show();
    this.moved();
    this.tell((this.notice = lacking));
  }
  // Shows the state of the address.
  arrive() {
    try {
      this.give(decodeURIComponent(location.hash.slice(1)));
    } catch (error) {
      this.tell((this.notice = `the address holds no state: ${error.message}`));
    }
  }
  undo(by) {
    if (this.scene) this.past.step(by);
  }
  // The scene's own camera, further away where the picture is higher than wide.
  home() {
    const result = new Camera(this.scene);
    result.distance /= Math.min(1, this.canvas.clientWidth / (this.canvas.clientHeight || 1)) || 1;
    return result;
  }
  reset() {
    if (!this.scene) return;
    this.camera = this.home();
    this.set({ light: 0, turn: 0, lamps: [], materials: {}, auto: true, tone: "srgb", background: "light" });
  }
}

// Shows what `ask` answers. A page of the viewer alone has its state in its address.
/** @param {HTMLElement} root @param {Ask} ask */
export function mount(root, ask, { addressed = false } = {}) {
  const viewer = new Viewer(root, ask, addressed);
  try {
    viewer.start();
  } catch (error) {
    viewer.tell(error.message);
    return () => {};
  }
  return () => viewer.close();
}
