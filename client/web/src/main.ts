/** The page: what the address names, or the list of datasets. */
import './style.css';
import { make } from './dom';
import { List } from './list';
import { read, type Address } from './link';
import { CallError } from './session';
import { isKind, KIND_NAMES } from './settings';
import { Viewer, type Subject } from './viewer';
import { canDecodeVideo } from './video';
import { getDataset, serverInfo, type Dataset } from './wire';

interface Page {
  readonly element: HTMLElement;
  close(): void;
}

const RETRY_MILLIS = 3000;

const app = make('div', { class: 'app' });
document.querySelector('#app')?.replaceWith(app);
let page: Page | undefined;
/** Counts routes, so that an answer to an earlier one is not shown. */
let route = 0;

function show(next: Page, title: string): void {
  page?.close();
  page = next;
  document.title = title;
}

async function follow(): Promise<void> {
  const current = ++route;
  try {
    const address = read(location.hash);
    if (address === undefined) {
      const list = new List();
      show(list, 'Lumisphere');
      app.replaceChildren(make('header', { class: 'bar' }, make('h1', {}, 'Lumisphere')), list.element);
      return;
    }
    note(`Opening ${address.dataset}…`, 'status');
    const subject = await find(address);
    if (current !== route) return;
    const viewer = new Viewer(subject, address);
    show(viewer, `${address.dataset} · Lumisphere`);
    app.replaceChildren(viewer.element);
    viewer.start();
  } catch (error) {
    if (current !== route) return;
    if (error instanceof CallError && error.failure === 'unavailable') {
      note(`The server does not answer (${error.message}). Trying again…`, 'alert');
      window.setTimeout(() => current === route && void follow(), RETRY_MILLIS);
    } else {
      note(error instanceof Error ? error.message : String(error), 'alert');
    }
  }
}

/** What the address names, or why it cannot be shown. */
async function find(address: Address): Promise<Subject> {
  const [dataset, info, canDecode] = await Promise.all([named(address.dataset), serverInfo(), canDecodeVideo()]);
  const server = { ...info, hasVideo: info.hasVideo && canDecode };
  if (dataset.latestVersion === 0) throw new CallError('refused', `“${dataset.name}” is empty: its first version is not finished.`);
  const { kind } = dataset;
  if (!isKind(kind)) {
    throw new CallError(
      'refused',
      `“${dataset.name}” holds an ${KIND_NAMES[kind] ?? kind}, which is not a picture: fit a parameter map to it.`,
    );
  }
  const number = address.version === 0 ? dataset.latestVersion : address.version;
  const version = dataset.versions.find((candidate) => candidate.version === number);
  if (version === undefined) {
    const there = dataset.versions.map((candidate) => candidate.version).join(', ');
    throw new CallError('missing', `“${dataset.name}” has no version ${number}; there are: ${there}.`);
  }
  return { dataset, kind, version: number, bounds: version.bounds, server };
}

async function named(name: string): Promise<Dataset> {
  try {
    return await getDataset(name);
  } catch (error) {
    const isMissing = error instanceof CallError && error.failure === 'missing';
    throw isMissing ? new CallError('missing', `There is no dataset “${name}” on this server.`) : error;
  }
}

function note(text: string, role: 'alert' | 'status'): void {
  const element = make(
    'main',
    { class: 'list' },
    make('p', { class: 'note', role }, text),
    make('p', { class: 'note' }, make('a', { href: '#' }, 'All datasets')),
  );
  show({ element, close: () => undefined }, 'Lumisphere');
  app.replaceChildren(make('header', { class: 'bar' }, make('h1', {}, 'Lumisphere')), element);
}

window.addEventListener('hashchange', () => {
  // An address that the viewer wrote itself is what is shown.
  if (page instanceof Viewer && page.link() === location.hash) return;
  void follow();
});
window.addEventListener('pagehide', (event) => {
  if (!event.persisted) page?.close();
});
void follow();
