/**
 * CIEDE2000: how different two shown colours look, 1 being about the smallest difference seen side by side. Twin of the server's
 * `radiometry::color_difference` (Sharma, Wu, Dalal 2005, equations 2–22, kL = kC = kH = 1); colours are sRGB codes, white is D65.
 */

/** L* 0–100, a*, b*. */
export type Lab = readonly [l: number, a: number, b: number];

type Row = readonly [number, number, number];

const DEGREE = Math.PI / 180;
const POW25_7 = 25 ** 7;
/** CIE 1931: above it the cube root, below it a line. */
const EPSILON = 216 / 24389;
const KAPPA = 24389 / 27;

/** Linear, of each 8-bit code (IEC 61966-2-1). */
const LINEAR = Float64Array.from({ length: 256 }, (_, code) => {
  const encoded = code / 255;
  return encoded <= 0.04045 ? encoded / 12.92 : ((encoded + 0.055) / 1.055) ** 2.4;
});

/** XYZ of linear Rec. 709 (CSS Color 4), each row divided by its sum, white: greys have no hue. */
const [X, Y, Z] = [
  [0.4123907992659595, 0.357584339383878, 0.1804807884018343],
  [0.21263900587151036, 0.715168678767756, 0.07219231536073371],
  [0.01933081871559185, 0.11919477979462599, 0.9505321522496606],
].map(([r, g, b]) => [r! / (r! + g! + b!), g! / (r! + g! + b!), b! / (r! + g! + b!)] as const) as [Row, Row, Row];

/** Of three sRGB codes, 0 to 255. */
export function labOf(red: number, green: number, blue: number): Lab {
  const [r, g, b] = [LINEAR[red]!, LINEAR[green]!, LINEAR[blue]!];
  const response = (row: Row): number => compressed(row[0] * r + row[1] * g + row[2] * b);
  const [x, y, z] = [response(X), response(Y), response(Z)];
  return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
}

function compressed(t: number): number {
  return t > EPSILON ? Math.cbrt(t) : (KAPPA * t + 16) / 116;
}

/** Symmetric, 0 for equal colours. */
export function difference2000([l1, a1, b1]: Lab, [l2, a2, b2]: Lab): number {
  // Equations 2–7: a* stretched near grey, then chroma and hue.
  const stretch = 1.5 - 0.5 * chromaSwitch((Math.hypot(a1, b1) + Math.hypot(a2, b2)) / 2);
  const [c1, h1] = polar(a1 * stretch, b1);
  const [c2, h2] = polar(a2 * stretch, b2);
  // Equations 8–14; a grey has no hue, and turns nothing.
  const isGrey = c1 * c2 === 0;
  const turn = isGrey ? 0 : h2 - h1 - (h2 - h1 > 180 ? 360 : h2 - h1 < -180 ? -360 : 0);
  const hueChord = 2 * Math.sqrt(c1 * c2) * Math.sin((turn * DEGREE) / 2);
  const [l, c] = [(l1 + l2) / 2, (c1 + c2) / 2];
  const h = isGrey || Math.abs(h1 - h2) <= 180 ? (h1 + h2) / (isGrey ? 1 : 2) : (h1 + h2 + (h1 + h2 < 360 ? 360 : -360)) / 2;
  // Equations 15–21.
  const cos = (degrees: number): number => Math.cos(degrees * DEGREE);
  const t = 1 - 0.17 * cos(h - 30) + 0.24 * cos(2 * h) + 0.32 * cos(3 * h + 6) - 0.2 * cos(4 * h - 63);
  const lightness = (l2 - l1) / (1 + (0.015 * (l - 50) ** 2) / Math.sqrt(20 + (l - 50) ** 2));
  const chroma = (c2 - c1) / (1 + 0.045 * c);
  const hue = hueChord / (1 + 0.015 * c * t);
  const blues = -Math.sin(60 * DEGREE * Math.exp(-(((h - 275) / 25) ** 2))) * 2 * chromaSwitch(c);
  // Equation 22.
  return Math.sqrt(Math.max(lightness ** 2 + chroma ** 2 + hue ** 2 + blues * chroma * hue, 0));
}

/** √(C⁷ / (C⁷ + 25⁷)): 0 near grey, 1 for vivid colours. */
function chromaSwitch(chroma: number): number {
  const c7 = chroma ** 7;
  return Math.sqrt(c7 / (c7 + POW25_7));
}

/** Chroma, and hue in degrees in [0, 360). */
function polar(a: number, b: number): readonly [chroma: number, hue: number] {
  const degrees = Math.atan2(b, a) / DEGREE;
  return [Math.hypot(a, b), degrees < 0 ? degrees + 360 : degrees];
}
