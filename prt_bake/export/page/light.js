// Light as coefficients of real spherical harmonics: orthonormal, index l(l+1)+m, no Condon-Shortley phase.
// Skies and suns are in the polar frame (z up, azimuth from x to y); `turned` brings them into object space.
const NUMBERS = { mul: (a, b) => a * b, add: (a, b) => a + b };
const GAUSS = [[-0.9061798459386640, 0.2369268850561891], [-0.5384693101056831, 0.4786286704993665], [0, 0.5688888888888889],
  [0.5384693101056831, 0.4786286704993665], [0.9061798459386640, 0.2369268850561891]]; // nodes and weights on [-1, 1]

/** The (degree + 1)² harmonics in a unit direction, of numbers or, with its `mul` and `add`, of nodes of a shader. */
export function harmonics(degree, [x, y, z], { mul, add } = NUMBERS) {
  const values = [];
  let cosine = 1, sine = 0, sectoral = Math.sqrt(1 / (4 * Math.PI));
  for (let m = 0; m <= degree; m++) {
    for (let l = m, below = 0, here = sectoral; l <= degree; l++) {
      const scaled = mul(here, m ? Math.SQRT2 : 1);
      values[l * (l + 1) + m] = mul(cosine, scaled);
      if (m) values[l * (l + 1) - m] = mul(sine, scaled);
      const a = Math.sqrt((4 * (l + 1) ** 2 - 1) / ((l + 1) ** 2 - m * m)), b = Math.sqrt((l * l - m * m) / (4 * l * l - 1 || 1));
      [below, here] = [here, add(mul(mul(z, here), a), mul(below, -a * b))];
    }
    [cosine, sine] = [add(mul(cosine, x), mul(mul(sine, y), -1)), add(mul(cosine, y), mul(sine, x))];
    sectoral *= Math.sqrt((2 * m + 3) / (2 * m + 2));
  }
  return values;
}

/** A light of the polar frame [K·3], turned by `degrees` about up, counter-clockwise from above, in object space. */
export function turned(polar, up, degrees) {
  const degree = Math.sqrt(polar.length / 3) - 1, around = 2 * degree + 1, light = new Float64Array(polar.length);
  const c = Math.cos((degrees * Math.PI) / 180), s = Math.sin((degrees * Math.PI) / 180), strips = degree > 4 ? 2 * degree : 1;
  for (let i = 0; i < 5 * strips * around; i++) {
    const [node, weight] = GAUSS[i % 5], strip = Math.floor(i / 5) % strips, phi = (2 * Math.PI * Math.floor(i / 5 / strips)) / around;
    const z = (2 * strip + 1 + node) / strips - 1, x = Math.sqrt(1 - z * z) * Math.cos(phi), y = Math.sqrt(1 - z * z) * Math.sin(phi);
    const [a, b] = [c * x + s * y, c * y - s * x], from = harmonics(degree, [x, y, z]);
    const to = harmonics(degree, up === "y" ? [a, z, b] : [a, -b, z]), size = (2 * Math.PI * weight) / strips / around;
    for (let channel = 0; channel < 3; channel++) {
      const radiance = from.reduce((sum, value, k) => sum + value * polar[3 * k + channel], 0);
      to.forEach((value, k) => (light[3 * k + channel] += size * radiance * value));
    }
  }
  return light;
}

/** A sun of irradiance π in a direction. */
export const sun = (degree, direction) => harmonics(degree, direction).flatMap((value) => Array(3).fill(Math.PI * value));

/** The light of a lat-long picture [height·width·3] in the polar frame, exact over each pixel. */
export function project(degree, { width, height, data }) {
  const light = new Float64Array(3 * (degree + 1) ** 2), step = (2 * Math.PI) / width;
  const waves = Array.from({ length: 2 * degree + 1 }, (_, i) => {
    const m = i - degree, wave = m < 0 ? Math.sin : Math.cos, size = m ? (2 * Math.sin((m * step) / 2)) / m : step;
    return Float64Array.from({ length: width }, (_, column) => size * wave(Math.abs(m) * ((column + 0.5) * step - Math.PI)));
  });
  for (let row = 0; row < height; row++) {
    const profile = new Float64Array((degree + 1) ** 2); // of the harmonics over the row's height
    for (const [node, weight] of GAUSS) {
      const theta = (Math.PI * (row + 0.5 + node / 2)) / height, size = (weight * Math.PI * Math.sin(theta)) / (2 * height);
      harmonics(degree, [Math.sin(theta), 0, Math.cos(theta)]).forEach((value, k) => (profile[k] += size * value));
    }
    waves.forEach((wave, i) => {
      const m = i - degree, sums = [0, 0, 0], first = 3 * width * row;
      for (let column = 0; column < width; column++) for (let c = 0; c < 3; c++) sums[c] += wave[column] * data[first + 3 * column + c];
      for (let l = Math.abs(m); l <= degree; l++) {
        sums.forEach((sum, c) => (light[3 * (l * (l + 1) + m) + c] += profile[l * (l + 1) + Math.abs(m)] * sum));
      }
    });
  }
  return light;
}
