import { describe, expect, test } from 'vitest';

import { difference2000, labOf, type Lab } from '../../src/colour_difference';
import { differences, errorColour, RANGE, summary } from '../../src/error_map';

/** Sharma, Wu and Dalal 2005, table 1: two colours and their difference to four decimals, all 34 pairs. */
const SHARMA: readonly (readonly [Lab, Lab, number])[] = [
  [[50.0, 2.6772, -79.7751], [50.0, 0.0, -82.7485], 2.0425],
  [[50.0, 3.1571, -77.2803], [50.0, 0.0, -82.7485], 2.8615],
  [[50.0, 2.8361, -74.02], [50.0, 0.0, -82.7485], 3.4412],
  [[50.0, -1.3802, -84.2814], [50.0, 0.0, -82.7485], 1.0],
  [[50.0, -1.1848, -84.8006], [50.0, 0.0, -82.7485], 1.0],
  [[50.0, -0.9009, -85.5211], [50.0, 0.0, -82.7485], 1.0],
  [[50.0, 0.0, 0.0], [50.0, -1.0, 2.0], 2.3669],
  [[50.0, -1.0, 2.0], [50.0, 0.0, 0.0], 2.3669],
  [[50.0, 2.49, -0.001], [50.0, -2.49, 0.0009], 7.1792],
  [[50.0, 2.49, -0.001], [50.0, -2.49, 0.001], 7.1792],
  [[50.0, 2.49, -0.001], [50.0, -2.49, 0.0011], 7.2195],
  [[50.0, 2.49, -0.001], [50.0, -2.49, 0.0012], 7.2195],
  [[50.0, -0.001, 2.49], [50.0, 0.0009, -2.49], 4.8045],
  [[50.0, -0.001, 2.49], [50.0, 0.001, -2.49], 4.8045],
  [[50.0, -0.001, 2.49], [50.0, 0.0011, -2.49], 4.7461],
  [[50.0, 2.5, 0.0], [50.0, 0.0, -2.5], 4.3065],
  [[50.0, 2.5, 0.0], [73.0, 25.0, -18.0], 27.1492],
  [[50.0, 2.5, 0.0], [61.0, -5.0, 29.0], 22.8977],
  [[50.0, 2.5, 0.0], [56.0, -27.0, -3.0], 31.903],
  [[50.0, 2.5, 0.0], [58.0, 24.0, 15.0], 19.4535],
  [[50.0, 2.5, 0.0], [50.0, 3.1736, 0.5854], 1.0],
  [[50.0, 2.5, 0.0], [50.0, 3.2972, 0.0], 1.0],
  [[50.0, 2.5, 0.0], [50.0, 1.8634, 0.5757], 1.0],
  [[50.0, 2.5, 0.0], [50.0, 3.2592, 0.335], 1.0],
  [[60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387], 1.2644],
  [[63.0109, -31.0961, -5.8663], [62.8187, -29.7946, -4.0864], 1.263],
  [[61.2901, 3.7196, -5.3901], [61.4292, 2.248, -4.962], 1.8731],
  [[35.0831, -44.1164, 3.7933], [35.0232, -40.0716, 1.5901], 1.8645],
  [[22.7233, 20.0904, -46.694], [23.0331, 14.973, -42.5619], 2.0373],
  [[36.4612, 47.858, 18.3852], [36.2715, 50.5065, 21.2231], 1.4146],
  [[90.8027, -2.0831, 1.441], [91.1528, -1.6435, 0.0447], 1.4441],
  [[90.9257, -0.5406, -0.9208], [88.6381, -0.8985, -0.7239], 1.5381],
  [[6.7747, -0.2908, -2.4247], [5.8714, -0.0985, -2.2286], 0.6377],
  [[2.0776, 0.0795, -1.135], [0.9033, -0.0636, -0.5514], 0.9082],
];

describe('a colour difference', () => {
  test('is the published one for all published pairs, both ways', () => {
    for (const [first, second, expected] of SHARMA) {
      expect(Math.abs(difference2000(first, second) - expected)).toBeLessThan(0.5e-4 + 1e-9);
      expect(difference2000(second, first)).toBeCloseTo(difference2000(first, second), 12);
    }
  });

  test('is of codes as Lindbloom’s calculator has them in L*a*b*', () => {
    const near = (lab: Lab, expected: Lab): void => lab.forEach((value, i) => expect(Math.abs(value - expected[i]!)).toBeLessThan(0.02));
    near(labOf(255, 0, 0), [53.24, 80.09, 67.2]);
    near(labOf(0, 255, 0), [87.73, -86.18, 83.18]);
    near(labOf(0, 0, 255), [32.3, 79.19, -107.86]);
    near(labOf(255, 255, 255), [100, 0, 0]);
    near(labOf(119, 119, 119), [50.03, 0, 0]);
    near(labOf(0, 0, 0), [0, 0, 0]);
  });
});

describe('an error map', () => {
  const picture = (...pixels: [number, number, number][]): Uint8ClampedArray =>
    Uint8ClampedArray.from(pixels.flatMap((rgb) => [...rgb, 255]));
  const all = (a: Uint8ClampedArray, b: Uint8ClampedArray): Float32Array => {
    const work = differences(a, b);
    for (let step = work.next(); ; step = work.next()) if (step.done) return step.value;
  };

  test('has one difference a pixel, zero where codes are equal', () => {
    const a = picture([10, 20, 30], [255, 255, 255], [119, 119, 119]);
    const found = all(a, picture([10, 20, 30], [0, 0, 0], [119, 119, 120]));
    expect(found[0]).toBe(0);
    // From white to black is the whole range of lightness.
    expect(found[1]).toBeCloseTo(100, 3);
    expect(found[2]).toBeGreaterThan(0.1);
    expect(() => all(a, picture([0, 0, 0]))).toThrow('pictures of 12 and 4 bytes');
  });

  test('is summed up by its mean and what 95 % of the pixels do not exceed', () => {
    const oneToHundred = Float32Array.from({ length: 100 }, (_, i) => 100 - i);
    expect(summary(oneToHundred)).toEqual({ mean: 50.5, percentile95: 95 });
    expect(summary(new Float32Array(4))).toEqual({ mean: 0, percentile95: 0 });
  });

  test('is clear where nothing differs, and brighter the more does', () => {
    expect(errorColour(0)[3]).toBe(0);
    const brightness = [2, 4, 6, 8, RANGE].map((difference) => {
      const [r, g, b] = errorColour(difference);
      return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    });
    expect(brightness.every((value, i) => i === 0 || value > brightness[i - 1]!)).toBe(true);
    expect(errorColour(3 * RANGE)).toEqual(errorColour(RANGE));
    expect(errorColour(RANGE).slice(0, 3)).toEqual([240, 249, 33]);
  });
});
