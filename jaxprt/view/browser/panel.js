// The panel of controls.

import { clamp, dot, element, half, hex, toDisplay, unhex } from "./common.js";
import { TONES } from "./drawing.js";

export function panelOf(panel, scene, state, { set, expose, map, moved }) {
  panel.textContent = "";
  const row = (text) => { const made = element("label", panel); element("span", made, { textContent: text }); return made; };
  const choice = (text, names, pick) => {
    const made = element("select", row(text));
    made.fill = (every) => { made.textContent = ""; every.forEach((name, i) => element("option", made, { textContent: name, value: i })); };
    made.fill(names);
    made.onchange = () => pick(Number(made.value));
    return made;
  };
  const names = Object.keys(scene.systems);
  const system = names.length > 1 ? choice("system", names, (i) => set({ system: names[i], bounces: state.bounces && scene.systems[names[i]].bounces })) : null;
  const light = choice("light", scene.lights, (i) => set({ light: i }));
  const exposure = element("input", row("exposure"), { type: "range", min: -6, max: 6, step: 0.1 });
  exposure.oninput = () => expose(Number(exposure.value));
  const tone = choice("tone", TONES, (i) => map(TONES[i]));
  const box = (text, key, change) => {
    const made = element("input", row(text), { type: "checkbox" });
    made.onchange = () => change({ [key]: made.checked });
    return [key, made];
  };
  const boxes = [box("background", "background", set)];
  if (scene.rests.includes("still")) boxes.push(box("picture at rest", "still", set));
  if (scene.rests.includes("exact")) boxes.push(box("exact picture", "exact", set));
  if (Object.values(scene.systems).some((each) => each.bounces)) boxes.push(box("bounces", "bounces", set));
  element("div", panel, { className: "title", textContent: "put a sun by a click, paint light by a drag" });
  const sky = element("canvas", panel, { className: "sky", width: 256, height: 128 });
  const tint = element("input", row("its color"), { type: "color", value: "#fff0d8" });
  const clear = element("button", panel, { textContent: "clear the lamps", type: "button" });
  clear.onclick = () => set({ lamps: [] });
  lamps(sky, tint, state, set);
  const parts = scene.parts.filter((part) => part.free).map((part) => materialOf(panel, part, state, moved));
  return {
    show() {
      if (light.length !== scene.lights.length) light.fill(scene.lights);
      light.value = state.light;
      if (system) system.value = names.indexOf(state.system);
      exposure.value = state.stops;
      tone.value = TONES.indexOf(state.tone);
      for (const [key, each] of boxes) each.checked = state[key];
      for (const part of parts) part();
    },
    paint(data, { width, height, scale }) { paintSky(sky, data, width, height, scale, state.stops); },
  };
}

function paintSky(canvas, data, width, height, scale, stops) {
  const context = canvas.getContext("2d"), image = context.createImageData(width, height), gain = scale * 2 ** stops;
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < 3; c++) image.data[4 * i + c] = 255 * toDisplay(clamp(half(data[3 * i + c]) * gain, 0, 1));
    image.data[4 * i + 3] = 255;
  }
  Object.assign(canvas, { width, height });
  context.putImageData(image, 0, 0);
}

// Lamps put on the picture of the environment: a click a small bright one, a drag a wide faint one along the way.
function lamps(canvas, tint, state, set) {
  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    const lon = Math.PI * (1 - (2 * (event.clientX - box.left)) / box.width), lat = Math.PI * (0.5 - (event.clientY - box.top) / box.height);
    return [Math.cos(lat) * Math.sin(lon), Math.sin(lat), Math.cos(lat) * Math.cos(lon)];
  };
  const lamp = (direction, angle, strength) => ({ direction, angle, radiance: unhex(tint.value).map((x) => x * strength) });
  let last = null, painted = false;
  canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); last = at(event); painted = false; };
  canvas.onpointermove = (event) => {
    if (!last || dot(last, at(event)) > Math.cos(0.12) || state.lamps.length >= 200) return;
    if (!painted) state.lamps = [...state.lamps, lamp(last, 0.15, 2)];
    [last, painted] = [at(event), true];
    set({ lamps: [...state.lamps, lamp(last, 0.15, 2)] });
  };
  canvas.onpointerup = (event) => {
    if (last && !painted) set({ lamps: [...state.lamps, lamp(at(event), 0.05, 300)] });
    last = null;
  };
}

// The plane of roughness and reflectance at normal incidence, and the colors, of one part.
function materialOf(panel, part, state, moved) {
  const free = part.free, value = (name) => state.materials[part.name]?.[name] ?? free[name];
  const change = (fields) => { state.materials = { ...state.materials, [part.name]: { ...state.materials[part.name], ...fields } }; show(); moved(); };
  element("div", panel, { className: "title", textContent: part.name });
  // Of Blinn-Phong the exponent falls to the right, as roughness grows.
  const across = free.exponent_range ? "exponent" : "roughness", range = free[`${across}_range`], hasPlane = range || free.f0 !== undefined;
  const low = range?.[0], span = range && range[1] / low;
  const valueAt = (x) => (across === "exponent" ? low * span ** (1 - x) : low + x * (range[1] - low));
  const placeOf = (value) => (across === "exponent" ? 1 - Math.log(value / low) / Math.log(span) : (value - low) / (range[1] - low));
  const plane = hasPlane ? element("canvas", panel, { className: "plane", width: 128, height: 128, title: "roughness to the right (Blinn-Phong: a smaller exponent), reflectance at normal incidence up" }) : null;
  if (plane) {
    const drag = (event) => {
      const area = plane.getBoundingClientRect(), x = clamp((event.clientX - area.left) / area.width, 0, 1), y = clamp(1 - (event.clientY - area.top) / area.height, 0, 1);
      change({ ...(range && { [across]: valueAt(x) }), ...(free.f0 !== undefined && { f0: y * y }) });
    };
    plane.onpointerdown = (event) => { plane.setPointerCapture(event.pointerId); drag(event); };
    plane.onpointermove = (event) => { if (plane.hasPointerCapture(event.pointerId)) drag(event); };
  }
  const pickers = ["diffuse", "specular"].filter((name) => free[name]).map((name) => {
    const made = element("label", panel);
    element("span", made, { textContent: name });
    const input = element("input", made, { type: "color" });
    input.oninput = () => change({ [name]: unhex(input.value) });
    return [name, input];
  });
  const show = () => {
    for (const [name, input] of pickers) input.value = hex(value(name));
    if (!plane) return;
    const c = plane.getContext("2d"), x = range ? placeOf(value(across)) : 0.5, y = free.f0 !== undefined ? Math.sqrt(value("f0")) : 0.5;
    c.fillStyle = "#444";
    c.fillRect(0, 0, 128, 128);
    c.fillStyle = "#aaa";
    c.font = "10px sans-serif";
    c.fillText(across === "exponent" ? "← exponent" : "roughness →", 66, 122);
    c.fillText("↑ F0", 4, 12);
    c.fillStyle = "#fd5";
    c.beginPath();
    c.arc(6 + 116 * x, 122 - 116 * y, 5, 0, 7);
    c.fill();
  };
  return show;
}
