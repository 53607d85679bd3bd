import { expect, test } from 'vitest';

import { bytesText } from '../../src/graphs';
import { Meters, type Drawn } from '../../src/meters';
import { coloured, FILLED_COLOUR, UNKNOWN_COLOUR } from '../../src/provenance';

const frame = (atMillis: number): Drawn => ({ atMillis, bytes: 1000, latencyMillis: 20, hits: 3, lookUps: 4 });

test('the graphs count the last second, of each picture', () => {
  const meters = new Meters();
  for (let i = 0; i < 60; i++) meters.drawn(frame(i * 50));
  expect(meters.sample(2950, 1)).toBe(true);
  // Frames after 1950 ms, up to 2950 ms.
  expect(meters.rate.newest()).toBe(20);
  expect(meters.bytes.newest()).toBe(20_000);
  expect(meters.latency.newest()).toBe(20);
  expect(meters.hitRate.newest()).toBe(0.75);
  meters.sample(2950, 2);
  expect(meters.rate.newest()).toBe(10);
});

test('an idle view ends its sampling, after it has shown zero', () => {
  const meters = new Meters();
  meters.drawn(frame(0));
  expect(meters.sample(100, 1)).toBe(true);
  expect(meters.sample(1500, 1)).toBe(true);
  expect(meters.rate.newest()).toBe(0);
  expect(meters.sample(1750, 1)).toBe(false);
});

test('a graph holds so many values and no more', () => {
  const meters = new Meters();
  for (let i = 0; i < 10_000; i++) {
    meters.drawn(frame(i * 10));
    meters.sample(i * 10, 1);
  }
  expect(meters.rate.all()).toHaveLength(120);
});

test('bytes are told with their unit', () => {
  expect([0, 999, 1500, 23_456_000].map(bytesText)).toEqual(['0 B', '999 B', '1.5 kB', '23 MB']);
});

test('provenance is coloured by its state and sample', () => {
  const words = Uint32Array.from([0x3fffffff, 0x40000005, 0x80000005, 0xc0000000 + 0x3fffffff, 0x40000006]);
  const pixel = (rgba: Uint8ClampedArray, i: number): number[] => [...rgba.slice(4 * i, 4 * i + 4)];
  const state = coloured(words, 'state');
  expect(pixel(state, 0)[3]).toBe(0);
  expect(pixel(state, 1)[3]).toBe(0);
  expect(pixel(state, 2)).toEqual([...FILLED_COLOUR]);
  expect(pixel(state, 3)).toEqual([...UNKNOWN_COLOUR]);
  const samples = coloured(words, 'samples');
  expect(pixel(samples, 0)[3]).toBe(0);
  expect(pixel(samples, 1)).toEqual(pixel(samples, 2));
  expect(pixel(samples, 1)).not.toEqual(pixel(samples, 4));
});
