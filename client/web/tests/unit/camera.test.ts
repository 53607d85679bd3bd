import { describe, expect, test } from 'vitest';

import { defaultViewpoint, dolly, fly, focalLength, look, orbit, pan, pose, radius, type Viewpoint } from '../../src/camera';
import { add, cross, dot, length, scale, subtract, type Vector3 } from '../../src/vector';

/** Some hundred steps of f64 trigonometry. */
const TOLERANCE = 1e-12;

const START: Viewpoint = { target: [1, 2, -3], distance: 4, azimuth: 0.7, elevation: 0.3, fieldOfView: 0.7 };

/** Viewpoints all around, both poles included. */
function* viewpoints(): Generator<Viewpoint> {
  for (let a = -6; a <= 6; a++) {
    for (let e = -4; e <= 4; e++) yield { ...START, azimuth: (a * Math.PI) / 6, elevation: (e * Math.PI) / 8 };
  }
}

function expectNear(actual: Vector3, expected: Vector3, tolerance = TOLERANCE): void {
  expect(length(subtract(actual, expected))).toBeLessThan(tolerance);
}

function eye(view: Viewpoint): Vector3 {
  return pose(view).position;
}

/** Where a world point falls, pixels from the picture's centre, x to the right, y down. */
function projected(view: Viewpoint, point: Vector3, focal: number): [number, number] {
  const { position, right, up, backward } = pose(view);
  const p = subtract(point, position);
  const depth = -dot(p, backward);
  return [(focal * dot(p, right)) / depth, (-focal * dot(p, up)) / depth];
}

describe('a pose', () => {
  test('has orthonormal, right-handed axes everywhere, at the poles, too', () => {
    for (const view of viewpoints()) {
      const { right, up, backward } = pose(view);
      for (const axis of [right, up, backward]) expect(Math.abs(length(axis) - 1)).toBeLessThan(TOLERANCE);
      expectNear(cross(right, up), backward);
      expect(Math.abs(dot(right, up))).toBeLessThan(TOLERANCE);
    }
  });

  test('looks at the target and does not roll', () => {
    for (const view of viewpoints()) {
      const { position, backward, right } = pose(view);
      expectNear(subtract(position, scale(view.distance, backward)), view.target);
      expect(right[1]).toBe(0);
    }
  });

  test('begins at +Z and turns toward +X, as the command line’s orbit', () => {
    const box = { min: [-1, -1, -1], max: [1, 1, 1] } as const;
    const view = { ...defaultViewpoint(box), elevation: 0 };
    // 3.5 radii of a sphere of radius √3.
    expectNear(eye(view), [0, 0, 3.5 * Math.sqrt(3)]);
    expectNear(eye(orbit(view, Math.PI / 2, 0)), [3.5 * Math.sqrt(3), 0, 0]);
    expect(radius(box)).toBeCloseTo(Math.sqrt(3), 12);
  });
});

describe('moving', () => {
  test('in an orbit keeps the distance and the target', () => {
    let view = START;
    for (let i = 0; i < 500; i++) {
      view = orbit(view, 0.37, i % 7 === 0 ? -0.9 : 0.21);
      expect(length(subtract(eye(view), view.target))).toBeCloseTo(START.distance, 10);
      expect(view.target).toEqual(START.target);
    }
  });

  test('in an orbit stops at the poles instead of turning over', () => {
    const top = orbit(START, 0, 100);
    expect(top.elevation).toBe(Math.PI / 2);
    expect(orbit(top, 0, -100).elevation).toBe(-Math.PI / 2);
  });

  test('the head keeps the eye', () => {
    let view = START;
    for (let i = 0; i < 100; i++) view = look(view, 0.3, i % 2 ? 0.2 : -0.25);
    expectNear(eye(view), eye(START), 1e-10);
    expect(length(subtract(view.target, START.target))).toBeGreaterThan(1);
  });

  test('flying shifts along the camera’s own axes', () => {
    const { right, up, backward } = pose(START);
    expectNear(eye(fly(START, 1, 2, 3)), add(eye(START), add(add(right, scale(2, up)), scale(-3, backward))));
  });

  test('panning carries what is at the target’s distance by the pointer’s pixels', () => {
    const size = { width: 640, height: 480 };
    const [x, y] = projected(pan(START, 30, -12, size), START.target, focalLength(START, size));
    expect(x).toBeCloseTo(30, 9);
    expect(y).toBeCloseTo(-12, 9);
  });

  test('nearer and farther changes the distance alone, within bounds', () => {
    expect(dolly(START, 0.5, 1)).toEqual({ ...START, distance: 2 });
    for (const factor of [0, 1e-300, 1e300, Infinity]) {
      const { distance } = dolly(START, factor, 1);
      expect(distance).toBeGreaterThan(0);
      expect(distance).toBeLessThan(1e3);
    }
  });
});

test('the field of view spans the shorter side', () => {
  const right = { ...START, fieldOfView: Math.PI / 2 };
  // tan 45° = 1: the focal length is half the side.
  expect(focalLength(right, { width: 640, height: 480 })).toBeCloseTo(240, 9);
  expect(focalLength(right, { width: 400, height: 700 })).toBeCloseTo(200, 9);
});
