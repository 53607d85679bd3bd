/**
 * How far two shown pictures are apart: CIEDE2000 of each pixel as a colour over the first picture, and its mean and 95th percentile. Of
 * pictures of the same pose alone: whoever has them says so, and says when they are out of date.
 */
import { difference2000, labOf } from './colour_difference';
import { context2d, make } from './dom';

/** End of the colours' range; what is beyond looks as it does. */
export const RANGE = 10;
/** Differences up to this show through: nobody sees them. */
const OPAQUE_FROM = 2;
/** Pixels in one go: a few milliseconds, so that a drag is not held up. */
const PIXELS_AT_ONCE = 16_384;
/** matplotlib's plasma (S. van der Walt and N. Smith 2015, CC0) at quarters: equal steps look equal, also to the colour-blind. */
const PLASMA = [
  [13, 8, 135],
  [126, 3, 168],
  [204, 71, 120],
  [248, 149, 64],
  [240, 249, 33],
] as const;

/** Of all pixels. */
export interface Summary {
  readonly mean: number;
  readonly percentile95: number;
}

/** Of two pictures of as many RGBA pixels; some at a time. */
export function* differences(a: Uint8ClampedArray, b: Uint8ClampedArray): Generator<undefined, Float32Array> {
  if (a.length !== b.length) throw new RangeError(`pictures of ${a.length} and ${b.length} bytes`);
  const all = new Float32Array(a.length / 4);
  for (let pixel = 0; pixel < all.length; pixel++) {
    if (pixel % PIXELS_AT_ONCE === 0) yield;
    const i = 4 * pixel;
    const [r, g, blue] = [a[i]!, a[i + 1]!, a[i + 2]!];
    const [s, h, lue] = [b[i]!, b[i + 1]!, b[i + 2]!];
    if (r !== s || g !== h || blue !== lue) all[pixel] = difference2000(labOf(r, g, blue), labOf(s, h, lue));
  }
  return all;
}

/** The percentile is the least value that 95 % do not exceed, as in evaluations. */
export function summary(all: Float32Array): Summary {
  const sorted = all.slice().sort();
  const mean = all.reduce((sum, value) => sum + value, 0) / Math.max(all.length, 1);
  return { mean, percentile95: sorted[Math.max(Math.ceil(0.95 * sorted.length) - 1, 0)] ?? 0 };
}

/** RGBA of a difference. */
export function errorColour(difference: number): readonly [number, number, number, number] {
  const at = Math.min(difference / RANGE, 1) * (PLASMA.length - 1);
  const from = Math.min(Math.floor(at), PLASMA.length - 2);
  const [low, high] = [PLASMA[from]!, PLASMA[from + 1]!];
  const channel = (k: 0 | 1 | 2): number => low[k] + (at - from) * (high[k] - low[k]);
  return [channel(0), channel(1), channel(2), 230 * Math.min(difference / OPAQUE_FROM, 1)];
}

/** The overlay and its legend. */
export class ErrorMap {
  readonly canvas = make('canvas', { class: 'error', role: 'img', width: 0, height: 0 });
  private readonly text = make('output', { class: 'error-text' });
  private readonly bar = make('canvas', { width: 100, height: 1, 'aria-hidden': 'true' });
  readonly legend = make(
    'div',
    { class: 'error-legend' },
    this.text,
    make('span', { class: 'error-scale' }, '0', this.bar, `${RANGE} and more`),
  );
  // Counts what was asked for: only the newest is shown.
  private newest = 0;

  constructor() {
    const columns = Array.from({ length: this.bar.width }, (_, i) => errorColour(((i + 0.5) / this.bar.width) * RANGE));
    context2d(this.bar).putImageData(new ImageData(Uint8ClampedArray.from(columns.flat()), this.bar.width, 1), 0, 0);
    this.outdate();
  }

  /** The pictures are not, or not any more, of one pose. */
  outdate(): void {
    this.newest += 1;
    this.canvas.width = 0;
    this.text.textContent = 'ΔE of A and B: waiting for both';
    delete this.legend.dataset['mean'];
  }

  /** Of these two, of one size, as they are now. */
  async compare(first: HTMLCanvasElement, second: HTMLCanvasElement): Promise<void> {
    const mine = ++this.newest;
    const { width, height } = first;
    const [a, b] = [first, second].map((canvas) => context2d(canvas).getImageData(0, 0, width, height).data);
    const work = differences(a!, b!);
    for (let step = work.next(); ; step = work.next()) {
      if (step.done) {
        this.show(step.value, width, height);
        return;
      }
      await nextTask();
      if (mine !== this.newest) return;
    }
  }

  private show(all: Float32Array, width: number, height: number): void {
    const rgba = new Uint8ClampedArray(4 * all.length);
    all.forEach((difference, pixel) => difference > 0 && rgba.set(errorColour(difference), 4 * pixel));
    this.canvas.width = width;
    this.canvas.height = height;
    context2d(this.canvas).putImageData(new ImageData(rgba, width, height), 0, 0);
    const { mean, percentile95 } = summary(all);
    this.text.textContent = `ΔE2000 of A and B: mean ${mean.toFixed(2)}, 95 % of pixels at most ${percentile95.toFixed(2)}`;
    this.canvas.setAttribute('aria-label', this.text.textContent);
    Object.assign(this.legend.dataset, { mean: String(mean), percentile95: String(percentile95) });
  }
}

/** Lets input and frames pass; a timeout would be held back to four milliseconds. */
function nextTask(): Promise<void> {
  return new Promise((resolve) => {
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = () => {
      port1.close();
      resolve();
    };
    port2.postMessage(undefined);
  });
}
