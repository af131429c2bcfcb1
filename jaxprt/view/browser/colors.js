// Colors of the vertices from Python: one question at a time, the newest state next.

import { inflate, numbers } from "./common.js";

export class Colors {
  /** @param {import("./viewer.js").Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
    // Whether round trips are long: the kernel is far away, or the browser draws slowly. Then colors come as bytes, and
    // those that the eye can see first.
    this.long = false;
    this.bytes = null;
    this.partial = false; // whether only those that the eye can see have come
    this.flying = false; // whether a question is under way
    this.dirty = false; // whether something has changed meanwhile
    this.answers = 0;
    this.framed = 0; // when the last ones came
  }
  // `vertices`: which ones are asked for over a long way, "seen" or "unseen".
  async ask(vertices) {
    const { viewer } = this;
    const { stats } = viewer;
    if (this.flying) this.dirty = true;
    if (this.flying || viewer.closed) return;
    [this.flying, this.dirty] = [true, false];
    const began = performance.now();
    const { unexposed } = viewer;
    const some = this.long && this.bytes && !unexposed;
    const asked = { ...viewer.message("look"), vertices: some ? vertices : "all" };
    if (unexposed) asked.stops = null; // radiance, of which the exposure is found
    stats.sent++;
    try {
      const answer = viewer.ask(asked);
      const { content, buffers } = await viewer.waiting.during("look", "waiting for colors from Python", answer);
      if (viewer.closed) return;
      if (content.kind === "late") return viewer.scenes.load(); // there is a better scene
      if (content.kind === "error") {
        stats.errors++;
        viewer.tell(content.message);
      } else {
        const encoded = asked.stops !== null;
        if (encoded) this.bytes = await inflate(buffers[0], viewer.scene.vertices, this.bytes, buffers[1]);
        this.partial = asked.vertices === "seen";
        viewer.drawing.setColor(encoded ? this.bytes : numbers(Uint16Array, buffers[0]), encoded, content.scale);
        if (unexposed) viewer.measure(asked.light);
        this.learn(content, performance.now() - began, buffers);
        viewer.redraw();
      }
    } catch (error) {
      stats.errors++;
      viewer.tell(`no answer from Python: ${error.message}`);
      const retry = () => {
        this.dirty = false;
        viewer.look();
      };
      if (!viewer.closed) setTimeout(retry, 1000);
    } finally {
      this.flying = false;
    }
    if (this.dirty) viewer.look();
    else if (stats.shown === stats.seq && this.partial) viewer.look("unseen");
    else if (stats.shown === stats.seq) viewer.rests.begin();
  }
  // Learns from an answer how long the way is, and says how long its parts took.
  learn({ ms, seq }, trip, buffers) {
    const { viewer } = this;
    const { stats } = viewer;
    const spent = ms.light + ms.view + ms.combine;
    this.long = this.long ? trip - spent > 15 : trip - spent > 60 + spent;
    this.answers++;
    const size = buffers.reduce((total, buffer) => total + buffer.byteLength, 0);
    const shown = Math.max(stats.shown, seq); // the GPU may have shown a newer state
    Object.assign(stats, { trip, shown, got: stats.got + 1, bytes: stats.bytes + size });
    if (seq === stats.seq) viewer.tell();
    const rate = this.framed && 1000 / (performance.now() - this.framed);
    this.framed = performance.now();
    if (viewer.drawing.gpu) return;
    const digits = (x) => x.toFixed(x < 10 ? 1 : 0);
    const times = { light: ms.light, view: ms.view, combine: ms.combine, "there and back": trip };
    const parts = Object.entries(times).map(([name, time]) => `${name} ${digits(time)} ms`);
    parts.push(...(rate ? [`${digits(rate)}/s`] : []), `${(size / 1024).toFixed(0)} kB`);
    const { reason } = viewer.gpu;
    viewer.describe(parts.join(" · "), reason && ` · colors from Python: ${reason}`);
  }
}
