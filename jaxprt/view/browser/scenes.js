// Scenes: what Python prepares, of which the page says how far it is and takes each better scene.

import { numbers } from "./common.js";
import { panelOf } from "./panel.js";

const POLL = 300; // milliseconds between questions about progress
const FIRST = 50; // before there is a scene

/** @typedef {{ name: string, vertices: number, free?: Record<string, any> }} Part */
/**
 * @typedef {{ version: number, scene: number, finished: boolean, vertices: number, note?: string, parts: Part[],
 *   backs?: number, center: number[], origin: number[], radius: number, eye: number[], target: number[],
 *   field_of_view: number, lights: string[], systems: Record<string, { bounces: boolean }>, rests: string[],
 *   pictured?: boolean, buffers: DataView<ArrayBuffer>[], position: Float32Array, face: Uint32Array }} Scene
 */

export class Scenes {
  /** @param {import("./viewer.js").Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    this.timer = 0;
    this.poll = null; // what asks about progress
    this.loading = false;
    this.bouncing = false; // whether bounces are switched on when all is prepared
    this.controls = ""; // what the panel has controls of
  }
  // Asks what is prepared until it is finished. A later call takes the place of an earlier one.
  follow() {
    const { viewer } = this;
    const poll = async () => {
      const { width, height } = viewer.canvas;
      const lost = ({ message }) => ({ content: { kind: "lost", message: `no answer from Python: ${message}` } });
      const { content } = await viewer.ask({ kind: "progress", width, height }).catch(lost);
      if (viewer.closed || this.poll !== poll) return;
      this.hear(content);
      if (content.kind === "lost" || (content.kind === "progress" && !content.finished))
        this.timer = setTimeout(poll, content.version === 0 ? FIRST : POLL);
    };
    clearTimeout(this.timer);
    viewer.resize();
    this.poll = poll;
    poll();
  }
  close() {
    clearTimeout(this.timer);
  }
  hear(content) {
    const { viewer } = this;
    const { scene } = viewer;
    if (content.kind !== "progress") return viewer.tell(content.message);
    if (content.error) viewer.tell((viewer.fault = content.error));
    viewer.waiting.set("progress", content.finished ? "" : content.stage, content.fraction);
    if (content.version > (scene?.version ?? 0)) this.load();
    else if (scene && content.lights > scene.lights.length) this.more();
    else if (content.finished && this.bouncing) {
      this.bouncing = false;
      viewer.set({ bounces: true });
    }
  }
  // Names of all lights, and texels of those from a number on, are taken.
  take({ lights, light }, buffers) {
    const { scene, gpu } = this.viewer;
    scene.lights = lights;
    for (const [i, buffer] of buffers.entries())
      if (gpu.pixels) gpu.pixels.piece.lights[light + i] = numbers(Float32Array, buffer);
  }
  // Lights that the page does not have.
  async more() {
    const { viewer } = this;
    try {
      const { content, buffers } = await viewer.ask({ kind: "lights", first: viewer.scene.lights.length });
      if (!viewer.closed && content.kind === "lights") this.take(content, buffers);
      viewer.controls?.show();
    } catch {
      /* the next look tells */
    }
  }
  // The pointer comes back: a light may have been dropped on another page of the same scene.
  async look() {
    try {
      const { content } = await this.viewer.ask({ kind: "progress" });
      if (!this.viewer.closed) this.hear(content);
    } catch {
      /* the next look tells */
    }
  }
  async load() {
    const { viewer } = this;
    if (this.loading) return;
    this.loading = true;
    try {
      const { content, buffers } = await viewer.ask({ kind: "scene" });
      if (viewer.closed) return;
      if (content.kind === "error") return viewer.tell(content.message);
      viewer.tell("");
      const arrays = { position: numbers(Float32Array, buffers[0]), face: numbers(Uint32Array, buffers[1]) };
      await this.show({ ...content, buffers, ...arrays });
    } catch (error) {
      viewer.tell(`no answer from Python: ${error.message}`);
      if (!viewer.closed) setTimeout(() => this.load(), 1000);
    } finally {
      this.loading = false;
    }
  }
  /** @param {Scene} loaded */
  async show(loaded) {
    const { viewer } = this;
    const { state, canvas } = viewer;
    if (!loaded.systems[state.system]) state.system = Object.keys(loaded.systems)[0];
    viewer.gpu.asked = "";
    await viewer.gpu.load(loaded); // before Python is asked for colors, whose programs may have to be compiled
    const had = viewer.scene?.systems[state.system]?.bounces;
    const has = loaded.systems[state.system].bounces;
    // The GPU goes on with direct light until the programs of bounces are compiled.
    if (had !== has) [this.bouncing, state.bounces] = [has && viewer.gpu.pixels && !loaded.finished, has];
    if (this.bouncing) state.bounces = false;
    const another = viewer.scene && loaded.scene !== viewer.scene.scene;
    const first = !viewer.camera;
    const pictured = loaded.rests.length > 0 || loaded.finished; // whether it is shown small in each light
    viewer.scene = Object.assign(viewer.scene ?? {}, loaded, { pictured });
    [viewer.colors.bytes, viewer.exposed] = [null, null]; // an automatic exposure is found for each better scene
    if (another) {
      [viewer.camera, state.materials, viewer.picking.opened] = [null, {}, ""];
      viewer.past.forget();
      viewer.view.steps(false, false);
    }
    viewer.camera ??= viewer.home();
    viewer.drawing.setMesh(loaded.position, loaded.face, loaded.backs);
    // Controls stay as they are where they show the same, because a hand may be at one.
    const parts = loaded.parts.map(({ name, free }) => [name, free]);
    const controls = JSON.stringify([parts, loaded.lights, Object.keys(loaded.systems), loaded.rests]);
    if (controls !== this.controls) {
      this.controls = controls;
      viewer.controls = panelOf(viewer);
      viewer.rests.forgetSky();
      if (viewer.root.parentElement === document.body && document.activeElement === document.body)
        canvas.focus({ preventScroll: true }); // a page of the viewer alone: keys work at once
    }
    viewer.rests.small.clear(); // of a scene with fewer shadows
    viewer.controls.show();
    viewer.resize();
    viewer.moved();
    if (first && viewer.addressed && location.hash.length > 1) viewer.arrive();
    viewer.past.amend();
  }
}
