/**
 * CIEDE2000 once more, for the test of the viewer's: by vectors instead of angles, from the same paper. ΔH² is what is left of the chord of the
 * two (a′, b′) once ΔC is taken off, and the mean hue is that of the sum of their directions.
 */

type Vector = readonly [number, number];
type Colour = readonly [lightness: number, a: number, b: number];

/** Mean and 95th percentile over pixels of three sRGB codes each. */
export function apart(first: readonly number[], second: readonly number[]): { mean: number; percentile95: number } {
  const lab = (codes: readonly number[], i: number): Colour => colour(codes[i]! / 255, codes[i + 1]! / 255, codes[i + 2]! / 255);
  const all = Array.from({ length: first.length / 3 }, (_, i) => difference(lab(first, 3 * i), lab(second, 3 * i)));
  all.sort((a, b) => a - b);
  return { mean: all.reduce((sum, value) => sum + value, 0) / all.length, percentile95: all[Math.ceil(0.95 * all.length) - 1]! };
}

function colour(...encoded: [number, number, number]): Colour {
  const [r, g, b] = encoded.map((v) => (v > 0.04045 ? Math.pow((v + 0.055) / 1.055, 2.4) : v / 12.92)) as [number, number, number];
  // XYZ over D65's white, sRGB's own rounded matrix: good to four digits.
  const xyz = [
    (0.4124 * r + 0.3576 * g + 0.1805 * b) / 0.9505,
    0.2126 * r + 0.7152 * g + 0.0722 * b,
    (0.0193 * r + 0.1192 * g + 0.9505 * b) / 1.089,
  ];
  const [x, y, z] = xyz.map((t) => (t > 0.008856 ? Math.cbrt(t) : 7.787 * t + 16 / 116)) as [number, number, number];
  return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
}

function difference([l1, a1, b1]: Colour, [l2, a2, b2]: Colour): number {
  const size = ([a, b]: Vector): number => Math.sqrt(a * a + b * b);
  const vivid = (c: number): number => Math.sqrt(1 / (1 + Math.pow(25 / Math.max(c, 1e-9), 7)));
  const g = 0.5 * (1 - vivid((size([a1, b1]) + size([a2, b2])) / 2));
  const [p, q]: [Vector, Vector] = [
    [a1 * (1 + g), b1],
    [a2 * (1 + g), b2],
  ];
  const [c1, c2] = [size(p), size(q)];
  const dC = c2 - c1;
  const turned = Math.max((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 - dC * dC, 0);
  const dH = Math.sign(p[0] * q[1] - p[1] * q[0]) * Math.sqrt(turned);
  const unit = ([a, b]: Vector, c: number): Vector => (c === 0 ? [0, 0] : [a / c, b / c]);
  const [u, v] = [unit(p, c1), unit(q, c2)];
  const hue = Math.atan2(u[1] + v[1], u[0] + v[0]);
  const [L, C] = [(l1 + l2) / 2, (c1 + c2) / 2];
  const at = (multiple: number, degrees: number): number => Math.cos(multiple * hue + (degrees * Math.PI) / 180);
  const T = 1 - 0.17 * at(1, -30) + 0.24 * at(2, 0) + 0.32 * at(3, 6) - 0.2 * at(4, -63);
  const degrees = ((hue * 180) / Math.PI + 360) % 360;
  const R = -2 * vivid(C) * Math.sin(2 * ((30 * Math.PI) / 180) * Math.exp(-(((degrees - 275) / 25) ** 2)));
  const l = (l2 - l1) / (1 + (0.015 * (L - 50) ** 2) / Math.sqrt(20 + (L - 50) ** 2));
  const c = dC / (1 + 0.045 * C);
  const h = dH / (1 + 0.015 * C * T);
  return Math.sqrt(Math.max(l * l + c * c + h * h + R * c * h, 0));
}
