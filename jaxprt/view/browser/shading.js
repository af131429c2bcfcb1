// Shaders that relight vertices and pixels. A pixel is a point on a triangle: what is linear in the transport of the
// vertices is interpolated, visibility is looked up at the three corners, and position, normal and view are its own.

export const WIDTH = 4096; // columns of all textures that hold arrays

export const AT = `ivec2 at(int i) { return ivec2(i & ${WIDTH - 1}, i >> 12); }`;
const CUBE = `
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
`;
const BRIGHT = `
uniform sampler2D bright; uniform vec2 turn; // cosine and sine
vec3 texelDirection(int i) {
  vec3 d = texelFetch(bright, at(2 * i), 0).xyz;
  return vec3(turn.x * d.x + turn.y * d.z, d.y, turn.x * d.z - turn.y * d.x);
}`;

export const SHADE = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform sampler2D place, weights, table, light; uniform usampler2D pyramid, arrived, arriving, sight, shown;
uniform vec3 eye;
uniform int first, count, lobes, channels, nodes, knots, tableStart, weightStart, weightStep, pyramidStart, term[4], families, texels, bands, entries, arrivedStart;
uniform float knot[KNOTS], scale[4], logRoughness, steps;
uniform int edges[LEVELS], starts[LEVELS], lightEdges[WIDTHS], lightStarts[WIDTHS];
uniform float spreads[LEVELS], lightSpreads[WIDTHS];
uniform int finest; // of the blurred lights that there are
uniform sampler2D coordinates, base_colorImage, roughnessImage, metallicImage, emissiveImage, normalImage;
uniform int sampled, sets[5]; // which textures there are, and the coordinates and transform of each
uniform vec3 across[5], upward[5], baseColor, f0, emissive; uniform vec4 factors; // specular, metallic, roughness, and what is left of diffuse light where light passes
uniform float slope; // of the normal map
uniform bool glass; // which hides a share of what is behind it, and none of what it reflects itself
${AT} ${CUBE} ${BRIGHT}
int corner[CORNERS]; // vertices of the part, and how much each counts
float share[CORNERS];
vec3 position, normal, smooth_; // normals with that of a map, and without

float drop(float k) { return k < 1e-2 ? 1. - k / 3. : 1. / k - 2. / (exp(min(2. * k, 80.)) - 1.); }

// Row and column of the first of four texels about a place, the rim counted, and how far the place is beyond.
ivec2 lowest(int edge, float s, float t, out vec2 part) {
  vec2 place = (vec2(s, t) + 1.) * (float(edge) / 2.) + .5, low = clamp(floor(place), 0., float(edge));
  part = place - low;
  return ivec2(low);
}
vec3 spline(float off) { return vec3((.5 - off) * (.5 - off) / 2., .75 - off * off, (.5 + off) * (.5 + off) / 2.); }
// Three neighboring means of visibility, of 255.
vec3 means(int address) {
  int shift = 8 * (address & 3);
  uint word = texelFetch(pyramid, at(address >> 2), 0).r >> shift;
  if (shift > 8) word |= texelFetch(pyramid, at((address >> 2) + 1), 0).r << (32 - shift);
  return vec3(word & 255u, (word >> 8) & 255u, (word >> 16) & 255u);
}
// What is seen of a lobe, and the slopes of that by s and t: see jaxprt/systems/lobe/pyramid.py.
vec3 visibility(int face, float s, float t, float spread) {
  int number = 0;
  for (int i = 1; i < LEVELS - 1; i++) if (spread >= spreads[i]) number = i;
  float upper = LEVELS == 1 ? 0. : clamp((spread - spreads[number]) / (spreads[number + 1] - spreads[number]), 0., 1.);
  vec3 result = vec3(0);
  for (int step = 0; step < min(2, LEVELS); step++) {
    int edge = edges[number + step];
    float middle = float(edge) / 2., part = step == 0 ? 1. - upper : upper;
    vec2 place = (vec2(s, t) + 1.) * middle;
    ivec2 center = clamp(ivec2(place), 0, edge - 1) + 1;
    vec2 off = place + .5 - vec2(center);
    int base = pyramidStart + starts[number + step] + (face * (edge + 2) + center.y - 1) * (edge + 2) + center.x - 1;
    vec3 top = vec3(0), middleRow = vec3(0), low = vec3(0);
    for (int k = 0; k < CORNERS; k++) {
      int address = base + corner[k] * STRIDE;
      top += share[k] * means(address);
      middleRow += share[k] * means(address + edge + 2);
      low += share[k] * means(address + 2 * edge + 4);
    }
    mat3 columns = transpose(mat3(top, middleRow, low)) / 255.;
    vec3 down = spline(off.y), byDown = vec3(off.y - .5, -2. * off.y, off.y + .5);
    vec3 right = spline(off.x), byRight = vec3(off.x - .5, -2. * off.x, off.x + .5);
    for (int j = 0; j < 3; j++) {
      vec3 column = columns[j], parts = column * byDown;
      float total = dot(column, down), slope = parts.x + parts.y + parts.z;
      float outside = (center.y == 1 ? parts.x : 0.) + (center.y == edge ? parts.z : 0.);
      float across = total - ((j == 0 && center.x == 1) || (j == 2 && center.x == edge) ? slope * t / 2. : 0.);
      result += part * vec3(total * right[j], middle * across * byRight[j], middle * (slope * right[j] - outside * byRight[j] * s / 2.));
    }
  }
  return result;
}
vec3 radiance(vec3 d, float spread) {
  d = vec3(turn.x * d.x - turn.y * d.z, d.y, turn.y * d.x + turn.x * d.z);
  int face, number = finest;
  float s, t;
  project(d, face, s, t);
  for (int i = 1; i < WIDTHS - 1; i++) if (i > finest && spread >= lightSpreads[i]) number = i;
  float upper = clamp((spread - lightSpreads[number]) / (lightSpreads[number + 1] - lightSpreads[number]), 0., 1.);
  vec3 result = vec3(0);
  for (int step = 0; step < 2; step++) {
    int edge = lightEdges[number + step];
    vec2 part;
    ivec2 low = lowest(edge, s, t, part);
    int base = lightStarts[number + step] + (face * (edge + 2) + low.y) * (edge + 2) + low.x;
    vec3 a = texelFetch(light, at(base), 0).rgb, b = texelFetch(light, at(base + 1), 0).rgb;
    vec3 c = texelFetch(light, at(base + edge + 2), 0).rgb, d4 = texelFetch(light, at(base + edge + 3), 0).rgb;
    result += (step == 0 ? 1. - upper : upper) * mix(mix(a, b, part.x), mix(c, d4, part.x), part.y);
  }
  return result;
}
float remaining(float off) { return (1. + 1. / (1. + off * (2. + .42 * off))) / 2.; } // of the variance of a lobe that is seen in part
// The light of a lobe, about the mean of what is seen of it: see jaxprt/systems/lobe/system.py.
vec3 seen(vec3 d, float concentration) {
  float spread = drop(concentration);
#if SHADOWS
  int face;
  float s, t;
  project(d, face, s, t);
  vec3 v = visibility(face, s, t, max(spread, spreads[0]));
  float variance = (1. + s * s + t * t) / (concentration * (1. - spread));
  float alongS = variance * (v.y * (1. + s * s) + v.z * s * t), alongT = variance * (v.z * (1. + t * t) + v.y * s * t);
  float part = max(v.x, 1e-3), off = sqrt((alongS * v.y + alongT * v.z) / (part * part) + 1e-12);
  float reach = 1. / (part * max(off / 2.5, 1.)), inward = reach * (s * alongS + t * alongT) / (1. + s * s + t * t);
  vec3 moved = unproject(face, s + alongS * reach, t + alongT * reach) - inward * unproject(face, s, t);
  return v.x * radiance(moved, spread * remaining(min(off, 2.5)));
#else
  // Without visibility the horizon alone cuts lobes: a normal distribution whose tail is below it.
  float deviation = sqrt(spread), height = dot(d, normal), above = height / deviation, v = 1. / (1. + exp(-1.702 * above));
  float off = min(.3989 * exp(-above * above / 2.) / max(v, 1e-3), 2.5);
  return v * radiance(d + deviation * off * (normal - height * d), spread * remaining(off));
#endif
}
// How much of a bright texel is seen.
float clear(int i) {
#if SHADOWS
  float result = 0.;
  for (int k = 0; k < CORNERS; k++) {
    uint word = texelFetch(sight, at((first + corner[k]) * SIGHTS + i / 16), 0)[(i / 4) & 3];
    result += share[k] * float((word >> (8 * (i & 3))) & 255u) / 255.;
  }
  return result;
#else
  return 1.;
#endif
}
// Irradiance / pi.
vec3 diffuseLight() {
#if SHADOWS
  vec3 result = vec3(0);
  for (int k = 0; k < CORNERS; k++) result += share[k] * uintBitsToFloat(texelFetch(arriving, at(first + corner[k]), 0).rgb);
  if (lobes == 0 || normal == smooth_) return result; // without lobes no blurred light is there
  return result * min(radiance(normal, .55) / max(radiance(smooth_, .55), vec3(1e-6)), vec3(4)); // see CoarseLobes.combine in jaxprt/systems/lobe/system.py
#else
  return radiance(normal, 1. / 3.); // of a cosine 1 - cos is a third on average
#endif
}
vec4 weightAt(int which) { // of a channel, with the logarithm of roughness, or emission
  if (weightStep == 0) return texelFetch(weights, at(weightStart + which), 0);
  vec4 result = vec4(0);
  for (int k = 0; k < CORNERS; k++) result += share[k] * texelFetch(weights, at(weightStart + corner[k] * weightStep + which), 0);
  return result;
}
// Terms of MetallicRoughness, the lobe of BlinnPhong as the fifth, and those of CookTorrance with an F0 of 1 and of
// 0, in 1/sr: see jaxprt/brdf/microfacet.py and models.py.
vec4 family(vec3 wi, vec3 wo, vec3 normal, float rough) {
  vec3 h = normalize(wi + wo);
  float ci = dot(wi, normal), co = dot(wo, normal), z = dot(h, normal), schlick = pow(1. - min(dot(wo, h), 1.), 5.);
  vec3 aside = h - normal * z;
  float off = dot(aside, aside), lobe = 0.;
  if (term[0] == 3 && families > 1 && term[1] == 4) { // by the exponent
    float n = 2. * exp(-2. * rough) - 2.;
    lobe = (n + 2.) * (n + 4.) / (25.1327412 * (exp2(-n / 2.) + n)) * exp(n / 2. * log(max(1. - off, 1e-30)));
  } else if (term[0] == 3 && families > 1) { // by the slope
    float m = max(exp(rough), 1e-3), cd = max(dot(wo, h), 1e-6), groove = min(1. / (ci * co), 2. * z / (cd * max(ci, co)));
    lobe = exp(-off / (z * z * m * m)) / (9.8696044 * m * m * z * z * z * z) * groove;
  } else {
    float alpha = max(exp(2. * rough), 1e-3), a = alpha * alpha, tilt = off / a + z * z;
    lobe = .5 / (co * sqrt(a * (1. - ci * ci) + ci * ci) + ci * sqrt(a * (1. - co * co) + co * co)) / (3.14159265 * a * tilt * tilt);
  }
  vec4 result = vec4(0);
  for (int k = 0; k < 4; k++) if (k < families) result[k] = scale[k] * (term[k] == 0 ? (1. - schlick) / 3.14159265 : term[k] == 3 ? 1. / 3.14159265 : term[k] == 2 || term[k] == 6 ? lobe * schlick : lobe);
  return result;
}
// Log roughness with which the middle of a texel reflects as its square does on average.
float widened(float rough) {
  float power = term[0] == 3 && families > 1 ? 2. : 4., square = 4. * 3.14159265 / (6. * float(TEXELS * TEXELS));
  return log(exp(power * rough) + square / 24.) / power; // see WidenedFamily in jaxprt/view/reduced.py
}
vec4 entry(int number, int node, int which) { // a table's entries: for each lobe its mean and log concentration, and its weights
  return texelFetch(table, at(tableStart + (number * nodes + node) * entries + which), 0);
}
float factor(int l, int m) { return sqrt(float(4 * l * l - 1) / float(l * l - m * m)); }
// The light that has come through a transfer matrix times the BRDF: see plane_table in jaxprt/view/reduced.py.
vec3 transferred(vec3 ahead, ivec2 number, float between, int node, float upper, vec3 w[4]) {
  vec3 lit[HARMONICS], tint[BANDS], result = vec3(0);
  int pairs = (bands * bands + 1) / 2;
  for (int i = 0; i < pairs; i++) {
    lit[2 * i] = lit[2 * i + 1] = vec3(0);
    for (int k = 0; k < CORNERS; k++) {
      uvec4 each = texelFetch(arrived, at(arrivedStart + corner[k] * pairs + i), 0);
      vec2 middle = unpackHalf2x16(each.y);
      lit[2 * i] += share[k] * vec3(unpackHalf2x16(each.x), middle.x);
      lit[2 * i + 1] += share[k] * vec3(middle.y, unpackHalf2x16(each.z));
    }
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
// Both sets of texture coordinates, and their change from pixel to pixel.
vec4 coordinate = vec4(0), toRight = vec4(0), toTop = vec4(0);
#if CORNERS == 3
bool coordinateOf(ivec2 pixel, out vec4 result) {
  uvec4 triangle = texelFetch(shown, pixel, 0);
  result = vec4(0);
  int vertex = int(triangle.x & 0xffffffu);
  if (vertex < first || vertex >= first + count) return false;
  vec2 part = unpackUnorm2x16(triangle.w);
  result = part.x * texelFetch(coordinates, at(vertex), 0) + part.y * texelFetch(coordinates, at(int(triangle.y)), 0) + (1. - part.x - part.y) * texelFetch(coordinates, at(int(triangle.z)), 0);
  return true;
}
vec4 change(ivec2 step) { // the smaller one to both sides, as the other may cross a seam
  vec4 after, before;
  bool a = coordinateOf(ivec2(gl_FragCoord.xy) + step, after), b = coordinateOf(ivec2(gl_FragCoord.xy) - step, before);
  after -= coordinate;
  before = coordinate - before;
  return a && b ? (dot(after, after) < dot(before, before) ? after : before) : a ? after : b ? before : vec4(0);
}
#endif
vec2 placed(vec4 both, int which, float one) {
  vec3 place = vec3(sets[which] > 0 ? both.zw : both.xy, one);
  return vec2(dot(across[which], place), one - dot(upward[which], place)); // images have their first row on top
}
vec4 read(sampler2D image, int which) {
  vec2 place = placed(coordinate, which, 1.);
  return CORNERS == 1 ? textureLod(image, place, 0.) : textureGrad(image, place, placed(toRight, which, 0.), placed(toTop, which, 0.));
}
vec4 tangentAt(int vertex) { // of the texture's coordinates, with their handedness
  float both = texelFetch(place, at(2 * vertex), 0).w;
  int code = int(abs(both)) - 1;
  return vec4(code % 255 - 127, code / 255 % 255 - 127, code / 65025 - 127, sign(both));
}
// The normal that a map has in the frame of the surface, and log roughness, wider by how far the normals of a pixel
// are apart: see jaxprt/scene/texture.py.
void tilt(inout float rough) {
  vec4 tangent = vec4(0);
  for (int k = 0; k < CORNERS; k++) tangent += share[k] * tangentAt(first + corner[k]);
  vec3 along = tangent.xyz - normal * dot(tangent.xyz, normal), mean = read(normalImage, 4).xyz;
  if (dot(along, along) < 1e-6) return;
  along = normalize(along);
  vec2 side = mean.xy * slope;
  if (tangent.w < 0.) side.y = -side.y;
  float off = length(side), height = max(mean.z, .1 * off);
  if (off < 1e-3 && height < 1e-3) height = 1.;
  normal = normalize(along * side.x + cross(normal, along) * side.y + normal * height);
#if CORNERS == 3
  vec2 size = vec2(textureSize(normalImage, 0)), x = placed(toRight, 4, 0.) * size, y = placed(toTop, 4, 0.) * size;
  float square = clamp(dot(mean, mean), 1e-4, 1.), texels = min(.41 * max(dot(x, x), dot(y, y)), 1.); // by the square of SHARPER in jaxprt/scene/material_table.py
  float variance = (1. - square) / (sqrt(square) * (3. - square)) * slope * slope * texels;
  rough = min(log(exp(4. * rough) + 2. * variance) / 4., max(rough, 0.));
#endif
}
vec3 shade() {
  smooth_ = normal;
  vec4 leading = weightAt(0);
  vec3 w[4], color = weightAt(channels).rgb;
  for (int k = 0; k < 4; k++) w[k] = k < channels ? (k == 0 ? leading.rgb : weightAt(k).rgb) : vec3(0);
  vec4 diffuse = vec4(1);
  vec3 wo = normal;
  float rough = weightStep > 0 ? leading.a : logRoughness;
  if (sampled > 0) { // weights as MetallicRoughness.coefficient has them
    for (int k = 0; k < CORNERS; k++) coordinate += share[k] * texelFetch(coordinates, at(first + corner[k]), 0);
#if CORNERS == 3
    toRight = change(ivec2(1, 0));
    toTop = change(ivec2(0, 1));
#endif
    vec3 base = (sampled & 1) > 0 ? baseColor * read(base_colorImage, 0).rgb : baseColor;
    float metal = (sampled & 4) > 0 ? factors.y * read(metallicImage, 2).r : factors.y, dielectric = 1. - metal, layer = dielectric * factors.x;
    rough = log(max((sampled & 2) > 0 ? factors.z * read(roughnessImage, 1).r : factors.z, .0316227766));
    if ((sampled & 8) > 0) color = emissive * read(emissiveImage, 3).rgb;
    if ((sampled & 16) > 0) tilt(rough);
    for (int k = 0; k < 4; k++) if (k < channels) w[k] = (term[k] == 0 ? factors.w * layer * base * (1. - max(f0.r, max(f0.g, f0.b))) : term[k] == 1 ? layer * f0 + metal * base : term[k] == 2 ? layer * (1. - f0) + metal * (1. - base) : factors.w * dielectric * (1. - factors.x) * base) / scale[k];
  }
  if (lobes > 0 || bands > 0) {
    wo = normalize(eye - position);
    vec3 flat_ = wo - normal * dot(wo, normal);
    float up = dot(wo, normal);
    vec3 ahead = dot(flat_, flat_) > 1e-12 ? normalize(flat_) : normalize(cross(normal, abs(normal.x) < .6 ? vec3(1, 0, 0) : vec3(0, 1, 0)));
    up = max(up, .01); // as views are raised above the horizon
    wo = ahead * sqrt(max(1. - up * up, 0.)) + normal * up;
    vec3 aside = cross(normal, ahead);
    float node = clamp(sqrt(max(1. - up * up, 0.)) / (1. + up) * steps, 0., float(nodes - 1));
    int low = min(int(node), nodes - 2), knotLow = 0;
    float upper = node - float(low), between = 0.;
    if (knots > 1) {
      for (int i = 1; i < KNOTS; i++) if (i < knots - 1 && rough >= knot[i]) knotLow = i;
      between = clamp((rough - knot[knotLow]) / (knot[knotLow + 1] - knot[knotLow]), 0., 1.);
    }
    int knotHigh = knots > 1 ? knotLow + 1 : knotLow;
    if (bands > 0) color += transferred(ahead, ivec2(knotLow, knotHigh), between, low, upper, w);
    for (int l = 0; lobes > 0 && l <= lobes; l++) {
      vec4 lobe = vec4(0), strength = vec4(0);
      for (int n = 0; n < 2; n++) {
        float part = n == 0 ? 1. - upper : upper;
        if (l == lobes) {
          strength += part * mix(entry(knotLow, low + n, 2 * lobes), entry(knotHigh, low + n, 2 * lobes), between);
          continue;
        }
        vec4 a = entry(knotLow, low + n, 2 * l), b = entry(knotHigh, low + n, 2 * l);
        vec4 p = entry(knotLow, low + n, 2 * l + 1), q = entry(knotHigh, low + n, 2 * l + 1);
        float less = max((1. - between) * dot(p, vec4(1)), 0.) + 1e-12, more = max(between * dot(q, vec4(1)), 0.) + 1e-12;
        lobe += part * mix(a, b, more / (less + more));
        strength += part * mix(p, q, between);
      }
      if (l == lobes) { diffuse = strength; break; }
      vec3 local = normalize(lobe.xyz);
      vec3 tint = strength.x * w[0] + strength.y * w[1] + strength.z * w[2] + strength.w * w[3];
      vec3 middle = ahead * local.x + aside * local.y + normal * local.z;
      float k = exp(lobe.w);
      color += tint * seen(middle, k);
      if (families > 0) continue;
      for (int i = 0; i < texels; i++) {
        vec3 d = texelDirection(i), away = d - middle;
        float value = dot(d, normal) > 0. ? k / (6.28318531 * (1. - exp(-2. * k))) * exp(-k * dot(away, away) / 2.) : 0.;
        if (value > 1e-6) color += tint * value * clear(i) * texelFetch(bright, at(2 * i + 1), 0).rgb;
      }
    }
  }
  float wide = widened(rough);
  for (int i = 0; i < texels; i++) {
    vec3 d = texelDirection(i);
    float cosine = dot(d, normal);
    if (cosine <= 0.) continue;
    vec4 value = families > 0 ? family(d, wo, normal, wide) : diffuse / 3.14159265;
    color += (value.x * w[0] + value.y * w[1] + value.z * w[2] + value.w * w[3]) * cosine * clear(i) * texelFetch(bright, at(2 * i + 1), 0).rgb;
  }
  color += diffuseLight() * (diffuse.x * w[0] + diffuse.y * w[1] + diffuse.z * w[2] + diffuse.w * w[3]);
  return clamp(color, -65504., 65504.);
}
vec3 normalAt(int vertex) { return texelFetch(place, at(2 * vertex + 1), 0).xyz; }
#if CORNERS == 1
out uvec4 o;
void main() {
  int id = int(gl_FragCoord.x) + ${WIDTH} * int(gl_FragCoord.y);
  corner[0] = id - first;
  if (corner[0] < 0 || corner[0] >= count) discard;
  share[0] = 1.;
  position = texelFetch(place, at(2 * id), 0).xyz;
  normal = normalAt(id);
  vec3 color = shade();
  o = uvec4(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0)), 0, 0);
}
#else
out vec4 o;
void main() { // of a texture with the vertices of the triangle at each pixel, its opacity, and two barycentric coordinates
  uvec4 triangle = texelFetch(shown, ivec2(gl_FragCoord.xy), 0);
  corner[0] = int(triangle.x & 0xffffffu) - first;
  if (corner[0] < 0 || corner[0] >= count) discard;
  corner[1] = int(triangle.y) - first;
  corner[2] = int(triangle.z) - first;
  vec2 part = unpackUnorm2x16(triangle.w);
  share[0] = part.x;
  share[1] = part.y;
  share[2] = max(1. - part.x - part.y, 0.);
  position = normal = vec3(0);
  for (int k = 0; k < 3; k++) {
    position += share[k] * texelFetch(place, at(2 * (first + corner[k])), 0).xyz;
    normal += share[k] * normalAt(first + corner[k]);
  }
  normal = dot(normal, normal) > 1e-12 ? normalize(normal) : normalAt(first + corner[0]);
  float opacity = float(triangle.x >> 24) / 255.;
  o = vec4((glass ? 1. : opacity) * shade(), opacity);
}
#endif`;
// The irradiance of vertices / pi, by transfer vectors, and what bounces and lamps add: made once for a light.
export const ARRIVE = `#version 300 es
precision highp float; precision highp int; precision highp isampler2D;
uniform isampler2D vectors, reflected; uniform vec3 irradiance[TERMS], reflectedLight[REFLECTIONS + 1]; uniform int first, count, terms;
out uvec4 o;
${AT}
void main() {
  int id = int(gl_FragCoord.x) + ${WIDTH} * int(gl_FragCoord.y);
  if (id < first || id >= first + count) discard;
  vec3 result = vec3(0);
  for (int i = 0; i < TERMS; i += 4) {
    if (i >= terms) break;
    vec4 each = vec4(texelFetch(vectors, at(id * (TERMS / 4) + i / 4), 0));
    result += irradiance[i] * each.x + irradiance[i + 1] * each.y + irradiance[i + 2] * each.z + irradiance[i + 3] * each.w;
  }
  for (int i = 0; i < REFLECTIONS; i++) result += reflectedLight[i] * vec3(texelFetch(reflected, at(id * REFLECTIONS + i), 0).rgb);
  o = uvec4(floatBitsToUint(result), 0u);
}`;
// What vertices see of the brightest texels, sixteen at a time as bytes: bits, bilinear between the middles of texels.
export const SIGHT = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform usampler2D bits; uniform int first, count, texels, bitStart;
out uvec4 o;
${AT} ${CUBE} ${BRIGHT}
float bit(int vertex, int face, int row, int column) {
  row = clamp(row, 0, TEXELS - 1);
  column = clamp(column, 0, TEXELS - 1);
  int address = bitStart + ((face * (TEXELS / 2) + row / 2) * (TEXELS / 4) + column / 4) * count + vertex;
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
void main() {
  int i = int(gl_FragCoord.x) + ${WIDTH} * int(gl_FragCoord.y), id = i / SIGHTS, from = 16 * (i - id * SIGHTS);
  if (id < first || id >= first + count) discard;
  uvec4 bytes = uvec4(0);
  for (int k = 0; k < 16; k++) if (from + k < texels) bytes[k / 4] |= uint(255. * clear(id - first, texelDirection(from + k)) + .5) << (8 * (k & 3));
  o = bytes;
}`;
// Texels that are finer than those of the light, from its picture. What was taken out of a texel is missing in its finer
// ones in the same share.
export const FINER = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D sky, share; uniform float scale, level; uniform int edge, start, coarse;
out vec4 o;
${AT} ${CUBE}
void main() {
  int m = edge + 2, i = int(gl_FragCoord.x) + ${WIDTH} * int(gl_FragCoord.y) - start;
  if (i < 0 || i >= 6 * m * m) discard;
  vec2 part = (vec2(i % m, i / m % m) - .5) / float(edge), place = 2. * part - 1.;
  vec3 d = normalize(unproject(i / (m * m), place.x, place.y));
  ivec2 texel = clamp(ivec2(part * float(coarse)), 0, coarse - 1);
  float left = texelFetch(share, at((i / (m * m) * coarse + texel.y) * coarse + texel.x), 0).r;
  vec3 color = textureLod(sky, vec2(.5 - atan(d.x, d.z) / 6.28318531, acos(clamp(d.y, -1., 1.)) / 3.14159265), level).rgb;
  o = vec4(left * scale * color, 0);
}`;
// The harmonics of the light that arrives at a vertex, two at a time: those of its visibility times the light's table.
export const GATHER = `#version 300 es
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
export const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0, 1); }`;
