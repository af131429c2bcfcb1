// The frame around the picture: buttons, what is waited for, messages, the hint at the start, the help, and the
// dialog of pictures.

import { clamp, element } from "./common.js";
import { HINT, HELP } from "./gestures.js";
import { dialogOf } from "./saving.js";
import { STYLE } from "./style.js";

const NARROW = 480; // pixels of the frame up to which the panel lies below the picture, and is folded at first

// Paths of 16 x 16.
const ICONS = {
  picture: "M2 5h3l1.5-2h3L11 5h3v8H2zM8 11.2a2.4 2.4 0 1 0 0-4.8 2.4 2.4 0 0 0 0 4.8z",
  undo: "M6 3 2.5 6.5 6 10M2.5 6.5H9a4 4 0 0 1 0 7H7",
  redo: "M10 3l3.5 3.5L10 10M13.5 6.5H7a4 4 0 0 0 0 7h2",
  frame: "M2 5.5V2h3.5M10.5 2H14v3.5M14 10.5V14h-3.5M5.5 14H2v-3.5M6 6h4v4H6z",
  reset: "M3 8a5 5 0 1 0 1.6-3.7M3 2.5v3h3",
  theme: "M8 13.5a5.5 5.5 0 1 0 0-11zM8 2.5a5.5 5.5 0 0 0 0 11",
  help: "M5.8 6a2.2 2.2 0 1 1 3.2 2c-.7.4-1 .8-1 1.6M8 12.2v.1",
  panel: "M2 4.5h6m3 0h3M9.5 3v3M2 11.5h2m3 0h7M5.5 10v3",
};

// Has a document or a shadow tree look as a style says. Policies of pages forbid elements of style.
function styled(root, text) {
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(text);
  root.adoptedStyleSheets = [sheet];
}

// Has the element of the viewer fill a page of its own.
export function fillPage(page) {
  styled(page, "body { margin: 0; height: 100vh; background: #1a1a1a; } #viewer { height: 100%; }");
}

// The elements of a viewer in `shadow`.
/** @param {import("./viewer.js").Viewer} viewer */
export function frameOf(shadow, viewer) {
  styled(shadow, STYLE);
  const frame = element("div", shadow, { className: "frame" });
  const stage = element("div", frame, { className: "stage" });
  const canvas = element("canvas", stage, { className: "canvas", tabIndex: 0, role: "application" });
  canvas.ariaLabel = "the scene; press H for the keys";
  const bar = element("div", stage, { className: "busy", hidden: true, role: "progressbar" });
  const words = element("div", stage, { className: "words" });
  const waiting = element("div", words, { className: "stagetext", hidden: true, role: "status" });
  const told = element("div", words, { className: "told", hidden: true, role: "status" });
  const line = element("div", stage, { className: "line" });
  const hint = element("div", stage, {
    className: "hint",
    innerHTML: matchMedia("(pointer: coarse)").matches ? HINT.touch : HINT.mouse,
  });
  const tools = element("div", stage, { className: "tools" });
  const panel = element("div", frame, { className: "panel", role: "region", ariaLabel: "controls" });
  const help = helpOf(stage);
  const dialog = dialogOf(frame, canvas, viewer);
  const tool = (name, label, act) => {
    const innerHTML = `<svg viewBox="0 0 16 16" aria-hidden="true"><path d="${ICONS[name]}"/></svg>`;
    return element("button", tools, { type: "button", title: label, ariaLabel: label, onclick: act, innerHTML });
  };
  const started = () => (hint.hidden = true);
  const toggleHelp = () => {
    help.hidden = !help.hidden;
    started();
    if (help.hidden) canvas.focus();
    else help.querySelector("button").focus();
  };
  help.querySelector("button").onclick = toggleHelp;
  tool("picture", "save a picture, a video or the state", () => dialog.open());
  const undo = tool("undo", "undo (Z)", () => viewer.undo(-1));
  const redo = tool("redo", "redo (Y)", () => viewer.undo(1));
  tool("frame", "show all of the part that was picked last, or of the scene (F)", () => viewer.picking.frame());
  tool("reset", "reset the view, the light, the materials and the display (R)", () => viewer.reset());
  tool("theme", "dark or light", () => keep(!frame.classList.contains("light")));
  tool("help", "help (H)", toggleHelp);
  const unfold = tool("panel", "controls", () => fold(!frame.classList.contains("folded")));
  const fold = (folded) => {
    frame.classList.toggle("folded", folded);
    unfold.ariaPressed = String(!folded);
  };
  const theme = (light) => {
    frame.classList.toggle("light", light);
    frame.dispatchEvent(new Event("theme"));
  };
  const keep = (light) => {
    theme(light);
    try {
      localStorage.setItem("jaxprt-theme", light ? "light" : "dark");
    } catch {
      /* pages without storage forget it */
    }
  };
  const preferred = matchMedia("(prefers-color-scheme: light)");
  let stored = null;
  try {
    stored = localStorage.getItem("jaxprt-theme");
  } catch {
    /* likewise */
  }
  theme(stored ? stored === "light" : preferred.matches);
  preferred.addEventListener("change", (event) => theme(event.matches));
  fold(false);
  const watch = new ResizeObserver(() => {
    const narrow = frame.clientWidth <= NARROW;
    if (narrow === frame.classList.contains("narrow")) return;
    frame.classList.toggle("narrow", narrow);
    fold(narrow);
  });
  watch.observe(frame);
  for (const kind of ["pointerdown", "wheel", "keydown"]) frame.addEventListener(kind, started);
  return {
    frame,
    canvas,
    panel,
    line,
    help,
    toggleHelp,
    unfold: () => fold(false),
    close: () => watch.disconnect(),
    // Whether there is something to undo, and to redo.
    steps(back, ahead) {
      [undo.disabled, redo.disabled] = [!back, !ahead];
    },
    tell(text) {
      told.textContent = text;
      told.hidden = !text;
    },
    // What is waited for, and how far it is, from 0 to 1; null where nobody knows. No text: nothing is.
    busy(text, part = null) {
      bar.hidden = waiting.hidden = !text;
      bar.classList.toggle("open", part === null);
      const percent = part === null ? null : String(Math.round(100 * clamp(part, 0, 1)));
      bar.style.setProperty("--part", part === null ? null : clamp(part, 0, 1));
      bar.ariaValueNow = percent;
      bar.ariaLabel = text || "nothing is waited for";
      const shown = text && percent ? `${text}: ${percent} %` : text || "";
      if (waiting.textContent !== shown) waiting.textContent = shown;
    },
  };
}

function helpOf(parent) {
  const help = element("div", parent, { className: "help", hidden: true, role: "dialog", ariaLabel: "help" });
  const head = element("header", help);
  element("span", head, { textContent: "Mouse, fingers and keys" });
  element("button", head, { type: "button", textContent: "close" });
  const table = element("tbody", element("table", help));
  for (const [keys, what] of HELP) {
    const row = element("tr", table);
    element("td", row, { innerHTML: keys });
    element("td", row, { textContent: what });
  }
  return help;
}
