// The browser's GPU: what it needs of a system, asked for once, and whether it shades the present state.

import { Piece } from "./piece.js";
import { Pixels } from "./pixels.js";

const TRIES = 3; // answers of Python until their time counts: the first ones wait for compilers

export class Gpu {
  /** @param {import("./viewer.js").Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    /** @type {Pixels | null} */
    this.pixels = null; // of the last system that has come
    this.asked = ""; // the system that was asked for last
    this.lacking = ""; // why it cannot be shaded
    this.told = 0; // samples that the status line tells
  }
  // Asks for the present system, unless it has been. Its surfaces are those of `scene`.
  async load(scene = this.viewer.scene) {
    const { viewer } = this;
    const { system } = viewer.state;
    if (this.asked === system) return;
    this.asked = system;
    const late = () => viewer.closed || this.asked !== system;
    try {
      const { content, buffers } = await viewer.ask({ kind: "page", viewer: viewer.name, system });
      if (late()) return;
      this.lacking = content.missing ?? content.message ?? "";
      const piece =
        content.kind === "page" && !this.lacking ? new Piece(content, [...scene.buffers, ...buffers]) : null;
      await piece?.expand();
      if (late()) return;
      this.pixels?.close();
      this.pixels = null;
      if (piece) this.pixels = new Pixels(viewer.drawing.gl, piece, 3 * (scene.backs ?? scene.face.length / 3));
    } catch (error) {
      this.lacking = error.message;
    }
    if (this.pixels && viewer.scene === scene) viewer.moved();
  }
  // Why Python colors the present state; nothing where the GPU may. A slow one leaves it to Python if that is quicker.
  get reason() {
    const { state, scene, stats, colors } = this.viewer;
    if (this.lacking) return this.lacking;
    if (state.bounces) return "reflected light";
    const fixed = this.pixels?.piece.fixed(state.materials);
    if (fixed) return `the material of ${fixed} is one of vertices`;
    const quicker = colors.answers < TRIES || stats.trip < 2 * this.pixels?.stats.ms;
    return this.pixels?.slow && scene.rests.length && quicker ? "the browser has no quick GPU" : "";
  }
  get shades() {
    const { system } = this.viewer.state;
    return this.pixels?.piece.content.system === system && this.asked === system && !this.reason;
  }
  shade() {
    const { viewer } = this;
    const { stats } = viewer;
    stats.sent++;
    this.pixels.change(viewer.message("look"));
    viewer.measure(viewer.state.light);
    Object.assign(stats, { got: stats.got + 1, shown: stats.seq });
    viewer.tell();
    this.describe();
    viewer.redraw();
    viewer.rests.begin();
  }
  describe() {
    const { stats, piece } = this.pixels;
    const { level, samples, ms } = stats;
    const coarse = ["vertices", "pixels"][level] ?? `pixels of ${level} x ${level}`;
    const size = samples ? `pixels of ${samples} sample${samples > 1 ? "s" : ""}` : coarse;
    // Pages hold a row for each harmonic of reflected light, and the last one for lamps.
    const less =
      ["", ", lamps without highlights"][piece.content.reflectedUnit.length] ?? ", reflected light without highlights";
    this.told = samples;
    this.viewer.describe(`${size} by the browser's GPU${ms ? `, ${ms.toFixed(0)} ms` : ""}${less}`);
  }
}
