// What comes while nothing moves: the light as it is seen, pictures at pixels, and small pictures of the other lights.

import { decompressed, inflate, numbers, pause } from "./common.js";
import { SMALL } from "./panel.js";

const PATIENT = 250; // milliseconds without a change after which a rest begins
const SLOW_PICTURE = 500; // milliseconds of a whole picture from which on a coarse one comes first
const SKY_ROWS = 1024; // of the picture of a light at rest, if its file has so many

export class Rests {
  /** @param {import("./viewer.js").Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    this.timer = 0;
    this.busy = false; // whether a picture at pixels is asked for
    this.unanswered = false; // whether the last one got no answer; it is asked for again
    this.whole = { size: "", made: 0, ms: 0 }; // whole pictures of one size: how many, and what the last one took
    this.light = { key: "", rows: 0 }; // what has been asked for as it is seen
    this.small = new Map(); // by the number of the light: of the scene as it was when each was made
  }
  // The present colors are shown: a rest begins soon.
  begin() {
    this.sky();
    this.timer = setTimeout(() => this.rest(), PATIENT);
  }
  // Something has changed.
  end() {
    clearTimeout(this.timer);
    this.viewer.drawing.dropStills(0);
  }
  async rest() {
    const { colors } = this.viewer;
    if (!colors.long) this.sky(SKY_ROWS);
    await this.still();
    if (!colors.long) this.thumbnails();
  }
  // Has the light be asked for again.
  forgetSky() {
    this.light = { key: "", rows: 0 };
  }
  // The light as it is seen: a small picture at once and a fine one at rest, unless the way is long.
  async sky(rows = 1) {
    const { viewer } = this;
    const key = JSON.stringify([viewer.state.light, viewer.state.lamps]);
    if (key === this.light.key && rows <= this.light.rows) return;
    this.light = { key, rows };
    try {
      const { content, buffers } = await viewer.ask({ ...viewer.message("sky"), rows });
      if (content.kind === "late") this.forgetSky();
      if (viewer.closed || content.kind !== "sky" || this.light.key !== key) return;
      const pixel = numbers(Uint16Array, buffers[0]);
      if (rows === 1) viewer.controls?.paint(pixel, content);
      if (this.light.rows !== rows) return; // the fine one has been asked for
      viewer.drawing.setSky(pixel, content, key);
      viewer.stats.sky = content.height;
      viewer.redraw();
    } catch {
      this.forgetSky();
    }
  }
  // Small pictures of the scene in each light: by colors from Python, or by the GPU where there is none.
  async thumbnails() {
    const { viewer, small } = this;
    const { drawing, scene, stats } = viewer;
    const { seq } = stats;
    const plain = { turn: 0, lamps: [], stops: null, vertices: "all" };
    if (scene.lights.length < 2 || !scene.pictured) return;
    for (let light = small.size; light < scene.lights.length && seq === stats.seq && !viewer.closed; light++) {
      const message = { ...viewer.message("look"), ...plain, light };
      const alone = !scene.rests.length;
      if (alone && !drawing.gpu) return;
      try {
        const { content, buffers } = alone ? { content: { kind: "color" }, buffers: [] } : await viewer.ask(message);
        if (viewer.closed || content.kind !== "color" || small.has(light)) return;
        const colors = alone ? { message } : { color: numbers(Uint16Array, buffers[0]), scale: content.scale };
        small.set(light, drawing.thumbnail(viewer.camera, viewer.state, scene.center, SMALL, colors));
        viewer.controls?.thumbnail(light, small.get(light));
        viewer.redraw();
        if (alone) await pause();
      } catch {
        return;
      }
    }
  }
  // The picture at pixels, then the exact one. Where they take long a coarse one comes first. The first picture of a
  // size does not count: its programs are compiled. Python gives up what it is at when the next look comes.
  async still() {
    const { viewer } = this;
    const { state, stats, canvas, colors } = viewer;
    if (!viewer.scene.rests.length || this.busy || viewer.closed || colors.flying) return;
    const { seq } = stats;
    const size = `${canvas.width} ${canvas.height}`;
    if (this.whole.size !== size) this.whole = { size, made: 0, ms: 0 };
    const slow = this.whole.made > 1 && this.whole.ms > SLOW_PICTURE;
    const steps = [];
    for (const coarse of slow ? [true, false] : [false]) if (state.still) steps.push({ kind: "still", coarse });
    for (const coarse of [true, false]) if (state.exact) steps.push({ kind: "exact", coarse });
    if (!steps.length) return;
    this.busy = true;
    try {
      for (const step of steps) if (seq !== stats.seq || !(await this.picture(step))) break;
    } catch (error) {
      this.unanswered = true;
      viewer.tell(`no answer from Python: ${error.message}`);
    } finally {
      this.busy = false;
    }
    if ((seq !== stats.seq || this.unanswered) && !viewer.closed && !colors.flying && stats.shown === stats.seq)
      this.timer = setTimeout(() => this.still(), this.unanswered ? 1000 : PATIENT);
  }
  // Asks for a picture of the present state and shows it; false if there is none, or the state is another one.
  async picture({ kind, coarse }) {
    const { viewer, whole } = this;
    const { state, stats } = viewer;
    const { seq } = stats;
    const { width, height } = viewer.canvas;
    const asked = { ...viewer.message(kind), width, height, coarse, transparent: state.background !== "light" };
    const text = kind === "still" ? "computing the picture at pixels" : "computing the exact picture";
    const { content, buffers } = await viewer.waiting.during("still", text, viewer.ask(asked));
    if (viewer.closed) return false;
    if (this.unanswered) viewer.tell();
    this.unanswered = false;
    if (seq !== stats.seq || content.kind === "late") return false;
    if (content.kind === "error") {
      viewer.tell(content.message);
      return false;
    }
    const encoded = asked.stops !== null;
    const color = encoded
      ? await inflate(buffers[0], content.width * content.height)
      : numbers(Uint16Array, buffers[0]);
    const cover = asked.transparent ? await decompressed(buffers[1]) : null;
    if (seq !== stats.seq) return false;
    viewer.drawing.addStill(color, content.width, content.height, encoded, content.scale, cover);
    viewer.redraw();
    stats[coarse ? "coarse" : "stills"]++;
    if (coarse) return true;
    if (viewer.drawing.gpu) viewer.describe(`${kind === "still" ? "picture at pixels" : "exact picture"} by Python`);
    if (kind === "still") this.whole = { ...whole, made: whole.made + 1, ms: content.ms };
    else {
      const percent = (share) => (100 * share).toFixed(1);
      const off = `: the picture is ${percent(content.error)} ± ${percent(content.spread)} % off`;
      viewer.tell(`exact, direct light of the environment alone${content.error === undefined ? "" : off}`);
    }
    return true;
  }
}
