/** What the live graphs show: counts of the last second, sampled while frames come and for a moment after. */

/** A quantity over time: the newest values in a ring. */
export class Series {
  private readonly values: number[] = [];

  constructor(private readonly capacity: number) {}

  push(value: number): void {
    this.values.push(value);
    if (this.values.length > this.capacity) this.values.shift();
  }

  /** From the oldest. */
  all(): readonly number[] {
    return this.values;
  }

  newest(): number | undefined {
    return this.values.at(-1);
  }
}

/** One drawn frame. */
export interface Drawn {
  readonly atMillis: number;
  readonly bytes: number;
  /** From setting the pose to drawing its frame; undefined where the pose is not known any more. */
  readonly latencyMillis: number | undefined;
  readonly hits: number;
  readonly lookUps: number;
}

/** Points of a graph. */
export const SAMPLES = 120;
const WINDOW_MILLIS = 1000;

export class Meters {
  readonly rate = new Series(SAMPLES);
  readonly latency = new Series(SAMPLES);
  readonly bytes = new Series(SAMPLES);
  readonly hitRate = new Series(SAMPLES);
  private recent: Drawn[] = [];
  private isNew = false;

  drawn(frame: Drawn): void {
    this.recent.push(frame);
    this.isNew = true;
    // At most a second of frames, whether anybody samples or not.
    this.forget(frame.atMillis);
  }

  /** One more point of each graph, over `pictures` pictures; false once nothing has happened for a second and the graphs say so. */
  sample(nowMillis: number, pictures: number): boolean {
    this.forget(nowMillis);
    const seconds = WINDOW_MILLIS / 1000;
    const wasMoving = (this.rate.newest() ?? 0) > 0;
    if (this.recent.length === 0 && !wasMoving) return false;
    this.rate.push(this.recent.length / seconds / pictures);
    this.bytes.push(sum(this.recent.map((frame) => frame.bytes)) / seconds);
    // Of a still picture these two are what they were.
    if (this.isNew) {
      const known = this.recent.flatMap((frame) => frame.latencyMillis ?? []);
      if (known.length > 0) this.latency.push(sum(known) / known.length);
      const lookUps = sum(this.recent.map((frame) => frame.lookUps));
      if (lookUps > 0) this.hitRate.push(sum(this.recent.map((frame) => frame.hits)) / lookUps);
      this.isNew = false;
    }
    return true;
  }

  private forget(nowMillis: number): void {
    this.recent = this.recent.filter((frame) => frame.atMillis > nowMillis - WINDOW_MILLIS);
  }
}

function sum(values: readonly number[]): number {
  return values.reduce((total, value) => total + value, 0);
}
