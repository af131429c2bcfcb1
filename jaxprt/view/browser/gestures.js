// What the mouse, fingers and keys do.

import { clamp } from "./common.js";
import { BACKGROUNDS } from "./drawing.js";
import { droppedFiles, openFiles } from "./files.js";

const GLIDE = 130; // milliseconds in which a turn that was let go falls to a third of its speed
const STOPPED = 60; // milliseconds without a move after which the hand had stopped
const SLOWEST = 2e-5; // radians a millisecond

const keys = (text) =>
  text
    .split(" ")
    .map((key) => `<kbd>${key}</kbd>`)
    .join(" ");
export const HINT = {
  mouse: `drag to orbit, wheel to zoom, ${keys("Shift")}-drag to turn the light, ${keys("H")} for all keys`,
  touch: "one finger orbits, two zoom and pan, a double tap looks at a point",
};
export const HELP = [
  [`drag, one finger, ${keys("← → ↑ ↓")}`, "orbit"],
  [`right drag, ${keys("Ctrl")}-drag, two fingers, ${keys("Shift")} ${keys("← → ↑ ↓")}`, "pan"],
  [`wheel, pinch, ${keys("+ -")}`, "zoom, to where the pointer is"],
  [keys("F"), "show all of the part that was picked last, or of the scene"],
  ["double-click, double tap", "look at a point, and open its material"],
  [`${keys("Alt")}-click`, "open the material of a part"],
  [`${keys("Shift")}-drag, ${keys("[ ]")}`, "turn the light"],
  [keys("L"), "next light"],
  ["drop files", "a scene with what belongs to it, HDR or EXR files as other lights, or a saved state"],
  [keys("C"), "remove the suns"],
  [keys(", ."), "exposure"],
  [keys("A"), "automatic exposure"],
  [keys("G"), "background"],
  [keys("B"), "bounces"],
  [keys("S"), "next system"],
  [keys("P"), "fine picture at rest"],
  [keys("E"), "exact picture at rest"],
  [`${keys("Z")}, ${keys("Y")}`, "undo, redo"],
  [keys("R"), "reset"],
  [keys("H"), "this help"],
];

/** @param {import("./viewer.js").Viewer} viewer */
export function gestures(canvas, frame, viewer) {
  const points = new Map();
  let pinch = null;
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [(2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height];
  };
  /** @returns {[number, number]} */
  const aside = (event) => {
    const box = canvas.getBoundingClientRect();
    return [
      (event.clientX - box.left - box.width / 2) / (box.height || 1),
      (event.clientY - box.top - box.height / 2) / (box.height || 1),
    ];
  };
  // A turn of the camera goes on for a moment after the hand has let go, unless the system asks for less motion.
  let swing = null;
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  const hold = () => {
    if (swing) cancelAnimationFrame(swing.frame);
    swing = null;
  };
  const glide = (now) => {
    const passed = now - swing.at;
    const slower = Math.exp(-passed / GLIDE);
    viewer.camera.orbit(swing.dx * passed, swing.dy * passed);
    swing =
      Math.hypot(swing.dx, swing.dy) * slower > SLOWEST
        ? { dx: swing.dx * slower, dy: swing.dy * slower, at: now, frame: requestAnimationFrame(glide) }
        : null;
    viewer.moved();
  };
  const release = (event) => {
    points.delete(event.pointerId);
    pinch = null;
    if (!speed || event.timeStamp - speed.at > STOPPED || calm.matches) return;
    swing = { ...speed, at: performance.now(), frame: requestAnimationFrame(glide) };
  };
  let speed = null; // of the camera, in radians a millisecond
  const spot = (event) => [event.clientX, event.clientY];
  const middle = () => {
    const [a, b] = [...points.values()];
    return { at: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.hypot(a[0] - b[0], a[1] - b[1]) || 1 };
  };
  const listen = {
    contextmenu: (event) => event.preventDefault(),
    pointerdown(event) {
      if (!viewer.camera) return;
      canvas.focus({ preventScroll: true });
      hold();
      speed = null;
      if (event.altKey) return viewer.picking.pick(...place(event));
      canvas.setPointerCapture(event.pointerId);
      points.set(event.pointerId, spot(event));
      pinch = points.size === 2 ? middle() : null;
    },
    pointermove(event) {
      const from = points.get(event.pointerId);
      if (!from || !viewer.camera) return;
      const to = spot(event);
      const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
      const height = canvas.clientHeight || 1;
      points.set(event.pointerId, to);
      const before = speed;
      speed = null;
      if (points.size === 2 && pinch) {
        const now = middle();
        viewer.camera.zoom(pinch.apart / now.apart, aside({ clientX: now.at[0], clientY: now.at[1] }));
        viewer.camera.pan((now.at[0] - pinch.at[0]) / height, (now.at[1] - pinch.at[1]) / height);
        pinch = now;
      } else if (event.shiftKey) return viewer.set({ turn: viewer.state.turn + 0.01 * dx });
      else if (event.ctrlKey || event.buttons & 2) viewer.camera.pan(dx / height, dy / height);
      else {
        viewer.camera.orbit(0.01 * dx, 0.01 * dy);
        const passed = Math.max(1, event.timeStamp - (before?.at ?? event.timeStamp - 16));
        speed = { dx: (0.01 * dx) / passed, dy: (0.01 * dy) / passed, at: event.timeStamp };
      }
      viewer.moved();
    },
    pointerup: release,
    pointercancel: release,
    dblclick(event) {
      if (!viewer.camera) return;
      viewer.picking.lookAt(...place(event));
    },
    wheel(event) {
      if (!viewer.camera) return;
      event.preventDefault();
      hold();
      viewer.camera.zoom(Math.exp(0.001 * clamp(event.deltaY, -300, 300)), aside(event));
      viewer.moved();
    },
  };
  // Letters act wherever nothing is typed; arrows, + and - on the picture alone.
  const typed = (event) => {
    const from = event.composedPath()[0];
    const elsewhere = from !== canvas;
    const taken = event.key.toLowerCase() === "z" || event.key.toLowerCase() === "y"; // keys of undo, which other programs have with Ctrl
    if (
      !viewer.camera ||
      event.altKey ||
      ((event.metaKey || event.ctrlKey) && !taken) ||
      from.closest("dialog, input:not([type=range]), select")
    )
      return;
    if (
      elsewhere &&
      (event.key.length > 1 || "+-= ".includes(event.key)) &&
      !(event.key === "Escape" && !viewer.view.help.hidden)
    )
      return;
    hold();
    if (!key(event, viewer)) return;
    event.preventDefault();
    event.stopPropagation();
  };
  for (const [name, each] of Object.entries(listen)) canvas.addEventListener(name, each, { passive: false });
  frame.addEventListener("keydown", typed);
  frame.addEventListener("dragover", (event) => event.preventDefault());
  frame.addEventListener("drop", (event) => {
    event.preventDefault();
    droppedFiles(event.dataTransfer).then((files) => files.length && openFiles(viewer, files));
  });
  return {
    get held() {
      return points.size > 0 || swing !== null;
    },
    close() {
      hold();
      for (const [name, each] of Object.entries(listen)) canvas.removeEventListener(name, each);
      frame.removeEventListener("keydown", typed);
    },
  };
}

/** @param {import("./viewer.js").Viewer} viewer */
function key(event, viewer) {
  const { state, scene, camera, view } = viewer;
  const names = Object.keys(scene.systems);
  const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  const next = names[(names.indexOf(state.system) + 1) % names.length];
  const expose = (stops) => viewer.set({ auto: false, stops: clamp(stops, -20, 20) });
  const zoom = (factor) => {
    camera.zoom(factor);
    viewer.moved();
  };
  if (arrow) {
    if (event.shiftKey) camera.pan(0.05 * arrow[0], 0.05 * arrow[1]);
    else camera.orbit(0.1 * arrow[0], 0.1 * arrow[1]);
    viewer.moved();
    return true;
  }
  const act = {
    "+": () => zoom(0.9),
    "=": () => zoom(0.9),
    "-": () => zoom(1 / 0.9),
    "[": () => viewer.set({ turn: state.turn - 0.1 }),
    "]": () => viewer.set({ turn: state.turn + 0.1 }),
    ",": () => expose(state.stops - 0.5),
    ".": () => expose(state.stops + 0.5),
    // What changes nothing leaves the picture at rest.
    l: () => scene.lights.length > 1 && viewer.set({ light: (state.light + 1) % scene.lights.length }),
    s: () => names.length > 1 && viewer.set({ system: next, bounces: state.bounces && scene.systems[next].bounces }),
    b: () => scene.systems[state.system].bounces && viewer.set({ bounces: !state.bounces }),
    g: () => viewer.set({ background: BACKGROUNDS[(BACKGROUNDS.indexOf(state.background) + 1) % BACKGROUNDS.length] }),
    p: () => viewer.set({ still: !state.still }),
    e: () => viewer.set({ exact: !state.exact }),
    z: () => viewer.undo(event.shiftKey ? 1 : -1),
    y: () => viewer.undo(1),
    f: () => viewer.picking.frame(),
    c: () => state.lamps.length && viewer.set({ lamps: [] }),
    r: () => viewer.reset(),
    a: () => viewer.set({ auto: true }),
    h: () => view.toggleHelp(),
    escape: () => view.help.hidden || view.toggleHelp(),
  }[event.key.toLowerCase()];
  act?.();
  return Boolean(act);
}
