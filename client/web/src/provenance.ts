/** Where pixels come from, as colours: `Frame.provenance` (proto) unpacked. */
import { decompress } from 'fzstd';

/** What the overlay tells. */
export type Overlay = 'state' | 'samples';

/** Bits 31–30 of a pixel. */
const STATE_SHIFT = 30;
const STATE = { background: 0, hit: 1, filled: 2, unknown: 3 } as const;
const NO_SAMPLE = 0x3fffffff;

/** Red, green, blue, opacity; also told by the legend. */
export const FILLED_COLOUR = [255, 176, 0, 200] as const;
export const UNKNOWN_COLOUR = [220, 38, 127, 220] as const;
const CLEAR = [0, 0, 0, 0] as const;

/** One zstd frame of little-endian u32, rows from the top. Throws where the bytes are not that many pixels. */
export function unpacked(bytes: Uint8Array, pixels: number): Uint32Array {
  // The buffer bounds what a lying frame can unpack to.
  const raw = decompress(bytes, new Uint8Array(4 * pixels));
  if (raw.byteLength !== 4 * pixels) throw new RangeError(`provenance of ${raw.byteLength} bytes, ${4 * pixels} expected`);
  const view = new DataView(raw.buffer, raw.byteOffset, raw.byteLength);
  return Uint32Array.from({ length: pixels }, (_, i) => view.getUint32(4 * i, true));
}

/** RGBA, row by row. */
export function coloured(provenance: Uint32Array, overlay: Overlay): Uint8ClampedArray<ArrayBuffer> {
  const rgba = new Uint8ClampedArray(4 * provenance.length);
  provenance.forEach((word, i) => rgba.set(colour(word >>> STATE_SHIFT, word & NO_SAMPLE, overlay), 4 * i));
  return rgba;
}

function colour(state: number, sample: number, overlay: Overlay): readonly [number, number, number, number] {
  if (state === STATE.unknown) return UNKNOWN_COLOUR;
  if (overlay === 'state') return state === STATE.filled ? FILLED_COLOUR : CLEAR;
  return state === STATE.background || sample === NO_SAMPLE ? CLEAR : sampleColour(sample);
}

/** Neighbouring numbers get unlike hues: steps of the golden ratio around the circle. */
function sampleColour(sample: number): readonly [number, number, number, number] {
  const hue = 6 * ((sample * 0.618033988749895) % 1);
  const channel = (offset: number): number => 255 * Math.min(Math.max(Math.abs(((hue + offset) % 6) - 3) - 1, 0), 1);
  return [channel(0), channel(4), channel(2), 200];
}
