import { describe, expect, test } from 'vitest';

import { addressOf, read, written, type Address } from '../../src/link';
import { pose } from '../../src/camera';
import { length, subtract } from '../../src/vector';

const FULL: Address = {
  dataset: 'teapot.v2_a-b',
  version: 3,
  viewpoint: { target: [0.1, -2.5e-7, 1234.5678], distance: 3.3333333333, azimuth: -3.1, elevation: 1.5, fieldOfView: 0.7 },
  settings: {
    ...addressOf('x').settings,
    component: 'glossy',
    blend: 'reflection',
    exponent: 16,
    brdf: '{"model": "lambert", "albedo": [0.8, 0, 1]} &=#%',
    exposureStops: -1.5,
  },
  delivery: { encoding: 'png', atRest: 'png', quality: 55, scale: 0.5, rate: 15, warp: 'depth' },
  split: 'wipe',
  other: { ...addressOf('x').other, source: 'truth', truthPasses: 9, component: 'mirror', specularRed: 0.25, overlay: 'samples' },
};

describe('a link', () => {
  test('that is written and read says the same', () => {
    const back = read(written(FULL));
    const { viewpoint, ...rest } = FULL;
    const { viewpoint: backViewpoint, ...backRest } = back!;
    expect(backRest).toEqual(rest);
    // Nine digits: a hundredth of what f32, the wire's numbers, can tell apart.
    const [a, b] = [pose(viewpoint!), pose(backViewpoint!)];
    expect(length(subtract(a.position, b.position)) / length(a.position)).toBeLessThan(1e-8);
    for (const axis of ['right', 'up', 'backward'] as const) expect(length(subtract(a[axis], b[axis]))).toBeLessThan(1e-8);
    expect(written(back!)).toBe(written(FULL));
  });

  test.each(['side', 'wipe', 'error'] as const)('keeps how two pictures are compared: %s', (split) => {
    expect(read(written({ ...FULL, split }))?.split).toBe(split);
  });

  test('of the defaults is short', () => {
    expect(written(addressOf('teapot'))).toBe('#d=teapot');
    expect(read('#d=teapot')).toEqual(addressOf('teapot'));
  });

  test('of nothing is the list', () => {
    expect(read('')).toBeUndefined();
    expect(read('#')).toBeUndefined();
  });

  test.each([
    ['#v=1', 'no dataset'],
    ['#d=a&v=1.5', 'v=1.5'],
    ['#d=a&v=-1', 'v=-1'],
    ['#d=a&component=shiny', 'component=shiny'],
    ['#d=a&exponent=NaN', 'exponent=NaN'],
    ['#d=a&exponent=', 'exponent='],
    ['#d=a&directions=1.5', 'directions=1.5'],
    ['#d=a&quality=55.5', 'quality=55.5'],
    ['#d=a&exponent=1e9', 'exponent=1e9'],
    ['#d=a&split=diagonal', 'split=diagonal'],
    ['#d=a&split=side&b.blend=nearest', 'b.blend=nearest'],
    ['#d=a&source=wish', 'source=wish'],
    ['#d=a&truthPasses=0', 'truthPasses=0'],
    ['#d=a&az=0&el=0&r=1&fov=40', 'at='],
    ['#d=a&at=0,0&az=0&el=0&r=1&fov=40', 'three numbers'],
    ['#d=a&at=0,0,Infinity&az=0&el=0&r=1&fov=40', 'at=Infinity'],
    ['#d=a&at=0,0,0&az=0&el=0&r=0&fov=40', 'r=0'],
    ['#d=a&at=0,0,0&az=0&el=91&r=1&fov=40', 'el=91'],
    ['#d=a&at=0,0,0&az=0&el=0&r=1&fov=500', 'fov=500'],
    ['#d=a&at=0,0,0&az=0&el=0&r=1', 'lacks fov'],
  ])('%s is an error that names the word', (hash, named) => {
    expect(() => read(hash)).toThrow(named);
  });
});
