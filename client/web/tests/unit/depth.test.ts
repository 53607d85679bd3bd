import { describe, expect, it } from 'vitest';

import { distances } from '../../src/warp';

/** One zstd frame with these bytes in a block that is not compressed. */
function stored(bytes: Uint8Array): Uint8Array {
  const header = 1 | (bytes.length << 3);
  return Uint8Array.from([0x28, 0xb5, 0x2f, 0xfd, 0x20, bytes.length, header & 255, (header >> 8) & 255, header >> 16, ...bytes]);
}

function plane(codes: number[], width: number): Parameters<typeof distances>[0] {
  const depth = stored(Uint8Array.from(codes.flatMap((code) => [code & 255, code >> 8])));
  return { depth, depthWidthPx: width, depthHeightPx: codes.length / width, nearestDepth: 3 };
}

describe('depth', () => {
  it('is the nearest over a part of 65535, and infinite for none', () => {
    expect([...distances(plane([65535, 0, 13107, 1], 2))]).toEqual([3, Infinity, 15, 196605]);
  });
  it('of another size than the frame says is refused', () => {
    expect(() => distances({ ...plane([1, 2, 3], 3), depthWidthPx: 4 })).toThrow('depth of 6 bytes, 8 expected');
  });
});
