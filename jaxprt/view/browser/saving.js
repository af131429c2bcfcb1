// What a viewer saves: pictures, videos, its state and materials.

import { element } from "./common.js";

const RATE = 30; // frames a second
const BITS = 1.6e7; // a second of a video
const VIDEOS = ["video/mp4;codecs=avc1.640028", "video/webm;codecs=vp9", "video/webm"]; // what browsers may write, the best first

/** @type {Record<string, [string, { sized?: boolean, clear?: boolean, lasting?: boolean, python?: boolean }]>} */
// What can be saved: its name, and whether it has a size, may have no background, lasts some seconds, and needs Python.
const KINDS = {
  png: ["picture, PNG", { sized: true, clear: true }],
  exr: ["picture, linear EXR", { sized: true, clear: true, python: true }],
  orbit: ["video: the camera goes around", { sized: true, lasting: true }],
  turn: ["video: the light turns", { sized: true, lasting: true }],
  state: ["state of the viewer, JSON", {}],
  materials: ["materials, JSON", {}],
  glb: ["scene with its materials, GLB", { python: true }],
};

// Asks what is to be saved, and how.
/** @param {import("./viewer.js").Viewer} viewer */
export function dialogOf(parent, canvas, viewer) {
  const dialog = element("dialog", parent, { ariaLabel: "save" });
  const form = element("form", dialog, { method: "dialog" });
  element("h2", form, { textContent: "Save" });
  const field = (text, tag, fields) => {
    const row = element("label", form, { className: "row" });
    element("span", row, { textContent: text });
    return element(tag, row, fields);
  };
  const number = { type: "number", min: 1, max: 8192, step: 1, required: true };
  const kind = field("what", "select", {});
  const width = field("width in pixels", "input", number);
  const height = field("height in pixels", "input", number);
  const seconds = field("seconds", "input", { ...number, max: 60, value: 4 });
  const clear = field("transparent background", "input", { type: "checkbox" });
  const note = element("div", form, { className: "note", role: "status" });
  const end = element("div", form, { className: "row end" });
  const cancel = element("button", end, { type: "button", textContent: "cancel" });
  const save = element("button", end, { type: "submit", className: "main", textContent: "save" });
  const lock = (locked) => {
    for (const each of [kind, width, height, seconds, clear, save]) each.disabled = locked;
  };
  const show = () => {
    const [, { sized, clear: clears, lasting }] = KINDS[kind.value];
    for (const each of [width, height]) each.parentElement.hidden = each.disabled = !sized;
    clear.parentElement.hidden = !clears;
    seconds.parentElement.hidden = seconds.disabled = !lasting;
  };
  let saved = null; // the choices of what was saved last
  let stopped = null; // what gives up the present one
  kind.onchange = show;
  cancel.onclick = () => {
    stopped?.abort();
    stopped = null;
    lock(false);
    dialog.close();
  };
  form.onsubmit = async (event) => {
    event.preventDefault();
    const choice = {
      kind: kind.value,
      width: Number(width.value),
      height: Number(height.value),
      seconds: Number(seconds.value),
      transparent: clear.checked,
    };
    const own = (stopped = new AbortController()).signal;
    lock(true);
    note.textContent = "it is being made";
    try {
      const say = (text) => {
        if (!own.aborted) note.textContent = text;
      };
      const { blob, name } = await made(viewer, choice, say, own);
      if (own.aborted) return;
      const link = element("a", form, { href: URL.createObjectURL(blob), download: name });
      link.click();
      link.remove();
      setTimeout(() => URL.revokeObjectURL(link.href), 60000);
      saved = choice;
      dialog.close();
    } catch (error) {
      if (own.aborted) return;
      note.textContent = error.message;
    }
    stopped = null;
    lock(false);
    show();
  };
  return {
    open() {
      if (!stopped) {
        // else the dialog was left while its picture is being made
        note.textContent = kind.textContent = "";
        const python = viewer.scene?.rests.includes("picture");
        for (const [name, [text, { python: needs }]] of Object.entries(KINDS))
          if (!needs || python) element("option", kind, { value: name, textContent: text });
        const size = { width: canvas.width, height: canvas.height };
        const last = saved ?? { ...size, kind: "png", seconds: 4, transparent: false };
        for (const [name, input] of Object.entries({ kind, width, height, seconds })) input.value = last[name];
        clear.checked = last.transparent;
        show();
      }
      dialog.showModal();
      if (!width.disabled) width.select();
    },
  };
}

// What is chosen as a file with its name; `told` says meanwhile how far it is.
/** @param {import("./viewer.js").Viewer} viewer */
async function made(viewer, choice, told, signal) {
  const { scene, state } = viewer;
  const { kind } = choice;
  const json = (text) => new Blob([text], { type: "application/json" });
  if (!scene) throw new Error("there is no scene yet");
  if (kind === "state") return { blob: json(viewer.text()), name: "jaxprt.json" };
  if (kind === "materials") return { blob: json(materials(scene, state.materials)), name: "materials.json" };
  if (kind === "glb") {
    const { buffers } = await viewer.demand(viewer.message("glb"));
    return { blob: new Blob([buffers[0]], { type: "model/gltf-binary" }), name: "jaxprt.glb" };
  }
  const quick = { ...choice, samples: 4, transparent: false };
  const frames = {
    orbit: (share) => picture(viewer, quick, viewer.camera.around(2 * Math.PI * share)),
    turn: (share) => picture(viewer, quick, viewer.camera, { turn: state.turn + 2 * Math.PI * share }),
  };
  try {
    if (!frames[kind]) return { blob: await picture(viewer, { ...choice, format: kind }), name: `jaxprt.${kind}` };
    const blob = await video(frames[kind], choice, told, signal);
    return { blob, name: `jaxprt.${blob.type.split("/")[1]}` };
  } finally {
    viewer.drawing.gpu?.change(viewer.message("look"));
    viewer.redraw();
  }
}

// A picture of any size as a file: by Python where there is one, else by the graphics card. `fields` are those of the
// state that are others for it.
/** @param {import("./viewer.js").Viewer} viewer */
async function picture(viewer, choice, camera = viewer.camera, fields = {}) {
  const { scene, drawing, state } = viewer;
  const { width, height, transparent, format = "png", samples } = choice;
  const shows = { ...state, ...fields, background: transparent ? "none" : state.background };
  const look = { ...fields, eye: camera.eye };
  if (!scene.rests.includes("picture")) {
    drawing.gpu?.change({ ...viewer.message("look"), ...look });
    return drawn(await drawing.picture(camera, shows, scene.center, width, height), width, height);
  }
  const over = !transparent && format === "png" && state.background !== "light";
  const size = { width, height, transparent: transparent || over, format, samples };
  const asked = { ...viewer.message("picture"), ...look, stops: state.stops, ...size };
  const text = `a picture of ${width} x ${height} pixels`;
  const { content, buffers } = await viewer.waiting.during("picture", text, viewer.demand(asked), 0);
  if (content.kind === "late") throw new Error("a better scene has come meanwhile: ask again");
  const blob = new Blob([buffers[0]], { type: `image/${format}` });
  if (!over) return blob;
  const behind = drawing.backdrop(camera, shows, scene.center, width, height);
  return drawn(behind, width, height, await createImageBitmap(blob));
}

// Pixels that the graphics card has drawn as a PNG file, with an image over them.
async function drawn({ pixel, parts }, width, height, over = null) {
  const row = 4 * parts * width;
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  for (let y = 0, to = 0; y < height; y++)
    for (let x = 0; x < width; x++, to += 4) {
      const low = parts * ((height - 1 - y) * row + 4 * x);
      const sum = [0, 0, 0, 0]; // rows come from below
      for (let i = 0; i < parts; i++)
        for (let j = 0; j < parts; j++) for (let c = 0; c < 4; c++) sum[c] += pixel[low + i * row + 4 * j + c];
      for (let c = 0; c < 3; c++) image.data[to + c] = sum[3] && (255 * sum[c]) / sum[3];
      image.data[to + 3] = sum[3] / parts ** 2;
    }
  context.putImageData(image, 0, 0);
  if (over) context.drawImage(over, 0, 0);
  const file = await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
  if (!file) throw new Error(`this browser cannot make a picture of ${width} x ${height} pixels`);
  return file;
}

// A video of pictures. `picture` makes the one of a share of the whole, from 0 on. Browsers record what a canvas shows,
// so that all pictures are made first and then shown at their times.
async function video(picture, { width, height, seconds }, told, signal) {
  const type = VIDEOS.find((each) => window.MediaRecorder?.isTypeSupported(each));
  const frames = Math.round(seconds * RATE);
  const pictures = [];
  if (!type) throw new Error("this browser cannot record videos");
  for (let number = 0; number < frames; number++) {
    if (signal.aborted) throw new Error("the video was given up");
    told(`picture ${number + 1} of ${frames}`);
    pictures.push(await picture(number / frames));
  }
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d");
  const data = [];
  const recorder = new MediaRecorder(canvas.captureStream(RATE), { mimeType: type, videoBitsPerSecond: BITS });
  recorder.ondataavailable = (event) => data.push(event.data);
  const ended = new Promise((resolve, reject) => {
    recorder.onstop = resolve;
    recorder.onerror = () => reject(new Error("the browser could not record the video"));
  });
  told("recording");
  context.drawImage(await createImageBitmap(pictures[0]), 0, 0);
  recorder.start();
  const began = performance.now();
  for (let number = 0; number < frames; number++) {
    const image = await createImageBitmap(pictures[number]);
    const wait = began + (1000 * number) / RATE - performance.now();
    if (wait > 0) await new Promise((resolve) => setTimeout(resolve, wait));
    context.drawImage(image, 0, 0);
    image.close();
  }
  await new Promise((resolve) => setTimeout(resolve, 1000 / RATE));
  recorder.stop();
  await ended;
  return new Blob(data, { type: type.split(";")[0] });
}

// The materials of all parts that can change, as they are now.
function materials(scene, changed) {
  const free = scene.parts
    .filter((part) => part.free)
    .map(({ name, free }) => [
      name,
      Object.fromEntries(Object.entries({ ...free, ...changed[name] }).filter(([key]) => !key.endsWith("_range"))),
    ]);
  return JSON.stringify({ jaxprt: "materials", materials: Object.fromEntries(free) }, null, 2);
}
