// The panel of controls: the light, the view, and the materials of the parts.

import { clamp, dot, element, half, hex, toDisplay, toLinear, unhex } from "./common.js";
import { BACKGROUNDS, TONES } from "./drawing.js";
import { openFiles } from "./files.js";

export const SMALL = { width: 72, height: 54 }; // pixels of the pictures of lights
const MANY = 3; // parts up to which all of their controls are open at first; of more, the first
const FILTER = 10; // parts up to which one is open at first; of more, names can be searched
const DEGREE = Math.PI / 180;

const section = (panel, title, open = true, className = "") => {
  const node = element("details", panel, { open, className });
  element("summary", node, { textContent: title, title });
  return node;
};
const row = (parent, text) => {
  const node = element("label", parent, { className: "row" });
  element("span", node, { textContent: text });
  return node;
};

// A slider and a number that can be typed. The slider runs over places, which `at` makes values of and `of` finds again.
function slider(
  parent,
  text,
  { low, high, step, at = (x) => x, of = (x) => x, digits, title = text, wrap = (x) => clamp(x, low, high) },
  pick,
) {
  const node = element("div", parent, { className: "row", title });
  element("span", node, { textContent: text });
  const [from, to] = [of(low), of(high)].sort((a, b) => a - b);
  const steps = { min: from, max: to, step: step ?? (to - from) / 200 };
  const range = element("input", node, { type: "range", ariaLabel: text, ...steps });
  const number = element("input", node, { type: "number", step: 10 ** -digits, ariaLabel: `${text}, typed` });
  range.oninput = () => pick(at(Number(range.value)));
  let typing = false; // what is typed stays until it is taken
  number.oninput = () => {
    typing = true;
  };
  number.onblur = () => {
    typing = false;
  };
  number.onchange = () => {
    typing = false;
    if (number.value !== "" && Number.isFinite(Number(number.value))) pick(wrap(Number(number.value)));
    node.show(node.value, !number.disabled);
  };
  number.onkeydown = (event) => {
    if (event.key === "Enter") number.onchange();
  };
  node.show = (value, acts = true) => {
    node.value = value;
    range.disabled = number.disabled = !acts;
    const shown = String(Number(value.toFixed(digits)));
    if (range.value !== String(of(value))) range.value = of(value);
    if (!typing && number.value !== shown) number.value = shown;
    range.ariaValueText = shown;
  };
  return node;
}

/** @param {import("./viewer.js").Viewer} viewer */
export function panelOf(viewer) {
  const { scene, state } = viewer;
  const { panel } = viewer.view;
  const set = (fields) => viewer.set(fields);
  panel.textContent = "";
  const choice = (parent, text, names, pick) => {
    const node = element("select", row(parent, text), { ariaLabel: text });
    node.fill = (labels) => {
      node.textContent = "";
      labels.forEach((name, i) => element("option", node, { textContent: name, value: i }));
    };
    node.fill(names);
    node.onchange = () => pick(Number(node.value));
    return node;
  };
  const box = (parent, text, key) => {
    const label = element("label", panel, { className: "row" });
    parent.appendChild(label);
    element("span", label, { className: "long", textContent: text });
    const node = element("input", label, { type: "checkbox" });
    node.onchange = () => set({ [key]: node.checked });
    return [key, node];
  };

  const lightPart = section(panel, "Light");
  const light = choice(lightPart, "light", scene.lights, (i) => set({ light: i }));
  const gallery = element("div", lightPart, { className: "gallery", hidden: true, role: "group" });
  gallery.ariaLabel = "the scene in each light";
  // Room for a picture from the start on: what is below must not move under a hand.
  const pictured = () => {
    const number = gallery.children.length;
    const name = scene.lights[number];
    const act = { onclick: () => set({ light: number }), ariaLabel: `light: ${name}` };
    const button = element("button", gallery, { type: "button", title: name, ...act });
    element("canvas", button, { ...SMALL, ariaHidden: "true" });
  };
  const sides = { low: -180, high: 180, step: 1, digits: 1, wrap: (x) => ((((x + 180) % 360) + 360) % 360) - 180 };
  const turn = slider(lightPart, "rotation °", sides, (degrees) => set({ turn: degrees * DEGREE }));
  const sky = element("canvas", lightPart, {
    className: "sky",
    width: 256,
    height: 128,
    tabIndex: 0,
    title: "the light as it is turned; the mark at its lower edge is where the camera looks",
    role: "application",
    ariaLabel: "the light around the scene: a click or Enter puts a sun, a drag paints light, arrows move the place",
  });
  element("div", lightPart, { className: "note", textContent: "Click to put a sun, drag to paint light." });
  const tint = element("input", row(lightPart, "sun color"), { type: "color", value: "#fff0d8" });
  const buttons = element("div", lightPart, { className: "row" });
  const clear = element("button", buttons, {
    textContent: "remove suns",
    type: "button",
    className: "clear",
    onclick: () => set({ lamps: [] }),
  });
  const file = element("input", lightPart, {
    type: "file",
    accept: ".hdr,.exr,.png,.jpg",
    multiple: true,
    hidden: true,
  });
  file.onchange = () => {
    const files = [...file.files].map((light) => ({ place: light.name, file: light }));
    openFiles(viewer, files);
    file.value = "";
  };
  element("button", buttons, {
    textContent: "open a light…",
    type: "button",
    title: "an HDR or EXR file, which can be dropped on the picture, too",
    onclick: () => file.click(),
  });
  const strip = stripOf(sky, tint, state, set);

  const viewPart = section(panel, "View");
  const names = Object.keys(scene.systems);
  const system =
    names.length > 1
      ? choice(viewPart, "system", names, (i) =>
          set({ system: names[i], bounces: state.bounces && scene.systems[names[i]].bounces }),
        )
      : null;
  const exposure = slider(
    viewPart,
    "exposure",
    { low: -12, high: 12, step: 0.1, digits: 2, wrap: (x) => clamp(x, -20, 20) },
    (stops) => set({ auto: false, stops }),
  );
  const boxes = [box(viewPart, "automatic exposure", "auto")];
  const tone = choice(viewPart, "tone curve", TONES, (i) => set({ tone: TONES[i] }));
  const wide = slider(viewPart, "view angle °", { low: 5, high: 120, step: 1, digits: 1 }, (degrees) => {
    viewer.camera.widen(degrees * DEGREE);
    viewer.moved();
  });
  const behind = choice(viewPart, "background", BACKGROUNDS, (i) => set({ background: BACKGROUNDS[i] }));
  const ground = element("input", row(viewPart, "its color"), { type: "color" });
  ground.oninput = () => set({ ground: unhex(ground.value) });
  if (scene.rests.includes("still")) boxes.push(box(viewPart, "fine picture at rest", "still"));
  if (scene.rests.includes("exact")) boxes.push(box(viewPart, "exact picture at rest", "exact"));
  if (Object.values(scene.systems).some((each) => each.bounces)) boxes.push(box(viewPart, "bounces", "bounces"));

  let seen = 0; // the angle of view that is told
  const free = scene.parts.filter((part) => part.free);
  const parts = new Map();
  const materialPart = free.length
    ? section(panel, free.length > MANY ? `Materials of ${free.length} parts` : "Materials")
    : null;
  if (free.length > FILTER) {
    const search = element("input", row(materialPart, "find a part"), { type: "text" });
    search.oninput = () => {
      for (const [name, part] of parts) part.box.hidden = !name.toLowerCase().includes(search.value.toLowerCase());
    };
  }
  for (const part of free) {
    const opened = free.length <= MANY || (!parts.size && free.length <= FILTER);
    parts.set(part.name, materialOf(materialPart, part, state, opened, set));
  }
  return {
    show() {
      if (light.length !== scene.lights.length) light.fill(scene.lights);
      light.value = state.light;
      while (scene.pictured && gallery.children.length < scene.lights.length) pictured();
      gallery.hidden = gallery.children.length < 2;
      [...gallery.children].forEach((button, i) => (button.ariaPressed = String(i === state.light)));
      turn.show(sides.wrap(state.turn / DEGREE));
      if (system) system.value = names.indexOf(state.system);
      exposure.show(state.stops);
      tone.value = TONES.indexOf(state.tone);
      behind.value = BACKGROUNDS.indexOf(state.background);
      ground.value = hex(state.ground);
      ground.parentElement.hidden = state.background !== "color";
      clear.disabled = !state.lamps.length;
      for (const [key, each] of boxes) each.checked = state[key];
      for (const part of parts.values()) part.show();
      strip.show();
    },
    // Shows a picture of the scene in a light, RGBA from below, in whose place a click puts the light.
    thumbnail(number, pixel) {
      const { width, height } = SMALL;
      const context = gallery.children[number].firstChild.getContext("2d");
      const image = context.createImageData(width, height);
      for (let y = 0; y < height; y++)
        image.data.set(pixel.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
      context.putImageData(image, 0, 0);
    },
    paint: strip.paint,
    // Where the camera stands, and how wide it sees.
    look({ azimuth, angle }) {
      strip.look(azimuth);
      if (angle !== seen) wide.show(angle / DEGREE);
      seen = angle;
    },
    // Opens the controls of a part, by its name, and marks it.
    pick(name) {
      for (const [each, part] of parts) part.box.classList.toggle("picked", each === name);
      const part = parts.get(name);
      if (!part) return false;
      materialPart.open = part.box.open = true;
      part.box.hidden = false;
      part.show();
      part.box.scrollIntoView({ block: "nearest" });
      return true;
    },
  };
}

// The picture of the environment as it is turned. A click puts a small bright lamp on it, a drag wide faint ones
// along its way.
function stripOf(canvas, tint, state, set) {
  const image = document.createElement("canvas");
  const place = { x: 0.5, y: 0.25 };
  let source = null;
  let drawn = "";
  let azimuth = 0;
  let keys = false;
  const radiance = () => {
    // the picture of the unturned light, at the exposure of the moment
    const { data, scale } = source;
    const gain = scale * 2 ** state.stops;
    const context = image.getContext("2d");
    const pixel = context.createImageData(image.width, image.height);
    for (let i = 0; i < image.width * image.height; i++) {
      for (let c = 0; c < 3; c++) pixel.data[4 * i + c] = 255 * toDisplay(clamp(half(data[3 * i + c]) * gain, 0, 1));
      pixel.data[4 * i + 3] = 255;
    }
    context.putImageData(pixel, 0, 0);
    drawn = state.stops;
  };
  const draw = () => {
    if (!source) return;
    if (drawn !== state.stops) radiance();
    const context = canvas.getContext("2d");
    const w = canvas.width;
    const left = ((((-state.turn / (2 * Math.PI)) % 1) + 1) % 1) * w;
    for (const x of [left - w, left]) context.drawImage(image, x, 0, w, canvas.height);
    const x = ((((0.5 - (azimuth + Math.PI) / (2 * Math.PI)) % 1) + 1) % 1) * w;
    const y = canvas.height;
    // Marks are white on wider black ones.
    for (const [color, wider] of Object.entries({ "#000": 2, "#fff": 0 })) {
      context.fillStyle = context.strokeStyle = color;
      const size = 5 + wider;
      for (const at of [x - w, x, x + w]) {
        context.beginPath();
        context.moveTo(at - size, y);
        context.lineTo(at + size, y);
        context.lineTo(at, y - 1.6 * size);
        context.fill();
      }
      if (!keys) continue;
      context.lineWidth = 1 + wider;
      context.beginPath();
      context.arc(place.x * w, place.y * canvas.height, 6, 0, 7);
      context.stroke();
    }
  };
  // The direction, before the light is turned, of a place in the picture.
  const direction = (x, y) => {
    const lon = Math.PI * (1 - 2 * x) - state.turn;
    const lat = Math.PI * (0.5 - y);
    return [Math.cos(lat) * Math.sin(lon), Math.sin(lat), Math.cos(lat) * Math.cos(lon)];
  };
  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    return direction((event.clientX - box.left) / box.width, clamp((event.clientY - box.top) / box.height, 0, 1));
  };
  const lamp = (way, angle, strength) => ({
    direction: way,
    angle,
    radiance: unhex(tint.value).map((x) => toLinear(x) * strength),
  });
  let last = null;
  let painted = false;
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    last = at(event);
    painted = false;
  };
  canvas.onpointermove = (event) => {
    if (!last || dot(last, at(event)) > Math.cos(0.12) || state.lamps.length >= 200) return;
    const ways = painted ? [at(event)] : [last, at(event)];
    [last, painted] = [at(event), true];
    set({ lamps: [...state.lamps, ...ways.map((way) => lamp(way, 0.15, 2))] });
  };
  canvas.onpointerup = (event) => {
    if (last && !painted) set({ lamps: [...state.lamps, lamp(at(event), 0.05, 300)] });
    last = null;
  };
  canvas.onkeydown = (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (step) {
      place.x = (place.x + step[0] / 64 + 1) % 1;
      place.y = clamp(place.y + step[1] / 32, 0, 1);
    } else if (event.key === "Enter") set({ lamps: [...state.lamps, lamp(direction(place.x, place.y), 0.05, 300)] });
    else return;
    event.preventDefault();
    event.stopPropagation();
    draw();
  };
  canvas.onfocus = () => {
    keys = canvas.matches(":focus-visible");
    draw();
  };
  canvas.onblur = () => {
    keys = false;
    draw();
  };
  return {
    show: draw,
    paint(data, { width: w, height: h, scale }) {
      source = { data, scale };
      Object.assign(image, { width: w, height: h });
      if (canvas.width !== w || canvas.height !== h) Object.assign(canvas, { width: w, height: h });
      drawn = "";
      draw();
    },
    look(angle) {
      if (angle === azimuth) return;
      azimuth = angle;
      draw();
    },
  };
}

// The controls of one part: by their names in its model, and a plane where roughness and reflectance both act.
function materialOf(parent, part, state, opened, set) {
  const { free } = part;
  const value = (name) => state.materials[part.name]?.[name] ?? free[name];
  const node = section(parent, part.name, opened, "part");
  const change = (fields) =>
    set({ materials: { ...state.materials, [part.name]: { ...state.materials[part.name], ...fields } } });
  const blinn = free.exponent !== undefined;
  const metallic = free.metallic !== undefined;
  const shows = [];
  const reflects = () => !metallic || value("metallic") < 1; // of a metal the base color is the reflectance
  const color = (text, name, acts = () => true) => {
    if (!free[name]) return;
    const input = element("input", row(node, text), { type: "color" });
    input.oninput = () => change({ [name]: unhex(input.value).map(toLinear) });
    shows.push(() => {
      input.value = hex(value(name).map(toDisplay));
      input.disabled = !acts();
    });
  };
  const number = (text, name, options) => {
    if (free[name] === undefined) return;
    const control = slider(node, text, { digits: 3, ...options }, (x) => change({ [name]: x }));
    shows.push(() => control.show(value(name), options.acts?.() ?? true));
  };
  const [low, high] = free.exponent_range ?? free.roughness_range ?? [0, 1];
  const span = high / low;
  const power = { low, high, digits: 1, at: (x) => low * span ** x, of: (x) => Math.log(x / low) / Math.log(span) };
  color(metallic || !free.specular ? "base color" : "diffuse color", "diffuse");
  number("metallic", "metallic", { low: 0, high: 1 });
  if (free.roughness_range) number("roughness", "roughness", { low, high });
  if (blinn) number("exponent", "exponent", power);
  number(blinn ? "specular" : "specular F0", "f0", {
    title: "reflectance at normal incidence of what is not metal",
    acts: reflects,
    low: 0,
    high: 1,
    at: (x) => x * x,
    of: Math.sqrt,
  });
  color("specular tint", "specular", reflects);
  const across = blinn ? "exponent" : free.roughness_range ? "roughness" : null;
  // Of Blinn-Phong the exponent falls to the right, as roughness grows.
  if (across && free.f0 !== undefined)
    shows.push(planeOf(node, { across, low, high, value, change, hidden: () => !reflects() }));
  const reset = element("button", element("div", node, { className: "row" }), {
    type: "button",
    textContent: "as it was",
  });
  reset.onclick = () => {
    const { [part.name]: _, ...materials } = state.materials;
    set({ materials });
  };
  shows.push(() => {
    reset.disabled = !state.materials[part.name];
  });
  const show = () => {
    if (node.open) for (const each of shows) each();
  };
  node.ontoggle = show;
  return { box: node, show };
}

// The plane of roughness and reflectance at normal incidence, whose square root goes up. It is drawn in the theme's
// colors.
function planeOf(parent, { across, low, high, value, change, hidden }) {
  const edge = 264;
  const name = across === "exponent" ? "specular" : "F0";
  const blinn = across === "exponent";
  const margin = 12;
  const canvas = element("canvas", parent, {
    className: "plane",
    width: edge,
    height: edge,
    tabIndex: 0,
    title: `${across} across, ${name} up`,
    role: "application",
    ariaLabel: `${across} across and ${name} up; arrows move the point`,
  });
  const valueAt = (x) => (blinn ? low * (high / low) ** (1 - x) : low + x * (high - low));
  const placeOf = (v) => (blinn ? 1 - Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low));
  const put = (x, y) => change({ [across]: valueAt(clamp(x, 0, 1)), f0: clamp(y, 0, 1) ** 2 });
  const inside = (share) => (share * edge - margin) / (edge - 2 * margin);
  const drag = (event) => {
    const area = canvas.getBoundingClientRect();
    put(inside((event.clientX - area.left) / area.width), 1 - inside((event.clientY - area.top) / area.height));
  };
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    drag(event);
  };
  canvas.onpointermove = (event) => {
    if (canvas.hasPointerCapture(event.pointerId)) drag(event);
  };
  canvas.onkeydown = (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    put(placeOf(value(across)) + 0.05 * step[0], Math.sqrt(value("f0")) + 0.05 * step[1]);
  };
  return () => {
    canvas.hidden = hidden();
    const c = canvas.getContext("2d");
    const style = getComputedStyle(canvas);
    const color = (key) => style.getPropertyValue(key);
    const x = margin + (edge - 2 * margin) * clamp(placeOf(value(across)), 0, 1);
    const y = edge - margin - (edge - 2 * margin) * Math.sqrt(clamp(value("f0"), 0, 1));
    c.fillStyle = color("--field");
    c.fillRect(0, 0, edge, edge);
    c.strokeStyle = color("--edge");
    c.lineWidth = 2;
    for (let k = 0; k <= 4; k++) {
      const at = margin + ((edge - 2 * margin) * k) / 4;
      c.beginPath();
      c.moveTo(at, margin);
      c.lineTo(at, edge - margin);
      c.moveTo(margin, at);
      c.lineTo(edge - margin, at);
      c.stroke();
    }
    c.fillStyle = color("--dim");
    c.font = "20px system-ui, sans-serif";
    c.textAlign = "right";
    c.fillText(blinn ? "← exponent" : `${across} →`, edge - 18, edge - 20);
    c.textAlign = "left";
    c.fillText(`↑ ${name}`, 18, 34);
    c.fillStyle = color("--mark");
    c.strokeStyle = color("--card");
    c.lineWidth = 4;
    c.beginPath();
    c.arc(x, y, 11, 0, 7);
    c.stroke();
    c.fill();
  };
}
