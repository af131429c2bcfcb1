// The state of a viewer: what the user has chosen, what undo takes back, and what addresses and files hold.

const KEPT = 200; // states that can be taken back
const SETTLED = 300; // milliseconds without a change after which a state is one of them
const DIGITS = 10;

/** @typedef {{ direction: number[], angle: number, radiance: number[] }} Lamp */
/** @typedef {ReturnType<typeof initial>} State */

// What is chosen at the start.
export const initial = () => ({
  system: "",
  light: 0,
  turn: 0,
  lamps: /** @type {Lamp[]} */ ([]),
  stops: 0,
  auto: true,
  tone: "srgb",
  background: "light",
  ground: [0.8, 0.8, 0.8],
  bounces: false,
  still: true,
  exact: false,
  materials: /** @type {Record<string, Record<string, number | number[]>>} */ ({}),
});
// Lights have names in texts, and stops are found where they are automatic.
const FIELDS = Object.keys(initial()).filter((name) => name !== "light" && name !== "stops");

// A state as text: JSON. Places are those of the file, whose origin the scene has, and the light has its name.
export function written(state, camera, scene, aspect) {
  const { origin } = scene;
  const world = (place) => place.map((x, i) => x + origin[i]);
  const result = {
    jaxprt: "state",
    light: scene.lights[state.light],
    eye: world(camera.eye),
    target: world(camera.target),
    field_of_view: camera.angle,
    aspect,
  };
  for (const name of FIELDS) result[name] = state[name];
  if (!state.auto) result.stops = state.stops;
  return JSON.stringify(result, (_, value) => (typeof value === "number" ? Number(value.toPrecision(DIGITS)) : value));
}

// Has a viewer show a state that was written. What the scene does not have is returned in words.
export function restored(text, state, camera, scene) {
  const { jaxprt, light, eye, target, field_of_view, ...fields } = JSON.parse(text);
  const lacking = [];
  if (jaxprt !== "state") throw new Error('a state must be JSON with "jaxprt": "state", as the viewer saves it');
  const local = (place, name) => {
    if (!Array.isArray(place) || place.length !== 3 || !place.every(Number.isFinite))
      throw new Error(`${name} of a state must be three numbers`);
    return place.map((x, i) => x - scene.origin[i]);
  };
  const places = [local(eye, "eye"), local(target, "target")];
  if (!(field_of_view > 1e-3 && field_of_view < 3.14))
    throw new Error("field_of_view of a state must be an angle in radians");
  const kind = (value) => (Array.isArray(value) ? "list" : typeof value);
  for (const name of FIELDS)
    if (name in fields && (fields[name] === null || kind(fields[name]) !== kind(state[name])))
      throw new Error(`${name} of a state must be a ${kind(state[name])}`);
  if (!Number.isFinite(fields.stops ?? 0) || !Number.isFinite(fields.turn ?? 0))
    throw new Error("turn and stops of a state must be numbers");
  for (const lamp of fields.lamps ?? [])
    if (
      ![lamp.direction, lamp.radiance].every((three) => three?.length === 3 && three.every(Number.isFinite)) ||
      !(lamp.angle > 0)
    )
      throw new Error("lamps of a state must have a direction, an angle and a radiance");
  camera.restore(...places, field_of_view);
  const number = scene.lights.indexOf(light);
  if (number < 0) lacking.push(`the light ${light}`);
  else state.light = number;
  for (const name of [...FIELDS, "stops"]) if (name in fields) state[name] = fields[name];
  if (!scene.systems[state.system]) {
    lacking.push(`the system ${state.system}`);
    state.system = Object.keys(scene.systems)[0];
  }
  if (!scene.systems[state.system].bounces) state.bounces = false;
  const free = new Set(scene.parts.filter((part) => part.free).map((part) => part.name));
  for (const name of Object.keys(state.materials))
    if (!free.has(name)) {
      lacking.push(`the part ${name}`);
      delete state.materials[name];
    }
  return lacking.length ? `the scene lacks ${lacking.join(", ")} of the state` : "";
}

// States that can be taken back and done again. `take` writes the present one, or nothing while a hand is at it, `give`
// shows one, and `told` hears of each that is kept.
export class History {
  constructor(take, give, told) {
    this.take = take;
    this.give = give;
    this.told = told;
    this.timer = 0;
    this.forget();
  }
  changed() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.record(), SETTLED);
  }
  record() {
    clearTimeout(this.timer);
    const now = this.take();
    if (!now) return this.changed();
    if (now === this.states[this.at]) return;
    this.states = [...this.states.slice(Math.max(0, this.at + 2 - KEPT), this.at + 1), now];
    this.at = this.states.length - 1;
    this.told(now);
  }
  step(by) {
    this.record();
    const to = this.at + by;
    if (!(to in this.states)) return;
    this.give(this.states[to]);
    clearTimeout(this.timer);
    this.at = to;
    this.told((this.states[to] = this.take()));
  }
  // The present state is not another one, though it may have changed: a better scene has come.
  amend() {
    if (this.at >= 0) this.states[this.at] = this.take() || this.states[this.at];
  }
  forget() {
    this.states = [];
    this.at = -1;
  }
  close() {
    clearTimeout(this.timer);
  }
}
