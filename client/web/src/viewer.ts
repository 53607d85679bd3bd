/** One dataset, live: the stage with its pictures, the settings beside it, and the address that says all of it. */
import { defaultViewpoint, FIELD_OF_VIEW_RANGE, radius, withFieldOfView, type Bounds, type Size, type Viewpoint } from './camera';
import { steer, type Mode } from './controls';
import { button, make, select } from './dom';
import { ErrorMap } from './error_map';
import { Graphs } from './graphs';
import { written, type Address, type Split } from './link';
import { Pane } from './pane';
import { controls, type Controls } from './panel';
import type { Phase } from './session';
import {
  decided,
  DELIVERY_FIELDS,
  DELIVERY_FIELDS_WITHOUT_VIDEO,
  SETTING_FIELDS,
  truthOf,
  type Delivery,
  type Kind,
  type Settings,
} from './settings';
import { saveStill } from './still';
import { cameraMessage, type Dataset, type Frame, type ServerInfo } from './wire';

/** What is shown, found on the server. */
export interface Subject {
  readonly dataset: Dataset;
  readonly kind: Kind;
  readonly version: number;
  readonly bounds: Bounds | undefined;
  readonly server: ServerInfo;
}

const DEGREE = Math.PI / 180;
/** Browsers refuse a page that rewrites its address all the time. */
const LINK_MILLIS = 300;
const RESIZE_MILLIS = 100;
/** Of a kind that tells no box. */
const UNKNOWN_BOUNDS: Bounds = { min: [-1, -1, -1], max: [1, 1, 1] };
const LETTERS = ['A', 'B'] as const;

export class Viewer {
  readonly element = make('main', { class: 'viewer' });
  private readonly abort = new AbortController();
  private readonly bounds: Bounds;
  private view: Viewpoint;
  private mode: Mode = 'orbit';
  private panes: Pane[] = [];
  private phases: Phase[] = [];
  private linkTimer: number | undefined;
  private resizeTimer: number | undefined;
  private readonly graphs = new Graphs(() => this.panes.length);
  private readonly pictures = make('div', { class: 'pictures' });
  private readonly notice = make('div', { class: 'notice', role: 'alert', hidden: true });
  private readonly status = make('span', { class: 'status', role: 'status' });
  private readonly frameFacts = make('p', { class: 'facts' });
  private readonly stage: HTMLElement;
  private readonly flyButton: HTMLButtonElement;
  private readonly fieldOfView = make('input', {
    id: 'fov',
    type: 'range',
    min: FIELD_OF_VIEW_RANGE[0] / DEGREE,
    max: FIELD_OF_VIEW_RANGE[1] / DEGREE,
    step: 1,
  });
  private readonly fieldOfViewText = make('output', { for: 'fov' });
  private readonly divider = make('input', {
    class: 'divider',
    type: 'range',
    min: 0,
    max: 100,
    value: 50,
    'aria-label': 'Divider between A and B',
  });
  private readonly errorMap = new ErrorMap();
  private readonly truthButton: HTMLButtonElement;
  private readonly settingsControls: readonly Controls<Settings>[];
  private readonly letters: readonly HTMLButtonElement[];
  private readonly letterRow: HTMLElement;

  constructor(
    private readonly subject: Subject,
    private address: Address,
  ) {
    this.bounds = subject.bounds ?? UNKNOWN_BOUNDS;
    this.view = address.viewpoint ?? defaultViewpoint(this.bounds);
    this.address = { ...address, version: subject.version };
    if (!subject.server.hasVideo && address.delivery.encoding === 'h264') {
      this.address = { ...this.address, delivery: { ...address.delivery, encoding: 'jpeg' } };
    }
    this.stage = make(
      'div',
      { class: 'stage', tabindex: 0, role: 'application', 'aria-label': `${subject.dataset.name}, live view`, 'aria-describedby': 'keys' },
      this.pictures,
      this.errorMap.legend,
      this.divider,
      this.notice,
    );
    this.settingsControls = LETTERS.map((letter, index) =>
      controls(SETTING_FIELDS, subject.kind, `settings-${letter}`, this.settings(index), (values) => this.setSettings(index, values)),
    );
    this.letters = LETTERS.map((letter, index) => button(letter, {}, () => this.editLetter(index)));
    this.letterRow = make('div', { class: 'letters', role: 'group', 'aria-label': 'Settings of picture' }, ...this.letters);
    this.truthButton = button('B: truth of A', { title: 'Picture B shows the ground truth of A’s settings' }, () => this.showTruth());
    this.flyButton = button('Fly', { 'aria-pressed': 'false', title: 'Drag turns the head, W A S D moves (F)' }, () => this.toggleMode());
    this.build();
    this.editLetter(0);
  }

  /** Once the element is in the page and has a size. */
  start(): void {
    this.openPanes();
    this.listen();
  }

  /** What the address bar should say. */
  link(): string {
    return written({ ...this.address, viewpoint: this.view });
  }

  close(): void {
    this.abort.abort();
    window.clearTimeout(this.linkTimer);
    window.clearTimeout(this.resizeTimer);
    this.graphs.close();
    this.panes.forEach((pane) => pane.close());
  }

  private build(): void {
    const { dataset, version } = this.subject;
    const versions = select(
      dataset.versions.map(({ version: v }): [string, string] => [String(v), `version ${v}`]),
      { 'aria-label': 'Version' },
    );
    versions.value = String(version);
    versions.addEventListener('change', () => {
      location.hash = written({ ...this.address, version: Number(versions.value), viewpoint: this.view });
    });
    const split = select(
      [
        ['none', 'one picture'],
        ['side', 'A beside B'],
        ['wipe', 'A over B'],
        ['error', 'error of A against B'],
      ],
      { 'aria-label': 'Compare' },
    );
    split.value = this.address.split;
    split.addEventListener('change', () => this.setSplit(split.value as Split));
    const panel = this.panel();
    const toggle = button('Settings', { 'aria-controls': 'panel' }, () => showPanel(panel.hidden));
    const showPanel = (isShown: boolean): void => {
      panel.hidden = !isShown;
      toggle.setAttribute('aria-expanded', String(isShown));
    };
    // On a small screen the picture comes first.
    showPanel(!window.matchMedia('(max-width: 48rem)').matches);
    const bar = make(
      'header',
      { class: 'bar' },
      make('a', { href: '#', class: 'back' }, 'Datasets'),
      make('h1', {}, dataset.name),
      ...(dataset.versions.length > 1 ? [versions] : []),
      this.status,
      make(
        'div',
        { class: 'tools', role: 'toolbar', 'aria-label': 'View' },
        button('Reset', { title: 'Back to the first view (R)' }, () => this.reset()),
        this.flyButton,
        split,
        this.truthButton,
        button('Copy link', {}, () => void this.copyLink()),
        toggle,
      ),
    );
    this.divider.addEventListener('input', () => this.pictures.style.setProperty('--divider', `${this.divider.value}%`));
    this.element.append(bar, make('div', { class: 'middle' }, this.stage, panel), this.graphs.element);
  }

  private panel(): HTMLElement {
    const fields = this.subject.server.hasVideo ? DELIVERY_FIELDS : DELIVERY_FIELDS_WITHOUT_VIDEO;
    const delivery = controls(fields, this.subject.kind, 'delivery', this.address.delivery, (values) => this.setDelivery(values));
    this.fieldOfView.addEventListener('input', () => this.setView(withFieldOfView(this.view, Number(this.fieldOfView.value) * DEGREE)));
    const save = (encoding: 'png' | 'exr'): HTMLElement => button(`Save ${encoding.toUpperCase()}`, {}, () => void this.save(encoding));
    const section = (title: string, ...children: Node[]): HTMLElement => make('section', {}, make('h2', {}, title), ...children);
    return make(
      'aside',
      { class: 'panel', id: 'panel', 'aria-label': 'Settings' },
      section('Picture', this.letterRow, ...this.settingsControls.map(({ element }) => element)),
      section(
        'Camera',
        make('div', { class: 'field range' }, make('label', { for: 'fov' }, 'Field of view, °'), this.fieldOfViewText, this.fieldOfView),
      ),
      section('Frames', delivery.element, this.frameFacts),
      section('Still', make('div', { class: 'buttons' }, save('png'), save('exr'))),
      section('Mouse, touch, keys', keyHelp()),
    );
  }

  private listen(): void {
    const { signal } = this.abort;
    steer(
      this.stage,
      {
        size: () => cssSize(this.panes[0]?.element ?? this.stage),
        mode: () => this.mode,
        objectRadius: () => radius(this.bounds),
        change: (move) => this.setView(move(this.view)),
        reset: () => this.reset(),
        toggleMode: () => this.toggleMode(),
      },
      signal,
    );
    const observer = new ResizeObserver(() => {
      window.clearTimeout(this.resizeTimer);
      this.resizeTimer = window.setTimeout(() => this.setView(this.view), RESIZE_MILLIS);
    });
    observer.observe(this.stage);
    signal.addEventListener('abort', () => observer.disconnect());
    const retry = (): void => this.panes.forEach((pane, index) => this.phases[index]?.name === 'waiting' && pane.retry());
    window.addEventListener('online', retry, { signal });
    document.addEventListener('visibilitychange', () => document.visibilityState === 'visible' && retry(), { signal });
  }

  private settings(index: number): Settings {
    return index === 0 ? this.address.settings : this.address.other;
  }

  private delivery(): Delivery {
    return decided(this.address.delivery, this.subject.server.roundTripMillis);
  }

  /** Sessions anew: for one picture or two, at this rate. */
  private openPanes(): void {
    this.panes.forEach((pane) => pane.close());
    const { server, dataset, version, kind } = this.subject;
    const { delivery, split } = this.address;
    // One frame on the screen, and as many as come in a frame's round trip: the way's, and an interval each for drawing and sending it.
    const credits = Math.min(3 + Math.ceil((server.roundTripMillis / 1000) * delivery.rate), 16);
    const opening = { dataset: dataset.name, version, credits, framesPerSecond: delivery.rate };
    this.phases = [];
    this.panes = (split === 'none' ? [0] : [0, 1]).map(
      (index) =>
        new Pane(kind, opening, this.settings(index), this.delivery(), {
          phase: (phase) => this.setPhase(index, phase),
          rejected: (message) => this.tell(message),
          drawn: (frame, measured) => {
            this.graphs.drawn(measured);
            this.compare();
            if (index === 0) this.showFacts(frame);
          },
        }),
    );
    const isError = split === 'error';
    this.pictures.replaceChildren(...this.panes.map(({ element }) => element), ...(isError ? [this.errorMap.canvas] : []));
    this.pictures.className = `pictures ${split}`;
    this.divider.hidden = split !== 'wipe';
    this.errorMap.legend.hidden = !isError;
    this.letterRow.hidden = split === 'none';
    this.truthButton.hidden = split === 'none';
    this.setView(this.view);
  }

  private setView(view: Viewpoint): void {
    this.view = view;
    for (const pane of this.panes) pane.setView(view, this.pixels(pane));
    this.errorMap.outdate();
    const degrees = (view.fieldOfView / DEGREE).toFixed(0);
    this.fieldOfView.value = degrees;
    this.fieldOfViewText.textContent = degrees;
    this.linkLater();
  }

  /** Both pictures are given each pose at once: those that show their newest show the same. */
  private compare(): void {
    if (this.address.split !== 'error') return;
    const [a, b] = this.panes.map((pane) => pane.current());
    if (a && b && a.width === b.width && a.height === b.height) void this.errorMap.compare(a, b);
  }

  /** Of a still frame: what fills the pane, within the server's limit. */
  private pixels(pane: Pane): Size {
    const { width, height } = cssSize(pane.element);
    const wanted = this.address.delivery.scale || window.devicePixelRatio;
    const scale = Math.min(wanted, Math.sqrt(this.subject.server.maxPixels / (width * height)));
    return { width: Math.max(1, Math.floor(width * scale)), height: Math.max(1, Math.floor(height * scale)) };
  }

  private setSettings(index: number, values: Settings): void {
    this.address = index === 0 ? { ...this.address, settings: values } : { ...this.address, other: values };
    this.tell(undefined);
    this.panes[index]?.setSettings(values, this.delivery());
    this.errorMap.outdate();
    this.linkLater();
  }

  private setDelivery(delivery: Delivery): void {
    const isOpened = delivery.rate === this.address.delivery.rate;
    this.address = { ...this.address, delivery };
    if (isOpened) {
      this.panes.forEach((pane, index) => pane.setSettings(this.settings(index), this.delivery()));
      this.setView(this.view);
    } else {
      this.openPanes();
    }
  }

  private setSplit(split: Split): void {
    // Two equal pictures to begin with.
    if (this.address.split === 'none') this.address = { ...this.address, other: this.address.settings };
    this.address = { ...this.address, split };
    this.settingsControls[1]?.show(this.address.other);
    if (split === 'none') this.editLetter(0);
    this.openPanes();
  }

  private showTruth(): void {
    const other = truthOf(this.address.settings);
    this.settingsControls[1]?.show(other);
    this.setSettings(1, other);
  }

  private editLetter(edited: number): void {
    this.letters.forEach((letter, index) => letter.setAttribute('aria-pressed', String(index === edited)));
    this.settingsControls.forEach(({ element }, index) => (element.hidden = index !== edited));
  }

  private reset(): void {
    this.setView(defaultViewpoint(this.bounds));
  }

  private toggleMode(): void {
    this.mode = this.mode === 'orbit' ? 'fly' : 'orbit';
    this.flyButton.setAttribute('aria-pressed', String(this.mode === 'fly'));
  }

  private setPhase(index: number, phase: Phase): void {
    this.phases[index] = phase;
    const worst = this.phases.find(({ name }) => name !== 'live') ?? phase;
    this.status.dataset['phase'] = worst.name;
    this.stage.dataset['phase'] = worst.name;
    switch (worst.name) {
      case 'live':
        this.status.textContent = 'live';
        this.tell(undefined);
        break;
      case 'connecting':
        this.status.textContent = 'connecting';
        break;
      case 'waiting':
        this.status.textContent = 'reconnecting';
        // One failure may be a proxy that cut an idle connection: not worth a word.
        if (worst.failures > 1) this.tell(`The connection is lost (${worst.reason}). Trying again…`);
        break;
      case 'failed':
        this.status.textContent = 'stopped';
        this.tell(
          worst.reason,
          button('Try again', {}, () => this.panes.forEach((pane, i) => this.phases[i]?.name === 'failed' && pane.retry())),
        );
        break;
    }
  }

  /** A notice over the picture; undefined takes it away. */
  private tell(message: string | undefined, action?: HTMLElement): void {
    this.notice.hidden = message === undefined;
    const dismiss = button('×', { 'aria-label': 'Dismiss' }, () => this.tell(undefined));
    this.notice.replaceChildren(...(message === undefined ? [] : [make('span', {}, message), ...(action ? [action] : []), dismiss]));
  }

  private showFacts(frame: Frame): void {
    const timings = frame.timings;
    const millis = (micros: bigint | undefined): string => (Number(micros ?? 0n) / 1000).toFixed(1);
    this.frameFacts.textContent =
      `${frame.widthPx} × ${frame.heightPx} · pages ${millis(timings?.pagesMicros)} · render ${millis(timings?.renderMicros)} · ` +
      `encode ${millis(timings?.encodeMicros)} ms · ${frame.adapter || 'CPU'}`;
  }

  private async save(encoding: 'png' | 'exr'): Promise<void> {
    const [pane] = this.panes;
    if (pane === undefined) return;
    const { dataset, version, kind } = this.subject;
    try {
      await saveStill(dataset.name, version, kind, this.settings(0), cameraMessage(this.view, this.pixels(pane)), encoding);
    } catch (error) {
      this.tell(`The still is not saved: ${error instanceof Error ? error.message : String(error)}`);
    }
  }

  private linkLater(): void {
    this.linkTimer ??= window.setTimeout(() => this.writeLink(), LINK_MILLIS);
  }

  private writeLink(): void {
    window.clearTimeout(this.linkTimer);
    this.linkTimer = undefined;
    history.replaceState(null, '', this.link());
  }

  private async copyLink(): Promise<void> {
    this.writeLink();
    const url = location.href;
    try {
      await navigator.clipboard.writeText(url);
      this.tell('The link is copied.');
    } catch {
      // No clipboard without transport security: the user copies.
      const field = make('input', { readonly: true, value: url, 'aria-label': 'Link' });
      this.tell('Copy this link:', field);
      field.select();
    }
  }
}

function cssSize(element: Element): Size {
  const { width, height } = element.getBoundingClientRect();
  return { width: Math.max(width, 1), height: Math.max(height, 1) };
}

function keyHelp(): HTMLElement {
  const rows = [
    ['drag · arrows', 'turn'],
    ['right or shift + drag · shift + arrows', 'shift'],
    ['wheel · pinch · + −', 'nearer, farther'],
    ['W A S D Q E', 'fly'],
    ['F', 'orbit or fly'],
    ['[ ]', 'field of view'],
    ['R', 'reset'],
  ] as const;
  return make(
    'dl',
    { class: 'keys', id: 'keys' },
    ...rows.map(([keys, does]) => make('div', {}, make('dt', {}, keys), make('dd', {}, does))),
  );
}
