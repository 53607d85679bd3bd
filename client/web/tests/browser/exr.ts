/** Reads what the server writes as OpenEXR: rows of R, G and B as f32, ZIP-compressed. By the format's description, not by the server's code. */
import { inflateSync } from 'node:zlib';

export interface Radiance {
  readonly width: number;
  readonly height: number;
  /** Red, green and blue of each pixel, row by row. */
  readonly rgb: Float32Array;
}

const ROWS_PER_BLOCK = 16;
const ZIP = 3;
const FLOAT = 2;

/** Throws at what is not such a file. */
export function readExr(bytes: Buffer): Radiance {
  // Version 2, no flag: one part of rows.
  if (bytes.readUInt32LE(0) !== 20000630 || bytes.readUInt32LE(4) !== 2) throw new Error('no EXR of one part of rows');
  const { attributes, end } = header(bytes);
  const [left, top, right, bottom] = [0, 4, 8, 12].map((at) => attributes.get('dataWindow')!.readInt32LE(at)) as [
    number,
    number,
    number,
    number,
  ];
  const [width, height] = [right - left + 1, bottom - top + 1];
  const channels = namesOfFloats(attributes.get('channels')!);
  if (channels.join() !== 'B,G,R' || attributes.get('compression')![0] !== ZIP) throw new Error(`channels ${channels.join()}, or no ZIP`);
  const rgb = new Float32Array(3 * width * height);
  for (let block = 0; block < Math.ceil(height / ROWS_PER_BLOCK); block++) {
    const at = Number(bytes.readBigUInt64LE(end + 8 * block));
    const first = bytes.readInt32LE(at) - top;
    const packed = bytes.subarray(at + 8, at + 8 + bytes.readInt32LE(at + 4));
    const rows = Math.min(ROWS_PER_BLOCK, height - first);
    const raw = unpacked(packed, rows * width * 3 * 4);
    // A row is all of its blue, then green, then red.
    for (let i = 0; i < rows * width * 3; i++) {
      const row = first + Math.floor(i / (3 * width));
      const channel = Math.floor(i / width) % 3;
      rgb[3 * (row * width + (i % width)) + 2 - channel] = raw.readFloatLE(4 * i);
    }
  }
  return { width, height, rgb };
}

/** Attributes by name, and where the table of blocks begins. */
function header(bytes: Buffer): { attributes: Map<string, Buffer>; end: number } {
  const attributes = new Map<string, Buffer>();
  let at = 8;
  const word = (): string => {
    const end = bytes.indexOf(0, at);
    const text = bytes.toString('latin1', at, end);
    at = end + 1;
    return text;
  };
  for (let name = word(); name !== ''; name = word()) {
    // Its type.
    word();
    const length = bytes.readInt32LE(at);
    attributes.set(name, bytes.subarray(at + 4, at + 4 + length));
    at += 4 + length;
  }
  return { attributes, end: at };
}

/** Channels in the order of the file. */
function namesOfFloats(list: Buffer): string[] {
  const names: string[] = [];
  for (let at = 0; list[at] !== 0; ) {
    const end = list.indexOf(0, at);
    names.push(list.toString('latin1', at, end));
    if (list.readInt32LE(end + 1) !== FLOAT) throw new Error(`channel ${names.at(-1)} is no f32`);
    at = end + 1 + 16;
  }
  return names;
}

/** Inflated, summed up, and its two halves dealt out in turn; a block that would not get smaller is stored as it is. */
function unpacked(packed: Buffer, length: number): Buffer {
  if (packed.length === length) return packed;
  const bytes = inflateSync(packed);
  if (bytes.length !== length) throw new Error(`a block of ${bytes.length} bytes, ${length} expected`);
  for (let i = 1; i < length; i++) bytes[i] = bytes[i - 1]! + bytes[i]! - 128;
  const half = Math.ceil(length / 2);
  return Buffer.from(bytes.map((_, i) => bytes[(i >> 1) + (i % 2) * half]!));
}
