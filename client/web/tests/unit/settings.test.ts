import { expect, test } from 'vitest';

import { decided, DEFAULT_DELIVERY } from '../../src/settings';

test('a long link decides for the warp where nobody did', () => {
  expect([0, 33, 34, 100].map((millis) => decided(DEFAULT_DELIVERY, millis).warp)).toEqual(['off', 'off', 'depth', 'depth']);
  for (const warp of ['off', 'depth']) {
    expect([0, 100].map((millis) => decided({ ...DEFAULT_DELIVERY, warp }, millis).warp)).toEqual([warp, warp]);
  }
});
