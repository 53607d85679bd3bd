/** The datasets, each with a picture; a click opens one. */
import { defaultViewpoint } from './camera';
import { make } from './dom';
import { bytesText } from './graphs';
import { addressOf, written } from './link';
import { CallError } from './session';
import { DEFAULT_SETTINGS, isKind, KIND_NAMES } from './settings';
import { cameraMessage, getDataset, listDatasets, mediaType, renderFrame, stillMessage, type Dataset } from './wire';

const THUMBNAIL = { width: 320, height: 240 };
/** At once: a server renders one after the other anyway, and other calls need connections. */
const THUMBNAILS_AT_ONCE = 2;
const RETRY_MILLIS = 3000;
/** From this many on, names can be searched. */
const SEARCH_FROM = 8;

export class List {
  readonly element = make('main', { class: 'list' });
  private readonly abort = new AbortController();
  private readonly waiting: (() => Promise<void>)[] = [];
  private readonly pictures: string[] = [];
  private running = 0;
  private timer: number | undefined;
  private readonly observer = new IntersectionObserver((entries) => this.seen(entries), { rootMargin: '200px' });
  private readonly unseen = new Map<Element, () => Promise<void>>();

  constructor() {
    this.element.append(make('p', { class: 'note', role: 'status' }, 'Asking for the datasets…'));
    void this.load();
  }

  close(): void {
    this.abort.abort();
    window.clearTimeout(this.timer);
    this.observer.disconnect();
    this.pictures.forEach((url) => URL.revokeObjectURL(url));
  }

  private async load(): Promise<void> {
    try {
      const datasets = await listDatasets();
      if (!this.abort.signal.aborted) this.show(datasets);
    } catch (error) {
      if (this.abort.signal.aborted) return;
      const reason = error instanceof Error ? error.message : String(error);
      this.element.replaceChildren(make('p', { class: 'note', role: 'alert' }, `The server does not answer (${reason}). Trying again…`));
      this.timer = window.setTimeout(() => void this.load(), RETRY_MILLIS);
    }
  }

  private show(datasets: readonly Dataset[]): void {
    const cards = datasets.map((dataset) => ({ dataset, card: this.card(dataset) }));
    const grid = make('ul', { class: 'cards' }, ...cards.map(({ card }) => card));
    if (cards.length === 0) {
      const hint = make('code', {}, 'lumisphere job submit capture --scene gazebo --dataset teapot --watch');
      this.element.replaceChildren(make('p', { class: 'note' }, 'No datasets yet. The first: ', hint));
      return;
    }
    this.element.replaceChildren(...(cards.length >= SEARCH_FROM ? [search(cards)] : []), grid);
  }

  private card(dataset: Dataset): HTMLElement {
    const newest = dataset.versions.find(({ version }) => version === dataset.latestVersion);
    const facts = [
      newest && `version ${newest.version}`,
      newest && bytesText(newest.sizeBytes),
      newest?.created?.toLocaleDateString(undefined, { year: 'numeric', month: 'short', day: 'numeric' }),
    ];
    const picture = make('div', { class: 'thumbnail' });
    const text = [
      make('span', { class: 'name' }, dataset.name),
      make('span', { class: 'facts' }, KIND_NAMES[dataset.kind] ?? dataset.kind),
      make('span', { class: 'facts' }, facts.filter(Boolean).join(' · ')),
    ];
    const why = whyNotShown(dataset);
    if (why !== undefined) {
      picture.append(make('span', {}, why));
      return make('li', {}, make('div', { class: 'card' }, picture, ...text));
    }
    this.unseen.set(picture, () => this.draw(dataset.name, picture));
    this.observer.observe(picture);
    return make('li', {}, make('a', { class: 'card', href: written(addressOf(dataset.name)) }, picture, ...text));
  }

  private seen(entries: readonly IntersectionObserverEntry[]): void {
    for (const { isIntersecting, target } of entries) {
      const draw = this.unseen.get(target);
      if (!isIntersecting || draw === undefined) continue;
      this.unseen.delete(target);
      this.observer.unobserve(target);
      this.waiting.push(draw);
    }
    this.drawNext();
  }

  private drawNext(): void {
    while (this.running < THUMBNAILS_AT_ONCE && !this.abort.signal.aborted) {
      const next = this.waiting.shift();
      if (next === undefined) return;
      this.running += 1;
      void next().finally(() => {
        this.running -= 1;
        this.drawNext();
      });
    }
  }

  private async draw(name: string, picture: HTMLElement): Promise<void> {
    try {
      const dataset = await getDataset(name);
      const bounds = dataset.versions.find(({ version }) => version === dataset.latestVersion)?.bounds;
      if (bounds === undefined || !isKind(dataset.kind)) return;
      const camera = cameraMessage(defaultViewpoint(bounds), THUMBNAIL);
      const message = stillMessage(dataset.kind, DEFAULT_SETTINGS, 'jpeg');
      const frame = await renderFrame(name, dataset.latestVersion, camera, message, this.abort.signal);
      const url = URL.createObjectURL(new Blob([frame.color as Uint8Array<ArrayBuffer>], { type: mediaType(frame) }));
      this.pictures.push(url);
      // Beside its name, which says the same.
      picture.replaceChildren(make('img', { src: url, alt: '', ...THUMBNAIL }));
    } catch (error) {
      if (this.abort.signal.aborted) return;
      picture.replaceChildren(make('span', {}, error instanceof CallError ? error.message : 'no picture'));
    }
  }
}

/** Undefined where it can be opened. */
function whyNotShown(dataset: Dataset): string | undefined {
  if (dataset.latestVersion === 0) return 'empty: its first version is not finished';
  if (!isKind(dataset.kind)) return 'measurements, not a picture: fit a parameter map to them';
  return undefined;
}

function search(cards: readonly { dataset: Dataset; card: HTMLElement }[]): HTMLElement {
  const input = make('input', { type: 'search', id: 'search', placeholder: 'Name or kind', autocomplete: 'off' });
  input.addEventListener('input', () => {
    const wanted = input.value.trim().toLowerCase();
    for (const { dataset, card } of cards) {
      const text = `${dataset.name} ${KIND_NAMES[dataset.kind] ?? dataset.kind}`;
      card.hidden = !text.toLowerCase().includes(wanted);
    }
  });
  return make('div', { class: 'search' }, make('label', { for: 'search' }, 'Find'), input);
}
