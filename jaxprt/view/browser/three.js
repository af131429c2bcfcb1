// Relights files of `jaxprt export --format gltf` in three.js. Diffuse light comes from the transfer of the vertices
// alone; highlights are those of `scene.environment`, as far as the vertices see its light.

import {
  DataTexture,
  DataUtils,
  EquirectangularReflectionMapping,
  FloatType,
  HalfFloatType,
  LinearFilter,
} from "three";
import { gauss, harmonics } from "./harmonics.js";

const SLOTS = 16; // attributes of a vertex that every implementation of WebGL 2 has
const HEIGHT = 128; // rows of the environment of a light that is given by coefficients
const MOST = 65504; // of half floats
const SEEN = 16; // harmonics of transfer that highlights read
const [BLUR, MIDDLE] = [0.35, 0.4]; // of the visibility that they give: width in radians, and value at an edge
// three.js has +x in the middle of a latitude-longitude picture, jaxprt +z.
const QUARTER = -Math.PI / 2;

// Calls `see` with the index of each texel of a latitude-longitude picture, from the top left, its solid angle and its
// harmonics. The center column is +z, and +x is a quarter of the width from the left.
function visit(width, height, degree, see) {
  const value = new Float64Array((degree + 1) ** 2);
  for (let row = 0; row < height; row++) {
    const [top, y, bottom] = [0, 0.5, 1].map((part) => Math.cos((Math.PI * (row + part)) / height));
    const ring = Math.sqrt(1 - y * y);
    const weight = ((top - bottom) * 2 * Math.PI) / width;
    for (let column = 0; column < width; column++) {
      const angle = Math.PI * (1 - (2 * (column + 0.5)) / width);
      harmonics(ring * Math.sin(angle), y, ring * Math.cos(angle), degree, value);
      see(row * width + column, weight, value);
    }
  }
}

// Coefficients of a latitude-longitude texture, three colors each.
function projected(texture, degree) {
  const { data, width, height } = texture.image ?? {};
  if (!data || ![FloatType, HalfFloatType].includes(texture.type))
    throw new Error("the texture must have floats or half floats, from HDRLoader or EXRLoader");
  const channels = data.length / (width * height);
  const result = new Float64Array(3 * (degree + 1) ** 2);
  visit(width, height, degree, (index, weight, value) => {
    const row = Math.floor(index / width);
    const texel = texture.flipY ? index : index + (height - 1 - 2 * row) * width;
    for (let c = 0; c < 3; c++) {
      const number = data[texel * channels + (channels > 2 ? c : 0)];
      const flux = weight * Math.max(texture.type === FloatType ? number : DataUtils.fromHalfFloat(number), 0);
      for (let k = 0; k < value.length; k++) result[3 * k + c] += flux * value[k];
    }
  });
  return result;
}

// A latitude-longitude texture of the light of coefficients.
function pictured(coefficients, degree) {
  const data = new Uint16Array(8 * HEIGHT ** 2).fill(DataUtils.toHalfFloat(1));
  visit(2 * HEIGHT, HEIGHT, degree, (index, _, value) => {
    for (let c = 0; c < 3; c++) {
      const radiance = value.reduce((sum, basis, k) => sum + basis * coefficients[3 * k + c], 0);
      data[4 * index + c] = DataUtils.toHalfFloat(Math.min(Math.max(radiance, 0), MOST));
    }
  });
  const texture = new DataTexture(data, 2 * HEIGHT, HEIGHT, undefined, HalfFloatType);
  texture.minFilter = texture.magFilter = LinearFilter;
  texture.flipY = texture.needsUpdate = true;
  return texture;
}

// Coefficients of a light that is turned about y, from +z towards +x: its series, read in directions that are turned
// back, is projected again. Heights of Gauss and angles integrate products of its harmonics exactly.
function turned(coefficients, degree, angle) {
  const [c, s, around] = [Math.cos(angle), Math.sin(angle), 2 * degree + 1];
  const [from, to] = [0, 1].map(() => new Float64Array((degree + 1) ** 2));
  const result = new Float32Array(coefficients.length);
  for (const { height, weight } of gauss(degree + 1))
    for (let i = 0; i < around; i++) {
      const [ring, turn] = [Math.sqrt(1 - height * height), (2 * Math.PI * i) / around];
      const [x, y] = [ring * Math.cos(turn), ring * Math.sin(turn)];
      harmonics(c * x - s * height, y, s * x + c * height, degree, from);
      harmonics(x, y, height, degree, to);
      for (let channel = 0; channel < 3; channel++) {
        const radiance = from.reduce((sum, basis, k) => sum + basis * coefficients[3 * k + channel], 0);
        const flux = (radiance * weight * 2 * Math.PI) / around;
        for (let k = 0; k < to.length; k++) result[3 * k + channel] += flux * to[k];
      }
    }
  return result;
}

// The first harmonics of a direction d.
const BASIS = [
  "0.28209479",
  "0.48860251 * d.y",
  "0.48860251 * d.z",
  "0.48860251 * d.x",
  "1.09254843 * d.x * d.y",
  "1.09254843 * d.y * d.z",
  "0.31539157 * (3. * d.z * d.z - 1.)",
  "1.09254843 * d.x * d.z",
  "0.54627422 * (d.x * d.x - d.y * d.y)",
  "0.59004359 * d.y * (3. * d.x * d.x - d.y * d.y)",
  "2.89061144 * d.x * d.y * d.z",
  "0.45704580 * d.y * (5. * d.z * d.z - 1.)",
  "0.37317633 * d.z * (5. * d.z * d.z - 3.)",
  "0.45704580 * d.x * (5. * d.z * d.z - 1.)",
  "1.44530572 * d.z * (d.x * d.x - d.y * d.y)",
  "0.59004359 * d.x * (d.x * d.x - 3. * d.y * d.y)",
];
const COSINE = ["0.25", "0.5 * c", "0.15625 * (3. * c * c - 1.)"]; // series of max(c, 0)

// The light that arrives at a pixel. The visible share of the highlight's lobe is that of the transfer in its direction
// to the transfer without shadows. Their harmonics are blurred, as by a lobe of the width BLUR: across the edge of an
// occluder, a narrower lobe has the same middle and a steeper slope.
const arriving = (terms) => {
  const seen = BASIS.slice(0, terms).map((basis, k) => `prtTransfer${k >> 2}.${"xyzw"[k & 3]} * ${basis}`);
  return `vec3 prtIrradiance = PI * prtRadiance;
#ifdef USE_ENVMAP
  prtIrradiance *= envMapIntensity;
  #ifdef USE_NORMALMAP_TANGENTSPACE
    prtIrradiance *= min(iblIrradiance / max(getIBLIrradiance(nonPerturbedNormal), EPSILON), 4.);
  #endif
#endif
iblIrradiance = prtIrradiance;
{
  vec3 d = normalize(mix(reflect(-geometryViewDir, geometryNormal), geometryNormal, pow4(material.roughness)));
  float c = dot(nonPerturbedNormal, d);
  d = (vec4(d, 0.) * viewMatrix).xyz;
  float share = PI * (${seen.join(" + ")}) / max(${COSINE.slice(0, Math.sqrt(terms)).join(" + ")}, 0.06);
  float width = max(2. * pow4(material.roughness), EPSILON); // variance of the lobe along an axis
  radiance *= clamp((share - ${MIDDLE}) * sqrt(1. + ${(BLUR ** 2).toFixed(4)} / width) + ${MIDDLE}, 0., 1.);
}`;
};

// Shader code that lights a material by the transfer of its vertices. What three.js takes for the irradiance of the
// environment is replaced, so that its own formulas share light between the diffuse part and the highlights. Normal maps
// change irradiance as they would without shadows.
function patch(material, attributes, terms, uniforms) {
  const sum = Array.from({ length: terms }, (_, k) => `${attributes[k >> 2]}.${"xyzw"[k & 3]} * prtLight[${k}]`);
  const passed = attributes.slice(0, Math.ceil(Math.min(terms, SEEN) / 4));
  const varying = `varying vec3 prtRadiance;\nvarying vec4 ${passed.map((_, i) => `prtTransfer${i}`).join(", ")};`;
  material.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, uniforms);
    shader.vertexShader = shader.vertexShader
      .replace(
        "#include <common>",
        `#include <common>
attribute vec4 ${attributes.join(", ")};
uniform vec3 prtLight[${terms}];
${varying}`,
      )
      .replace(
        "#include <begin_vertex>",
        `#include <begin_vertex>
prtRadiance = ${sum.join(" + ")};
${passed.map((name, i) => `prtTransfer${i} = ${name};`).join("\n")}`,
      );
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", `#include <common>\n${varying}`)
      .replace("#include <lights_fragment_maps>", `#include <lights_fragment_maps>\n${arriving(terms)}`);
  };
  material.customProgramCacheKey = () => `jaxprt ${terms}`;
  material.needsUpdate = true;
}
// The light of a file's scene in three.js, which drives the environment of `scene` too.
class Light {
  #about;
  #scene;
  #coefficients;
  #value;
  #turn = 0;
  #pictured = null;

  constructor(about, scene, value) {
    [this.#about, this.#scene, this.#value] = [about, scene, value];
  }

  // Names of the lights of the file.
  get names() {
    return Object.keys(this.#about.lights);
  }

  // Takes a light of the file by its name, a latitude-longitude texture, or coefficients as rows of three colors.
  set(light) {
    const { degree, lights } = this.#about;
    if (typeof light === "string" && !lights[light])
      throw new Error(`the light must be one of ${this.names.join(", ")}, got ${light}`);
    const rows = typeof light === "string" ? lights[light] : light;
    if (!rows.isTexture && rows.length !== (degree + 1) ** 2)
      throw new Error(`the light must have ${(degree + 1) ** 2} coefficients, got ${rows.length}`);
    this.#coefficients = rows.isTexture ? projected(rows, degree) : rows.flat();
    this.#pictured?.dispose();
    this.#pictured = rows.isTexture ? null : pictured(this.#coefficients, degree);
    this.#scene.environment = this.#pictured ?? rows;
    this.#scene.environment.mapping = EquirectangularReflectionMapping;
    this.turn = this.#turn;
  }

  // Radians about y, from +z towards +x.
  get turn() {
    return this.#turn;
  }
  set turn(angle) {
    this.#turn = angle;
    if (this.#coefficients) this.#value.set(turned(this.#coefficients, this.#about.degree, angle));
    this.#scene.environmentRotation.set(0, angle + QUARTER, 0);
    this.#scene.backgroundRotation.set(0, angle + QUARTER, 0);
  }
}

// Patches the materials of a file that GLTFLoader has read, and returns its light. Until a light is set it is dark.
export function relight(gltf, scene) {
  const about = gltf.asset.extras?.prt;
  if (!about) throw new Error("the file must have transfer in vertex attributes, from jaxprt export --format gltf");
  const attributes = about.attributes.map((name) => name.toLowerCase());
  const terms = (about.degree + 1) ** 2;
  const value = new Float32Array(3 * terms);
  const patched = new Set();
  gltf.scene.traverse(({ name, isMesh, geometry, material }) => {
    const count = isMesh ? Object.keys(geometry.attributes).length : 0;
    if (count > SLOTS)
      throw new Error(
        `${name || "a mesh"} must have at most ${SLOTS} attributes of vertices, got ${count}: export with a smaller --degree`,
      );
    if (isMesh && !patched.has(material)) patch(material, attributes, terms, { prtLight: { value } });
    patched.add(material);
  });
  return new Light(about, scene, value);
}
