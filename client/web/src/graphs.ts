/** Four small graphs: frames a second, latency, bytes a second, cache hits. */
import { context2d, make } from './dom';
import { Meters, SAMPLES, type Drawn, type Series } from './meters';

interface Graph {
  readonly series: Series;
  readonly value: HTMLElement;
  readonly canvas: HTMLCanvasElement;
  readonly show: (value: number) => string;
  /** Top of the graph, at least. */
  readonly top: number;
}

const SAMPLE_MILLIS = 250;
const WIDTH_PX = 120;
const HEIGHT_PX = 26;

export class Graphs {
  readonly element = make('dl', { class: 'graphs', 'aria-label': 'Live measurements' });
  private readonly meters = new Meters();
  private readonly graphs: readonly Graph[];
  private timer: number | undefined;

  constructor(private readonly pictures: () => number) {
    this.graphs = [
      this.add('Frames/s', this.meters.rate, 10, (value) => value.toFixed(0)),
      this.add('Latency', this.meters.latency, 20, (value) => `${value.toFixed(0)} ms`),
      this.add('Transfer', this.meters.bytes, 1e5, (value) => `${bytesText(value)}/s`),
      this.add('Cache hits', this.meters.hitRate, 1, (value) => `${(100 * value).toFixed(0)} %`),
    ];
  }

  drawn(frame: Drawn): void {
    this.meters.drawn(frame);
    // Nothing ticks while nothing comes.
    this.timer ??= window.setInterval(() => this.tick(), SAMPLE_MILLIS);
  }

  close(): void {
    window.clearInterval(this.timer);
    this.timer = undefined;
  }

  private tick(): void {
    if (!this.meters.sample(performance.now(), this.pictures())) {
      this.close();
      return;
    }
    this.graphs.forEach(draw);
  }

  private add(label: string, series: Series, top: number, show: (value: number) => string): Graph {
    const value = make('span', {}, '–');
    const canvas = make('canvas', { width: WIDTH_PX, height: HEIGHT_PX, 'aria-hidden': 'true' });
    this.element.append(make('div', {}, make('dt', {}, label), make('dd', {}, value, canvas)));
    return { series, value, canvas, show, top };
  }
}

/** "1.2 MB". */
export function bytesText(bytes: number): string {
  const units = ['B', 'kB', 'MB', 'GB', 'TB'];
  const power = bytes < 1 ? 0 : Math.min(Math.floor(Math.log10(bytes) / 3), units.length - 1);
  const value = bytes / 1000 ** power;
  return `${value.toFixed(power > 0 && value < 10 ? 1 : 0)} ${units[power]}`;
}

function draw({ series, value, canvas, show, top }: Graph): void {
  const values = series.all();
  const newest = series.newest();
  value.textContent = newest === undefined ? '–' : show(newest);
  const context = context2d(canvas);
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.strokeStyle = getComputedStyle(canvas).color;
  context.lineWidth = 1.5;
  context.beginPath();
  const highest = Math.max(top, ...values);
  const step = canvas.width / (SAMPLES - 1);
  values.forEach((v, i) => {
    const x = canvas.width - (values.length - 1 - i) * step;
    context.lineTo(x, canvas.height - 1 - (v / highest) * (canvas.height - 3));
  });
  context.stroke();
}
