// A relit scene without Python: answers the questions of `viewer.js` from what `export` has written, on the GPU.
// Diffuse light by transfer vectors; glossy light by lobes and means of visibility, as the lobe system does, or by transfer
// matrices, as the harmonic system does: harmonics of the visibility are kept, and a light is taken through them once.

const WIDTH = 4096; // columns of all textures
const FINE = 4; // parts along the edge of a texel by which the rim of a lamp is found

const SHADE = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp isampler2D; precision highp usampler2D;
uniform sampler2D place, weights, table, light, bright; uniform isampler2D vectors; uniform usampler2D pyramid, bits, arrived;
uniform vec3 irradiance[TERMS], eye; uniform vec2 turn; // cosine and sine
uniform int first, count, lobes, channels, nodes, knots, tableStart, weightStart, weightStep, pyramidStart, terms, term[4], families, texels, bands, entries, arrivedStart, bitStart;
uniform float knot[KNOTS], scale[4], logRoughness, steps;
uniform int edges[LEVELS], starts[LEVELS], lightEdges[WIDTHS], lightStarts[WIDTHS];
uniform float spreads[LEVELS], lightSpreads[WIDTHS];
out uvec4 o;

ivec2 at(int i) { return ivec2(i & ${WIDTH - 1}, i >> 12); }

void project(vec3 d, out int face, out float s, out float t) {
  vec3 a = abs(d);
  bool x = a.x >= a.y && a.x >= a.z, y = !x && a.y >= a.z;
  float forward = x ? d.x : y ? d.y : d.z;
  bool back = forward < 0.;
  face = (x ? 0 : y ? 2 : 4) + int(back);
  s = (x ? (back ? d.z : -d.z) : y || !back ? d.x : -d.x) / abs(forward);
  t = (y ? (back ? -d.z : d.z) : -d.y) / abs(forward);
}
vec3 unproject(int face, float s, float t) {
  float side = (face & 1) == 1 ? -1. : 1.;
  return face < 2 ? vec3(side, -t, -side * s) : face < 4 ? vec3(s, side, side * t) : vec3(side * s, -t, side);
}
float drop(float k) { return k < 1e-2 ? 1. - k / 3. : 1. / k - 2. / (exp(min(2. * k, 80.)) - 1.); }

// Row and column of the first of four texels about a place, the rim counted, and how far the place is beyond.
ivec2 corner(int edge, float s, float t, out vec2 part) {
  vec2 place = (vec2(s, t) + 1.) * (float(edge) / 2.) + .5, low = clamp(floor(place), 0., float(edge));
  part = place - low;
  return ivec2(low);
}
float mean(int address) {
  uint word = texelFetch(pyramid, at(address >> 2), 0).r;
  return float((word >> uint(8 * (address & 3))) & 255u) / 255.;
}
vec3 spline(float off) { return vec3((.5 - off) * (.5 - off) / 2., .75 - off * off, (.5 + off) * (.5 + off) / 2.); }
// What a vertex sees of a lobe, and the slopes of that by s and t: see jaxprt/systems/lobe/pyramid.py.
vec3 visibility(int row, int face, float s, float t, float spread) {
  int number = 0;
  for (int i = 1; i < LEVELS - 1; i++) if (spread >= spreads[i]) number = i;
  float upper = LEVELS == 1 ? 0. : clamp((spread - spreads[number]) / (spreads[number + 1] - spreads[number]), 0., 1.);
  vec3 result = vec3(0);
  for (int step = 0; step < min(2, LEVELS); step++) {
    int edge = edges[number + step];
    float middle = float(edge) / 2., share = step == 0 ? 1. - upper : upper;
    vec2 place = (vec2(s, t) + 1.) * middle;
    ivec2 center = clamp(ivec2(place), 0, edge - 1) + 1;
    vec2 off = place + .5 - vec2(center);
    int base = row + starts[number + step] + (face * (edge + 2) + center.y - 1) * (edge + 2) + center.x - 1;
    vec3 down = spline(off.y), byDown = vec3(off.y - .5, -2. * off.y, off.y + .5);
    vec3 right = spline(off.x), byRight = vec3(off.x - .5, -2. * off.x, off.x + .5);
    for (int j = 0; j < 3; j++) {
      vec3 column = vec3(mean(base + j), mean(base + edge + 2 + j), mean(base + 2 * edge + 4 + j)), parts = column * byDown;
      float total = dot(column, down), slope = parts.x + parts.y + parts.z;
      float outside = (center.y == 1 ? parts.x : 0.) + (center.y == edge ? parts.z : 0.);
      float across = total - ((j == 0 && center.x == 1) || (j == 2 && center.x == edge) ? slope * t / 2. : 0.);
      result += share * vec3(total * right[j], middle * across * byRight[j], middle * (slope * right[j] - outside * byRight[j] * s / 2.));
    }
  }
  return result;
}
vec3 radiance(vec3 d, float spread) {
  d = vec3(turn.x * d.x - turn.y * d.z, d.y, turn.y * d.x + turn.x * d.z);
  int face, number = 0;
  float s, t;
  project(d, face, s, t);
  for (int i = 1; i < WIDTHS - 1; i++) if (spread >= lightSpreads[i]) number = i;
  float upper = clamp((spread - lightSpreads[number]) / (lightSpreads[number + 1] - lightSpreads[number]), 0., 1.);
  vec3 result = vec3(0);
  for (int step = 0; step < 2; step++) {
    int edge = lightEdges[number + step];
    vec2 part;
    ivec2 low = corner(edge, s, t, part);
    int base = lightStarts[number + step] + (face * (edge + 2) + low.y) * (edge + 2) + low.x;
    vec3 a = texelFetch(light, at(base), 0).rgb, b = texelFetch(light, at(base + 1), 0).rgb;
    vec3 c = texelFetch(light, at(base + edge + 2), 0).rgb, d4 = texelFetch(light, at(base + edge + 3), 0).rgb;
    result += (step == 0 ? 1. - upper : upper) * mix(mix(a, b, part.x), mix(c, d4, part.x), part.y);
  }
  return result;
}
// The light of a lobe, about the mean of what is seen of it: see jaxprt/systems/lobe/relight.py.
vec3 seen(int row, vec3 d, float concentration) {
  int face;
  float s, t, spread = drop(concentration);
  project(d, face, s, t);
  vec3 v = visibility(row, face, s, t, max(spread, spreads[0]));
  float variance = (1. + s * s + t * t) / (concentration * (1. - spread));
  float alongS = variance * (v.y * (1. + s * s) + v.z * s * t), alongT = variance * (v.z * (1. + t * t) + v.y * s * t);
  float part = max(v.x, 1e-3), off = sqrt((alongS * v.y + alongT * v.z) / (part * part) + 1e-12);
  float reach = 1. / (part * max(off / 2.5, 1.));
  off = min(off, 2.5);
  float across = 1. / (1. + off * (2. + .42 * off));
  return v.x * radiance(unproject(face, s + alongS * reach, t + alongT * reach), spread * (1. + across) / 2.);
}
// Whether a vertex sees a direction: bits of texels, bilinear between their middles.
float bit(int vertex, int face, int row, int column) {
  row = clamp(row, 0, TEXELS - 1);
  column = clamp(column, 0, TEXELS - 1);
  int address = bitStart + vertex * (6 * TEXELS * TEXELS / 8) + (face * (TEXELS / 2) + row / 2) * (TEXELS / 4) + column / 4;
  uint word = texelFetch(bits, at(address >> 2), 0).r;
  return float((word >> uint(8 * (address & 3) + (column / 2 & 1) * 4 + (row & 1) * 2 + (column & 1))) & 1u);
}
float clear(int vertex, vec3 d) {
  int face;
  float s, t;
  project(d, face, s, t);
  vec2 place = (vec2(s, t) + 1.) * (float(TEXELS) / 2.) - .5, low = floor(place + 1e-3), part = max(place - low, 0.);
  ivec2 near = ivec2(low);
  float a = bit(vertex, face, near.y, near.x), b = bit(vertex, face, near.y, near.x + 1);
  float c = bit(vertex, face, near.y + 1, near.x), d4 = bit(vertex, face, near.y + 1, near.x + 1);
  return mix(mix(a, b, part.x), mix(c, d4, part.x), part.y);
}
// Terms of MetallicRoughness, the lobe of BlinnPhong as the fifth, and those of CookTorrance with an F0 of 1 and of 0, in 1/sr: see jaxprt/brdf/microfacet.py and models.py.
vec4 family(vec3 wi, vec3 wo, vec3 normal, float rough) {
  vec3 h = normalize(wi + wo);
  float ci = dot(wi, normal), co = dot(wo, normal), z = dot(h, normal), schlick = pow(1. - min(dot(wo, h), 1.), 5.), alpha = max(exp(2. * rough), 1e-3), a = alpha * alpha;
  vec3 flat_ = h - normal * z;
  float tilt = dot(flat_, flat_) / a + z * z, mask = .5 / (co * sqrt(a * (1. - ci * ci) + ci * ci) + ci * sqrt(a * (1. - co * co) + co * co));
  float lobe = mask / (3.14159265 * a * tilt * tilt), n = 2. * exp(-2. * rough) - 2.;
  float shiny = (n + 2.) * (n + 4.) / (25.1327412 * (exp2(-n / 2.) + n)) * exp(n / 2. * log(max(1. - dot(flat_, flat_), 1e-30)));
  float m = max(exp(rough), 1e-3), cd = max(dot(wo, h), 1e-6), groove = min(1. / (ci * co), 2. * z / (cd * max(ci, co)));
  float grooves = exp(-dot(flat_, flat_) / (z * z * m * m)) / (9.8696044 * m * m * z * z * z * z) * groove;
  vec4 result = vec4(0);
  for (int k = 0; k < 4; k++) if (k < families) result[k] = scale[k] * (term[k] == 0 ? (1. - schlick) / 3.14159265 : term[k] == 1 ? lobe : term[k] == 2 ? lobe * schlick : term[k] == 4 ? shiny : term[k] == 5 ? grooves : term[k] == 6 ? grooves * schlick : 1. / 3.14159265);
  return result;
}
vec3 texelWay(int i) {
  vec3 d = texelFetch(bright, at(2 * i), 0).xyz;
  return vec3(turn.x * d.x + turn.y * d.z, d.y, turn.x * d.z - turn.y * d.x);
}
vec4 entry(int number, int node, int which) { // a table's entries: for each lobe its mean and log concentration, and its weights
  return texelFetch(table, at(tableStart + (number * nodes + node) * entries + which), 0);
}
float factor(int l, int m) { return sqrt(float(4 * l * l - 1) / float(l * l - m * m)); }
// The light that has come through a transfer matrix times the BRDF: see plane_table in jaxprt/view/reduced.py.
vec3 transferred(int vertex, vec3 ahead, vec3 normal, ivec2 number, float between, int node, float upper, vec3 w[4]) {
  vec3 lit[HARMONICS], tint[BANDS], result = vec3(0);
  int pairs = (bands * bands + 1) / 2;
  for (int i = 0; i < pairs; i++) {
    uvec4 each = texelFetch(arrived, at(arrivedStart + vertex * pairs + i), 0);
    vec2 middle = unpackHalf2x16(each.y);
    lit[2 * i] = vec3(unpackHalf2x16(each.x), middle.x);
    lit[2 * i + 1] = vec3(middle.y, unpackHalf2x16(each.z));
  }
  for (int j = 0; j < bands; j++) {
    float angle = 3.14159265 * (float(j) + .5) / float(bands);
    vec3 d = ahead * sin(angle) + normal * cos(angle);
    for (int l = 0; l < bands; l++) {
      int i = l * bands + j;
      vec4 a = mix(entry(number.x, node, i), entry(number.x, node + 1, i), upper);
      vec4 s = between > 0. ? mix(a, mix(entry(number.y, node, i), entry(number.y, node + 1, i), upper), between) : a;
      tint[l] = s.x * w[0] + s.y * w[1] + s.z * w[2] + s.w * w[3];
    }
    float real = 1., imaginary = 0., diagonal = .28209479;
    for (int m = 0; m < bands; m++) {
      if (m > 0) {
        float old = real;
        real = real * d.x - imaginary * d.y;
        imaginary = old * d.y + imaginary * d.x;
        diagonal *= sqrt((m == 1 ? 2. : 1.) * float(2 * m + 1) / float(2 * m));
      }
      float before = 0., value = diagonal;
      for (int l = m; l < bands; l++) {
        int i = l * (l + 1);
        result += tint[l] * value * (real * lit[i + m] + imaginary * lit[i - m]);
        float next = factor(l + 1, m) * (d.z * value - (l > m ? before / factor(l, m) : 0.));
        before = value;
        value = next;
      }
    }
  }
  return result;
}
void main() {
  int id = int(gl_FragCoord.x) + ${WIDTH} * int(gl_FragCoord.y), row = id - first;
  if (row < 0 || row >= count) discard;
  vec3 position = texelFetch(place, at(2 * id), 0).xyz, normal = texelFetch(place, at(2 * id + 1), 0).xyz;
  vec3 arriving = vec3(0);
  for (int i = 0; i < TERMS; i += 4) {
    if (i >= terms) break;
    vec4 each = vec4(texelFetch(vectors, at(id * (TERMS / 4) + i / 4), 0));
    arriving += irradiance[i] * each.x + irradiance[i + 1] * each.y + irradiance[i + 2] * each.z + irradiance[i + 3] * each.w;
  }
  int weight = weightStart + row * weightStep;
  vec3 w[4], color = texelFetch(weights, at(weight + channels), 0).rgb;
  for (int k = 0; k < 4; k++) w[k] = k < channels ? texelFetch(weights, at(weight + k), 0).rgb : vec3(0);
  vec4 diffuse = vec4(1);
  vec3 wo = normal;
  float rough = weightStep > 0 ? texelFetch(weights, at(weight), 0).a : logRoughness;
  if (lobes > 0 || bands > 0) {
    wo = normalize(eye - position);
    vec3 flat_ = wo - normal * dot(wo, normal);
    float up = dot(wo, normal);
    vec3 ahead = dot(flat_, flat_) > 1e-12 ? normalize(flat_) : normalize(cross(normal, abs(normal.x) < .6 ? vec3(1, 0, 0) : vec3(0, 1, 0)));
    up = max(up, .01); // as views are raised above the horizon
    wo = ahead * sqrt(1. - up * up) + normal * up;
    vec3 aside = cross(normal, ahead);
    float node = clamp(sqrt(max(1. - up * up, 0.)) / (1. + up) * steps, 0., float(nodes - 1));
    int low = min(int(node), nodes - 2), knotLow = 0;
    float upper = node - float(low), between = 0.;
    if (knots > 1) {
      for (int i = 1; i < KNOTS; i++) if (i < knots - 1 && rough >= knot[i]) knotLow = i;
      between = clamp((rough - knot[knotLow]) / (knot[knotLow + 1] - knot[knotLow]), 0., 1.);
    }
    int knotHigh = knots > 1 ? knotLow + 1 : knotLow;
    if (bands > 0) color += transferred(row, ahead, normal, ivec2(knotLow, knotHigh), between, low, upper, w);
    for (int l = 0; lobes > 0 && l <= lobes; l++) {
      vec4 lobe = vec4(0), strength = vec4(0);
      for (int n = 0; n < 2; n++) {
        float share = n == 0 ? 1. - upper : upper;
        if (l == lobes) {
          strength += share * mix(entry(knotLow, low + n, 2 * lobes), entry(knotHigh, low + n, 2 * lobes), between);
          continue;
        }
        vec4 a = entry(knotLow, low + n, 2 * l), b = entry(knotHigh, low + n, 2 * l);
        vec4 p = entry(knotLow, low + n, 2 * l + 1), q = entry(knotHigh, low + n, 2 * l + 1);
        float less = max((1. - between) * dot(p, vec4(1)), 0.) + 1e-12, more = max(between * dot(q, vec4(1)), 0.) + 1e-12;
        lobe += share * mix(a, b, more / (less + more));
        strength += share * mix(p, q, between);
      }
      if (l == lobes) { diffuse = strength; break; }
      vec3 local = normalize(lobe.xyz);
      vec3 tint = strength.x * w[0] + strength.y * w[1] + strength.z * w[2] + strength.w * w[3];
      vec3 middle = ahead * local.x + aside * local.y + normal * local.z;
      float k = exp(lobe.w);
      color += tint * seen(pyramidStart + row * STRIDE, middle, k);
      if (families > 0) continue;
      for (int i = 0; i < texels; i++) {
        vec3 d = texelWay(i), away = d - middle;
        float value = dot(d, normal) > 0. ? k / (6.28318531 * (1. - exp(-2. * k))) * exp(-k * dot(away, away) / 2.) : 0.;
        if (value > 1e-6) color += tint * value * clear(row, d) * texelFetch(bright, at(2 * i + 1), 0).rgb;
      }
    }
  }
  for (int i = 0; i < texels; i++) {
    vec3 d = texelWay(i);
    float cosine = dot(d, normal);
    if (cosine <= 0.) continue;
    vec4 value = families > 0 ? family(d, wo, normal, rough) : diffuse / 3.14159265;
    color += (value.x * w[0] + value.y * w[1] + value.z * w[2] + value.w * w[3]) * cosine * clear(row, d) * texelFetch(bright, at(2 * i + 1), 0).rgb;
  }
  color += arriving * (diffuse.x * w[0] + diffuse.y * w[1] + diffuse.z * w[2] + diffuse.w * w[3]);
  color = clamp(color, -65504., 65504.);
  o = uvec4(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0)), 0, 0);
}`;
// The harmonics of the light that arrives at a vertex, two at a time: those of its visibility times the light's table.
const GATHER = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp isampler2D;
uniform isampler2D visible; uniform sampler2D gathered; uniform int count, bands, words, visibleStart, arrivedStart;
out uvec4 o;
ivec2 at(int i) { return ivec2(i & ${WIDTH - 1}, i >> 12); }
vec3 light(int harmonic, int i) { return texelFetch(gathered, at(harmonic * 4 * words + i), 0).rgb; }
void main() {
  int pairs = (bands * bands + 1) / 2, i = int(gl_FragCoord.x) + ${WIDTH} * int(gl_FragCoord.y) - arrivedStart;
  if (i < 0 || i >= count * pairs) discard;
  int vertex = i / pairs, first = 2 * (i - vertex * pairs);
  bool both = first + 1 < bands * bands;
  vec3 a = vec3(0), b = vec3(0);
  for (int k = 0; k < words; k++) {
    vec4 each = vec4(texelFetch(visible, at(visibleStart + vertex * words + k), 0));
    for (int c = 0; c < 4; c++) {
      a += each[c] * light(first, 4 * k + c);
      if (both) b += each[c] * light(first + 1, 4 * k + c);
    }
  }
  a = clamp(a, -65504., 65504.);
  b = clamp(b, -65504., 65504.);
  o = uvec4(packHalf2x16(a.rg), packHalf2x16(vec2(a.b, b.r)), packHalf2x16(b.gb), 0);
}`;
const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0, 1); }`;

const toHalf = (() => {
  const float = new Float32Array(1), bits = new Uint32Array(float.buffer);
  return (value) => {
    float[0] = Math.min(Math.max(value, -65504), 65504);
    const x = bits[0], sign = (x >>> 16) & 0x8000, exponent = ((x >>> 23) & 255) - 112;
    if (exponent <= 0) return sign | (exponent < -10 ? 0 : (((x & 0x7fffff) | 0x800000) + (1 << (13 - exponent))) >> (14 - exponent));
    return sign | ((exponent << 10) + ((x & 0x7fffff) >> 13) + ((x >> 12) & 1));
  };
})();

// Real spherical harmonics of a unit direction, orthonormal, z the polar axis, in the order l (l + 1) + m.
function harmonics(x, y, z, degree, result) {
  let real = 1, imaginary = 0, diagonal = Math.sqrt(1 / (4 * Math.PI));
  const factor = (l, m) => Math.sqrt((4 * l * l - 1) / (l * l - m * m));
  for (let m = 0; m <= degree; m++) {
    if (m > 0) {
      [real, imaginary] = [real * x - imaginary * y, real * y + imaginary * x];
      diagonal *= Math.sqrt(((2 * m + 1) / (2 * m)) * (m === 1 ? 2 : 1));
    }
    for (let l = m, before = 0, value = diagonal; l <= degree; l++) {
      result[l * (l + 1) + m] = value * real;
      if (m > 0) result[l * (l + 1) - m] = value * imaginary;
      [before, value] = [value, factor(l + 1, m) * (z * value - (l > m ? before / factor(l, m) : 0))];
    }
  }
}

// The window of `jaxprt.sphere.harmonics.least_laplacian`: a factor for each band.
function leastLaplacian(light, degree, kept) {
  const band = Array.from({ length: degree + 1 }, (_, l) => l), weight = band.map((l) => (l * (l + 1)) ** 2), spectrum = band.map(() => 0);
  for (const l of band) for (let i = 3 * l * l; i < 3 * (l + 1) ** 2; i++) spectrum[l] += weight[l] * light[i] ** 2;
  const total = spectrum.reduce((a, b) => a + b);
  if (!total || kept >= 1) return band.map(() => 1);
  if (kept === 0) return band.map((l) => (l ? 0 : 1));
  let strength = 0;
  for (let step = 0; step < 12; step++) {
    const factor = weight.map((each) => 1 / (1 + strength * each));
    const remains = spectrum.reduce((sum, each, l) => sum + (each / total) * factor[l] ** 2, 0);
    const slope = spectrum.reduce((sum, each, l) => sum + (each / total) * factor[l] ** 3 * weight[l], 0);
    strength += (remains / slope) * (Math.sqrt(remains / kept) - 1);
  }
  return weight.map((each) => 1 / (1 + Math.max(strength, 0) * each));
}

// Heights and weights of Gauss and Legendre.
function gauss(count) {
  return Array.from({ length: count }, (_, i) => {
    let x = Math.cos((Math.PI * (i + 0.75)) / (count + 0.5)), slope = 1;
    for (let step = 0; step < 20; step++) {
      let value = 1, before = 0;
      for (let l = 1; l <= count; l++) [value, before] = [((2 * l - 1) * x * value - (l - 1) * before) / l, value];
      slope = (count * (before - x * value)) / (1 - x * x);
      x -= value / slope;
    }
    return { height: x, weight: 2 / ((1 - x * x) * slope * slope) };
  });
}
const rules = new Map(); // of quadrature on the sphere, exact for products of harmonics of degrees d, d and 2 d
function rule(degree) {
  if (!rules.has(degree)) {
    const around = 4 * degree + 1, nodes = [];
    for (const { height, weight } of gauss(2 * degree + 1)) for (let i = 0; i < around; i++) {
      const angle = (2 * Math.PI * i) / around, ring = Math.sqrt(1 - height * height), value = new Float64Array((2 * degree + 1) ** 2);
      harmonics(ring * Math.cos(angle), ring * Math.sin(angle), height, 2 * degree, value);
      nodes.push({ value, weight: (weight * 2 * Math.PI) / around });
    }
    rules.set(degree, nodes);
  }
  return rules.get(degree);
}
// For each harmonic that arrives and each of the visibility the integral of both times the light, times the visibility's unit.
function gathered(light, { bands, words, laplacian }, unit) {
  const degree = bands - 1, window = leastLaplacian(light, degree, laplacian), terms = bands ** 2, result = new Float64Array(16 * terms * words), shown = [0, 0, 0];
  for (const { value, weight } of rule(degree)) {
    shown.fill(0);
    for (let l = 0; l < bands; l++) for (let i = l * l; i < (l + 1) ** 2; i++) for (let c = 0; c < 3; c++) shown[c] += weight * window[l] * value[i] * light[3 * i + c];
    for (let i = 0; i < terms; i++) for (let k = 0; k < value.length; k++) {
      const each = value[i] * value[k] * unit[k], to = 4 * (4 * i * words + k);
      for (let c = 0; c < 3; c++) result[to + c] += each * shown[c];
    }
  }
  return Float32Array.from(result);
}

// Directions and solid angles of the texels of cubemaps.
const SIDES = [[[0, 0, -1], [0, -1, 0], [1, 0, 0]], [[0, 0, 1], [0, -1, 0], [-1, 0, 0]], [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
  [[1, 0, 0], [0, 0, -1], [0, -1, 0]], [[1, 0, 0], [0, -1, 0], [0, 0, 1]], [[-1, 0, 0], [0, -1, 0], [0, 0, -1]]];
const grids = new Map();
function grid(edge) {
  if (grids.has(edge)) return grids.get(edge);
  const way = new Float32Array(18 * edge * edge), area = new Float32Array(6 * edge * edge);
  const corner = (s, t) => Math.atan2(s * t, Math.sqrt(1 + s * s + t * t)), step = 2 / edge;
  for (let face = 0, i = 0; face < 6; face++) for (let row = 0; row < edge; row++) for (let column = 0; column < edge; column++, i++) {
    const s = (column + 0.5) * step - 1, t = (row + 0.5) * step - 1, length = Math.sqrt(1 + s * s + t * t);
    for (let c = 0; c < 3; c++) way[3 * i + c] = (s * SIDES[face][0][c] + t * SIDES[face][1][c] + SIDES[face][2][c]) / length;
    const [u, v, s1, t1] = [s - step / 2, t - step / 2, s + step / 2, t + step / 2];
    area[i] = corner(s1, t1) - corner(u, t1) - corner(s1, v) + corner(u, v);
  }
  grids.set(edge, { way, area });
  return { way, area };
}
// The texel that a part of one lies in, where each has `parts` x `parts`.
const whole = (i, edge, parts) => {
  const m = edge * parts, row = Math.floor(i / m);
  return Math.floor(row / parts) * edge + Math.floor((i % m) / parts);
};

// A light at half the resolution: means over the sphere.
function halved(light, edge) {
  const { area } = grid(edge), half = edge / 2, result = new Float32Array(18 * half * half), total = grid(half).area;
  for (let face = 0; face < 6; face++) for (let row = 0; row < edge; row++) for (let column = 0; column < edge; column++) {
    const from = (face * edge + row) * edge + column, to = (face * half + (row >> 1)) * half + (column >> 1);
    for (let c = 0; c < 3; c++) result[3 * to + c] += (light[3 * from + c] * area[from]) / total[to];
  }
  return result;
}

// Faces with a rim of their neighbours' texels; the corners are means of the three that meet.
function rimmed(light, edge, index, result, start) {
  const m = edge + 2, outer = [0, m - 1], inner = [1, m - 2];
  for (let i = 0; i < 6 * m * m; i++) for (let c = 0; c < 3; c++) result[4 * (start + i) + c] = light[3 * index[i] + c];
  for (let face = 0; face < 6; face++) for (let p = 0; p < 2; p++) for (let q = 0; q < 2; q++) for (let c = 0; c < 3; c++) {
    const from = (row, column) => result[4 * (start + (face * m + row) * m + column) + c];
    result[4 * (start + (face * m + outer[p]) * m + outer[q]) + c] = (from(inner[p], inner[q]) + from(inner[p], outer[q]) + from(outer[p], inner[q])) / 3;
  }
}

// Blurs a light to all widths, as `jaxprt.lobe.prefilter` does; which texels each takes, and how much, is made once.
class Blur {
  constructor(scale, index) {
    Object.assign(this, { scale, index });
    this.levels = scale.edges.map((edge, i) => (i ? this.taps(edge, scale.sources[i], scale.concentrations[i], scale.reaches[i]) : null));
  }
  taps(edge, source, concentration, reach) {
    const to = grid(edge).way, { way, area } = grid(source), least = Math.cos(reach), from = [0], index = [], weight = [];
    for (let i = 0; i < 6 * edge * edge; i++) {
      let total = 0;
      for (let j = 0; j < 6 * source * source; j++) {
        const cosine = to[3 * i] * way[3 * j] + to[3 * i + 1] * way[3 * j + 1] + to[3 * i + 2] * way[3 * j + 2];
        if (cosine < least) continue;
        const each = area[j] * Math.exp(concentration * (cosine - 1));
        index.push(j);
        weight.push(each);
        total += each;
      }
      for (let k = from[i]; k < index.length; k++) weight[k] /= total;
      from.push(index.length);
    }
    return { from: Uint32Array.from(from), index: Uint16Array.from(index), weight: Float32Array.from(weight) };
  }
  apply(mips) {
    const { edges, starts, sources, total } = this.scale, result = new Float32Array(4 * WIDTH * Math.ceil(total / WIDTH));
    edges.forEach((edge, n) => {
      let value = mips.get(edge);
      if (n) {
        const { from, index, weight } = this.levels[n], source = mips.get(sources[n]);
        value = new Float32Array(18 * edge * edge);
        for (let i = 0; i < 6 * edge * edge; i++) for (let k = from[i]; k < from[i + 1]; k++) for (let c = 0; c < 3; c++) value[3 * i + c] += weight[k] * source[3 * index[k] + c];
      }
      rimmed(value, edge, this.index.get(edge), result, starts[n]);
    });
    return result;
  }
}

// Radiance HDR: lines of RGBE, plain or by runs of either kind, from the top left. Pixels divided by the exposures are radiance.
function readHdr(data) {
  const text = new TextDecoder("latin1").decode(data.subarray(0, 4096)), size = /\n\s*\n?-Y (\d+) \+X (\d+)\n/.exec(text);
  if (!text.startsWith("#?") || !size || !text.includes("32-bit_rle_rgbe")) throw new Error("must be a Radiance HDR environment with its first line on top (EXR files need Python)");
  const height = Number(size[1]), width = Number(size[2]);
  if (width !== 2 * height) throw new Error(`must be twice as wide as high, got ${width} x ${height} pixels`);
  const head = text.slice(0, size.index), factor = [1, 1, 1];
  if (/^PRIMARIES=/m.test(head)) throw new Error("must have the primaries of Rec. 709 and not state others, which need Python");
  for (const [, value] of head.matchAll(/^(?:EXPOSURE|COLORCORR)=(.*)$/gm)) {
    const number = value.trim().split(/\s+/).map(Number);
    for (let c = 0; c < 3; c++) factor[c] /= number[number.length > 1 ? c : 0];
  }
  if (!factor.every((value) => value > 0 && value < Infinity)) throw new Error("must have positive exposures, got others");
  if (width * height > 2 ** 26) throw new Error(`must have at most ${2 ** 26} pixels, got ${width} x ${height}`);
  const pixel = new Float32Array(3 * width * height), line = new Uint8Array(4 * width);
  let place = size.index + size[0].length;
  for (let y = 0; y < height; y++) {
    if (width >= 8 && width < 32768 && data[place] === 2 && data[place + 1] === 2 && data[place + 2] < 128) {
      place += 4;
      for (let c = 0; c < 4; c++) for (let x = 0; x < width; ) {
        const count = data[place++], run = count > 128, length = run ? count - 128 : count;
        if (!length || x + length > width || place >= data.length) throw new Error("must be a whole Radiance HDR file, got a damaged one");
        for (let k = 0; k < length; k++, x++) line[4 * x + c] = run ? data[place] : data[place + k];
        place += run ? 1 : length;
      }
    } else {
      // 1, 1, 1, n repeats the pixel before n times; consecutive ones are the digits of n to the base 256.
      for (let x = 0, unit = 1; x < width; place += 4) {
        if (place + 4 > data.length) throw new Error("must be a whole Radiance HDR file, got a part of one");
        const repeats = x > 0 && data[place] === 1 && data[place + 1] === 1 && data[place + 2] === 1, count = repeats ? unit * data[place + 3] : 1;
        if (x + count > width) throw new Error("must be a whole Radiance HDR file, got a damaged one");
        unit = repeats ? 256 * unit : 1;
        for (const end = x + count; x < end; x++) line.set(repeats ? line.subarray(4 * x - 4, 4 * x) : data.subarray(place, place + 4), 4 * x);
      }
    }
    for (let x = 0; x < width; x++) for (let c = 0; c < 3; c++) pixel[3 * (y * width + x) + c] = line[4 * x + 3] ? factor[c] * line[4 * x + c] * 2 ** (line[4 * x + 3] - 136) : 0;
  }
  return { pixel, width, height };
}

// A latitude-longitude image as a cubemap: each texel the mean of some points in it.
function toCubemap({ pixel, width, height }, edge) {
  const parts = Math.max(1, Math.ceil(width / (4 * edge))), fine = grid(edge * parts), result = new Float32Array(18 * edge * edge), { area } = grid(edge);
  for (let i = 0; i < fine.area.length; i++) {
    const [x, y, z] = fine.way.subarray(3 * i, 3 * i + 3), to = whole(i, edge, parts);
    const u = (((0.5 - Math.atan2(x, z) / (2 * Math.PI)) * width) % width + width) % width, v = (Math.acos(Math.min(Math.max(y, -1), 1)) / Math.PI) * height;
    const from = Math.min(Math.floor(v), height - 1) * width + Math.min(Math.floor(u), width - 1);
    for (let c = 0; c < 3; c++) result[3 * to + c] += (pixel[3 * from + c] * fine.area[i]) / area[to];
  }
  grids.delete(edge * parts);
  return result;
}

// A latitude-longitude image of at most 2048 columns as a picture of a light: half floats, and its mip maps.
function toSky({ pixel, width, height }) {
  const levels = [];
  for (;;) {
    if (width <= 2048 || width % 2 || height % 2) levels.push({ pixel, width, height });
    if (height <= 128 || width % 2 || height % 2) break;
    const coarse = new Float32Array((3 * width * height) / 4), from = (x, y, c) => pixel[3 * (y * width + x) + c];
    for (let y = 0, to = 0; y < height; y += 2) for (let x = 0; x < width; x += 2) for (let c = 0; c < 3; c++) coarse[to++] = (from(x, y, c) + from(x + 1, y, c) + from(x, y + 1, c) + from(x + 1, y + 1, c)) / 4;
    [pixel, width, height] = [coarse, width / 2, height / 2];
  }
  const data = new Uint16Array(levels.reduce((total, level) => total + level.pixel.length, 0)), [first] = levels;
  let brightest = 1, place = 0;
  for (const value of first.pixel) brightest = Math.max(brightest, value);
  const scale = Math.max(1, brightest / 65504);
  for (const level of levels) for (const value of level.pixel) data[place++] = toHalf(value / scale);
  return { content: { kind: "sky", scale, width: first.width, height: first.height, levels: levels.length }, buffers: [new DataView(data.buffer)] };
}

class Piece {
  constructor(content, buffers) {
    this.content = content;
    const next = (() => { let i = 0; return (kind) => { const each = buffers[i++]; return new kind(each.buffer, each.byteOffset, each.byteLength / (kind.BYTES_PER_ELEMENT ?? 1)); }; })();
    this.position = next(Float32Array);
    this.face = next(Uint32Array);
    this.normal = next(Int16Array);
    this.vectors = next(Int8Array);
    this.pyramid = next(Uint8Array);
    this.table = next(Float32Array);
    this.weights = next(Float32Array);
    this.visible = next(Int8Array);
    this.bits = next(Uint8Array);
    this.index = new Map(content.rims.map((edge) => [edge, next(Uint32Array)]));
    this.lights = content.scene.lights.map(() => next(Float32Array));
    this.names = [...content.scene.lights];
    this.skies = (content.skies ?? []).map((sky) => sky && { content: sky, buffers: [next(DataView)] });
    this.canvas = document.createElement("canvas");
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.build();
  }
  build() {
    const gl = (this.gl = this.canvas.getContext("webgl2")), { content } = this;
    if (!gl) throw new Error("this browser has no WebGL2, which the viewer needs");
    const bands = Math.max(1, ...content.parts.map((part) => part.bands)), knots = Math.max(2, ...content.parts.map((part) => part.knot.length));
    const text = SHADE.replaceAll("HARMONICS", 2 * Math.ceil(bands ** 2 / 2)).replaceAll("BANDS", bands).replaceAll("KNOTS", knots).replaceAll("TERMS", content.terms).replaceAll("LEVELS", content.edges.length).replaceAll("WIDTHS", content.light.edges.length).replaceAll("STRIDE", content.stride).replaceAll("TEXELS", Math.max(content.texelEdge, 4));
    this.program = this.link(text);
    gl.useProgram(this.program);
    gl.bindVertexArray(gl.createVertexArray());
    const count = content.scene.vertices, place = new Float32Array(8 * count);
    for (let i = 0; i < count; i++) for (let c = 0; c < 3; c++) {
      place[8 * i + c] = this.position[3 * i + c];
      place[8 * i + 4 + c] = this.normal[3 * i + c] / 32767;
    }
    this.unit = 0;
    this.textures = {};
    this.texture("place", gl.RGBA32F, gl.RGBA, gl.FLOAT, place, 4);
    this.texture("vectors", gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, this.vectors, 4);
    this.texture("pyramid", gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, new Uint32Array(this.pyramid.buffer, this.pyramid.byteOffset, this.pyramid.length / 4), 1);
    this.texture("bits", gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, new Uint32Array(this.bits.buffer, this.bits.byteOffset, this.bits.length / 4), 1);
    this.texture("table", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.table, 4);
    this.texture("weights", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.weights, 4);
    const set = { ints: gl.uniform1iv, floats: gl.uniform1fv };
    for (const [kind, name, value] of [["ints", "edges", content.edges], ["ints", "starts", content.starts], ["floats", "spreads", content.spreads],
      ["ints", "lightEdges", content.light.edges], ["ints", "lightStarts", content.light.starts], ["floats", "lightSpreads", content.light.spreads]]) set[kind].call(gl, this.at(name), value);
    this.arrived = this.target(content.arrived, this.unit++);
    gl.uniform1i(this.at("arrived"), this.unit - 1);
    this.color = this.target(count, this.unit++);
    if (content.arrived) {
      this.gather = this.link(GATHER);
      this.texture("visible", gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE, this.visible, 4, this.gather);
    }
    this.degree = Math.max(Math.round(Math.sqrt(content.vectorUnit.length)), ...content.parts.map((part) => part.bands)) - 1;
    this.use(this.program, this.color);
    for (const part of content.parts) part.written = "";
    [this.lit, this.turned] = ["", ""];
  }
  link(text) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, WHOLE], [gl.FRAGMENT_SHADER, text]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return program;
  }
  // A texture of so many entries that is drawn into.
  target(entries, unit) {
    const gl = this.gl, made = gl.createTexture(), frame = gl.createFramebuffer(), rows = Math.max(1, Math.ceil(entries / WIDTH));
    this.check(rows);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, WIDTH, rows);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made, 0);
    return { frame, rows };
  }
  use(program, target) {
    const gl = this.gl;
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, WIDTH, target.rows);
  }
  check(rows) {
    const most = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
    if (rows > most) throw new Error(`this browser has textures of ${most} rows, and the scene needs ${rows}`);
  }
  at(name, program = this.program) { return placeOf(this.gl, program, name); }
  texture(name, internal, format, type, data, channels, program = this.program) {
    const gl = this.gl, entries = data.length / channels, rows = Math.max(1, Math.ceil(entries / WIDTH));
    this.check(rows);
    const unit = (this.textures[name] ??= { unit: this.unit++ }).unit;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(this.textures[name].made ?? null);
    gl.bindTexture(gl.TEXTURE_2D, (this.textures[name].made = gl.createTexture()));
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const padded = new data.constructor(WIDTH * rows * channels);
    padded.set(data);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, WIDTH, rows, 0, format, type, padded);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.useProgram(program);
    gl.uniform1i(this.at(name, program), unit);
  }
  // A light with its lamps: disks; one that is smaller than a texel keeps its flux.
  radiance(message) {
    const edge = this.content.mips[0], light = Float32Array.from(this.lights[message.light]), { area } = grid(edge), fine = grid(edge * FINE);
    for (const lamp of message.lamps) {
      const l = Math.hypot(...lamp.direction), d = lamp.direction.map((x) => x / l), flux = new Float64Array(6 * edge * edge);
      const toward = fine.area.map((_, i) => fine.way[3 * i] * d[0] + fine.way[3 * i + 1] * d[1] + fine.way[3 * i + 2] * d[2]);
      const least = Math.min(Math.cos(lamp.angle), toward.reduce((a, b) => Math.max(a, b)));
      let total = 0;
      toward.forEach((each, i) => {
        if (each < least) return;
        flux[whole(i, edge, FINE)] += fine.area[i];
        total += fine.area[i];
      });
      const scale = (2 * Math.PI * (1 - Math.cos(lamp.angle))) / total;
      for (let i = 0; i < 6 * edge * edge; i++) for (let c = 0; c < 3; c++) light[3 * i + c] += ((flux[i] * scale) / area[i]) * lamp.radiance[c];
    }
    return light;
  }
  // The light side: the light blurred, and its harmonics as it is turned.
  shine(message) {
    const { gl, content } = this, key = JSON.stringify([message.light, message.lamps]);
    if (this.lit !== key) {
      this.mips = new Map();
      const all = this.radiance(message);
      let light = this.split(all);
      // Parts without single texels are lit by all of the light.
      this.all = light === all || content.parts.every((part) => part.texels) ? null : all;
      for (let edge = content.mips[0]; this.all && edge > 32 && edge > content.mips.at(-1); edge /= 2) this.all = halved(this.all, edge);
      for (const edge of content.mips) {
        this.mips.set(edge, light);
        if (edge > content.mips.at(-1)) light = halved(light, edge);
      }
      if (content.glossy) {
        this.blur ??= new Blur(content.light, this.index);
        this.texture("light", gl.RGBA32F, gl.RGBA, gl.FLOAT, this.blur.apply(this.mips), 4);
      }
      [this.lit, this.turned] = [key, ""];
    }
    if (this.turned === `${key} ${message.turn}`) return;
    const c = Math.cos(message.turn), s = Math.sin(message.turn);
    const edge = content.mips.find((each) => each <= 32) ?? content.mips.at(-1), rest = this.project(this.mips.get(edge), edge, c, s);
    const all = this.all ? this.project(this.all, edge, c, s) : rest;
    [this.irradiance, this.irradianceOfAll] = [rest, all].map((each) => {
      const result = new Float32Array(3 * content.terms);
      content.vectorUnit.forEach((unit, k) => { for (let j = 0; j < 3; j++) result[3 * k + j] = unit * each[3 * k + j]; });
      return result;
    });
    gl.uniform2f(this.at("turn"), c, s);
    if (content.arrived) this.arrive(all);
    this.turned = `${key} ${message.turn}`;
  }
  // Harmonics of a light that is turned.
  project(light, edge, c, s) {
    const parts = Math.max(1, Math.floor(32 / edge)), { way, area } = grid(edge * parts), basis = new Float64Array((this.degree + 1) ** 2), value = new Float64Array(3 * basis.length);
    for (let i = 0; i < area.length; i++) {
      const [x, y, z] = [way[3 * i], way[3 * i + 1], way[3 * i + 2]], from = whole(i, edge, parts);
      harmonics(c * x + s * z, y, c * z - s * x, this.degree, basis);
      for (let k = 0; k < basis.length; k++) for (let j = 0; j < 3; j++) value[3 * k + j] += basis[k] * area[i] * light[3 * from + j];
    }
    return value;
  }
  // Takes a light through the transfer matrices: what arrives is kept until the light changes.
  arrive(light) {
    const { gl, content } = this;
    let key = "";
    this.use(this.gather, this.arrived);
    for (const part of content.parts) {
      if (!part.bands) continue;
      const own = `${part.bands} ${part.laplacian}`;
      if (own !== key) this.texture("gathered", gl.RGBA32F, gl.RGBA, gl.FLOAT, gathered(light, part, content.visibleUnit), 4, this.gather);
      key = own;
      for (const name of ["count", "bands", "words", "visibleStart", "arrivedStart"]) gl.uniform1i(this.at(name, this.gather), part[name]);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    this.use(this.program, this.color);
  }
  // Takes the brightest texels out of a light, as far as they stand out: `jaxprt.bright_texels.split`.
  split(light) {
    const { gl, content } = this, edge = content.mips[0], { way, area } = grid(edge), count = content.texels;
    if (!count) return light;
    const flux = area.map((each, i) => each * (light[3 * i] + light[3 * i + 1] + light[3 * i + 2]));
    const order = Array.from(flux.keys()).sort((a, b) => flux[b] - flux[a]), rest = light.slice(), data = new Float32Array(8 * count);
    for (let n = 0; n < count; n++) {
      const i = order[n], share = flux[i] > 0 ? Math.max(1 - flux[order[count]] / flux[i], 0) : 0;
      for (let c = 0; c < 3; c++) {
        data[8 * n + c] = way[3 * i + c];
        data[8 * n + 4 + c] = share * light[3 * i + c] * area[i] * (1 - area[i] / (4 * Math.PI)); // as a disk of its solid angle has
        rest[3 * i + c] -= share * light[3 * i + c];
      }
    }
    this.texture("bright", gl.RGBA32F, gl.RGBA, gl.FLOAT, data, 4);
    return rest;
  }
  look(message) {
    const { gl, content } = this;
    if (gl.isContextLost()) { this.canvas = document.createElement("canvas"); this.build(); return this.look(message); }
    const began = performance.now();
    this.shine(message);
    const lit = performance.now();
    gl.uniform3fv(this.at("eye"), message.eye);
    for (const part of content.parts) {
      const { weightStep, log } = this.material(part, message.materials[part.name]);
      for (const name of ["first", "count", "lobes", "channels", "nodes", "tableStart", "weightStart", "pyramidStart", "terms", "bands", "entries", "arrivedStart", "bitStart"]) gl.uniform1i(this.at(name), part[name]);
      gl.uniform1f(this.at("steps"), part.steps);
      gl.uniform1i(this.at("texels"), part.texels ? content.texels : 0);
      gl.uniform3fv(this.at("irradiance"), part.texels ? this.irradiance : this.irradianceOfAll);
      gl.uniform1i(this.at("weightStep"), weightStep);
      gl.uniform1f(this.at("logRoughness"), log);
      gl.uniform1i(this.at("families"), part.family.terms.length);
      if (part.family.terms.length) {
        gl.uniform1iv(this.at("term"), part.family.terms);
        gl.uniform1fv(this.at("scale"), part.family.scale);
      }
      gl.uniform1i(this.at("knots"), Math.max(part.knot.length, 1));
      if (part.knot.length) gl.uniform1fv(this.at("knot"), part.knot);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    const count = content.scene.vertices, found = new Uint32Array(4 * WIDTH * this.color.rows), result = new Uint16Array(3 * count);
    gl.readPixels(0, 0, WIDTH, this.color.rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    for (let i = 0; i < count; i++) {
      result[3 * i] = found[4 * i] & 65535;
      result[3 * i + 1] = found[4 * i] >>> 16;
      result[3 * i + 2] = found[4 * i + 1] & 65535;
    }
    const ms = { light: lit - began, view: 0, combine: performance.now() - lit };
    return { content: { kind: "color", seq: message.seq, scale: 1, ms }, buffers: [new DataView(result.buffer)] };
  }
  // Weights of a part whose material is one for all vertices, as `MetallicRoughness.coefficient` has them.
  material(part, change) {
    const own = part.material;
    if (!own) return { weightStep: part.weightStep, log: 0 };
    const value = { ...own, ...change };
    if (own.exponent !== undefined) {
      const most = Math.max(...own.specular), strength = change?.f0 ?? most;
      const specular = change?.f0 === undefined && !change?.specular ? own.specular : (change.specular ?? own.specular.map((x) => x / Math.max(most, 1e-6))).map((x) => x * strength);
      this.write(part, { 3: value.diffuse, 4: specular });
      return { weightStep: 0, log: Math.log(2 / (value.exponent + 2)) / 2 };
    }
    if (own.slope !== undefined) {
      const most = Math.max(...own.f0), f0 = change?.f0 === undefined ? own.f0 : most > 0 ? own.f0.map((x) => x * change.f0 / most) : own.f0.map(() => change.f0);
      this.write(part, { 3: value.diffuse, 5: value.specular.map((x, c) => x * f0[c]), 6: value.specular.map((x, c) => x * (1 - f0[c])) });
      return { weightStep: 0, log: Math.log(Math.max(value.roughness ?? own.slope, 1e-3)) };
    }
    const white = ((1 - own.ior) / (1 + own.ior)) ** 2, f0White = Math.max(white, 1e-6);
    let tint = own.specular_color;
    if (change?.f0 !== undefined || change?.specular) {
      const most = Math.max(...tint), strength = change.f0 !== undefined ? change.f0 / (own.ior === 0 ? 1 : f0White) : most;
      tint = (change.specular ?? tint.map((x) => x / Math.max(most, 1e-6))).map((x) => x * strength);
    }
    const base = change?.diffuse ?? own.base_color, f0 = tint.map((x) => Math.min(white * x, 1)), dielectric = 1 - own.metallic, layer = dielectric * own.specular;
    const under = 1 - Math.max(...f0), every = [
      base.map((x) => layer * x * under),
      f0.map((x, c) => layer * x + own.metallic * base[c]),
      f0.map((x, c) => layer * (1 - x) + own.metallic * (1 - base[c])),
      base.map((x) => dielectric * (1 - own.specular) * x),
    ];
    this.write(part, every);
    return { weightStep: 0, log: Math.log(Math.max(value.roughness, 1e-3 ** 0.5)) };
  }
  write(part, every) {
    const gl = this.gl, key = JSON.stringify(every);
    if (key === part.written) return;
    part.family.terms.forEach((term, k) => {
      const at = part.weightStart + k;
      gl.activeTexture(gl.TEXTURE0 + this.textures.weights.unit);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, at % WIDTH, Math.floor(at / WIDTH), 1, 1, gl.RGBA, gl.FLOAT, Float32Array.of(...every[term].map((x) => x / part.family.scale[k]), 0));
    });
    part.written = key;
  }
  sky(message) {
    const fine = this.skies[message.light];
    if (message.rows > 1 && fine && !message.lamps.length) return { ...fine, content: { ...fine.content, seq: message.seq } };
    const edge = this.content.mips[0], light = this.radiance(message), height = 128, width = 256, result = new Uint16Array(3 * width * height);
    const rim = new Float32Array(24 * (edge + 2) ** 2), index = this.index.get(edge), m = edge + 2;
    rimmed(light, edge, index, rim, 0);
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const latitude = Math.PI * (0.5 - (y + 0.5) / height), longitude = Math.PI * (1 - (2 * (x + 0.5)) / width), ring = Math.cos(latitude);
      const d = [ring * Math.sin(longitude), Math.sin(latitude), ring * Math.cos(longitude)];
      const size = d.map(Math.abs), axis = size.indexOf(Math.max(...size)), face = 2 * axis + (d[axis] < 0 ? 1 : 0);
      const [S, T, N] = SIDES[face], dot = (A) => A[0] * d[0] + A[1] * d[1] + A[2] * d[2];
      const u = ((dot(S) / dot(N) + 1) / 2) * edge + 0.5, v = ((dot(T) / dot(N) + 1) / 2) * edge + 0.5, i = Math.min(Math.floor(u), edge), j = Math.min(Math.floor(v), edge);
      for (let c = 0; c < 3; c++) {
        const from = (row, column) => rim[4 * ((face * m + row) * m + column) + c];
        const top = from(j, i) + (u - i) * (from(j, i + 1) - from(j, i)), low = from(j + 1, i) + (u - i) * (from(j + 1, i + 1) - from(j + 1, i));
        result[3 * (y * width + x) + c] = toHalf(top + (v - j) * (low - top));
      }
    }
    return { content: { kind: "sky", seq: message.seq, scale: 1, width, height }, buffers: [new DataView(result.buffer)] };
  }
  drop(message, data) {
    const image = readHdr(new Uint8Array(data));
    this.lights.push(toCubemap(image, this.content.mips[0]));
    this.skies[this.lights.length - 1] = toSky(image);
    this.names.push(message.name.replace(/\.[^.]*$/, ""));
    return { content: { kind: "lights", lights: [...this.names], light: this.names.length - 1 }, buffers: [] };
  }
  answer(message, buffers) {
    switch (message.kind) {
      case "scene": return { content: { ...this.content.scene, lights: this.names }, buffers: [this.position, this.face] };
      case "look": return this.look(message);
      case "sky": return this.sky(message);
      default: return this.drop(message, buffers[0]);
    }
  }
}
function placeOf(gl, program, name) {
  const known = (program.places ??= new Map());
  if (!known.has(name)) known.set(name, gl.getUniformLocation(program, name));
  return known.get(name);
}

// What `mount` of `viewer.js` asks: the answers of a scene that `export` has written.
export function answers(content, buffers) {
  const piece = new Piece(content, buffers);
  return async (message, given = []) => {
    try {
      return piece.answer(message, given);
    } catch (error) {
      return { content: { kind: "error", of: message.kind, message: `${message.name ?? "the viewer"} ${error.message}` }, buffers: [] };
    }
  };
}
