// Spherical harmonics of lights, for transfer matrices.

// Real spherical harmonics of a unit direction, orthonormal, z the polar axis, in the order l (l + 1) + m.
export function harmonics(x, y, z, degree, result) {
  let real = 1;
  let imaginary = 0;
  let diagonal = Math.sqrt(1 / (4 * Math.PI));
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
  const band = Array.from({ length: degree + 1 }, (_, l) => l);
  const weight = band.map((l) => (l * (l + 1)) ** 2);
  const spectrum = band.map(() => 0);
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
export function gauss(count) {
  return Array.from({ length: count }, (_, i) => {
    let x = Math.cos((Math.PI * (i + 0.75)) / (count + 0.5));
    let slope = 1;
    for (let step = 0; step < 20; step++) {
      let value = 1;
      let before = 0;
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
    const around = 4 * degree + 1;
    const nodes = [];
    for (const { height, weight } of gauss(2 * degree + 1))
      for (let i = 0; i < around; i++) {
        const angle = (2 * Math.PI * i) / around;
        const ring = Math.sqrt(1 - height * height);
        const value = new Float64Array((2 * degree + 1) ** 2);
        harmonics(ring * Math.cos(angle), ring * Math.sin(angle), height, 2 * degree, value);
        nodes.push({ value, weight: (weight * 2 * Math.PI) / around });
      }
    rules.set(degree, nodes);
  }
  return rules.get(degree);
}
// For each harmonic that arrives and each of the visibility the integral of both times the light, times the
// visibility's unit.
export function gathered(light, { bands, words, laplacian }, unit) {
  const degree = bands - 1;
  const window = leastLaplacian(light, degree, laplacian);
  const terms = bands ** 2;
  const result = new Float64Array(16 * terms * words);
  const shown = [0, 0, 0];
  for (const { value, weight } of rule(degree)) {
    shown.fill(0);
    for (let l = 0; l < bands; l++)
      for (let i = l * l; i < (l + 1) ** 2; i++)
        for (let c = 0; c < 3; c++) shown[c] += weight * window[l] * value[i] * light[3 * i + c];
    for (let i = 0; i < terms; i++)
      for (let k = 0; k < value.length; k++) {
        const each = value[i] * value[k] * unit[k];
        const to = 4 * (4 * i * words + k);
        for (let c = 0; c < 3; c++) result[to + c] += each * shown[c];
      }
  }
  return Float32Array.from(result);
}
