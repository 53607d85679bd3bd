/** The viewer in headless Chromium, and what it said to the server: all requests are read, none is changed. */
import { mkdirSync } from 'node:fs';
import { join } from 'node:path';
import { fileURLToPath } from 'node:url';

import { fromBinary } from '@bufbuild/protobuf';
import { chromium, type Browser, type BrowserContextOptions, type Locator, type Page, type Request } from 'playwright-core';

import {
  OpenSessionRequestSchema,
  OpenSessionResponseSchema,
  UpdateSessionRequestSchema,
  type Camera,
  type OutputSettings,
  type RenderSettings,
} from '../../src/generated/lumisphere/v1alpha1/rendering_pb';
import { firstMessage } from './server';

const SCREENSHOTS = fileURLToPath(new URL('../../screenshots', import.meta.url));
/** Nothing of this browser's own may ask anything of anybody. */
const FLAGS = [
  '--no-sandbox',
  '--disable-gpu',
  '--disable-quic',
  '--no-first-run',
  '--disable-background-networking',
  '--disable-component-update',
  '--disable-sync',
];

const PATIENCE_MILLIS = 60_000;

/** Room for all that a large screen shows; few pixels, for software adapters. */
export const VIEWPORT = { width: 800, height: 520 };

/** `flags`: more than the usual ones. */
export async function startBrowser(flags: readonly string[] = []): Promise<Browser> {
  return chromium.launch({ executablePath: process.env['CHROMIUM'] ?? '/usr/bin/chromium', headless: true, args: [...FLAGS, ...flags] });
}

/** What a page shows at once after the pointer moved, as PNG: the last frame, and its warp where there is one. */
export interface Moment {
  readonly frame: Uint8Array;
  readonly warped: Uint8Array | undefined;
  /** Milliseconds in which the page took the move, its warp included. */
  readonly millis: number;
}

/** What a session was told to show. */
interface Asked {
  readonly camera?: Camera;
  readonly settings?: RenderSettings;
  readonly output?: OutputSettings;
}

export class ViewerPage {
  /** URLs asked for, without those that name data of the page's own. */
  readonly requests: string[] = [];
  /** Errors of the page, breaches of its policy among them. */
  readonly complaints: string[] = [];
  /** In the order of their requests. */
  private readonly openings: { readonly asked: Asked; session: string }[] = [];
  private readonly updates = new Map<string, Asked>();

  private constructor(readonly page: Page) {
    page.on('pageerror', (error) => this.complaints.push(error.message));
    page.on('console', (message) => {
      if (message.type() === 'error') this.complaints.push(message.text());
    });
    page.on('request', (request) => {
      if (!/^(blob|data):/.test(request.url())) this.requests.push(request.url());
      const message = firstMessage(request.postDataBuffer() ?? Buffer.alloc(0));
      if (message === undefined) return;
      if (request.url().endsWith('/OpenSession')) {
        const { open } = fromBinary(OpenSessionRequestSchema, message);
        const opening = { asked: known({ settings: open?.settings, output: open?.output }), session: '' };
        this.openings.push(opening);
        void nameSession(request, opening);
      }
      if (request.url().endsWith('/UpdateSession')) {
        const { sessionId, pose, settings } = fromBinary(UpdateSessionRequestSchema, message);
        const news = known({ camera: pose?.camera, settings: settings?.settings, output: settings?.output });
        this.updates.set(sessionId, { ...this.updates.get(sessionId), ...news });
      }
    });
  }

  static async open(browser: Browser, url: string, options: BrowserContextOptions = {}): Promise<ViewerPage> {
    const context = await browser.newContext({ viewport: VIEWPORT, ...options });
    context.setDefaultTimeout(PATIENCE_MILLIS);
    const viewer = new ViewerPage(await context.newPage());
    await viewer.page.goto(url);
    return viewer;
  }

  async close(): Promise<void> {
    await this.page.context().close();
  }

  /** Of the newest session, or of the one opened so many before it: what its picture must show. */
  asked(before = 0): Required<Asked> {
    const opening = this.openings.at(-1 - before);
    const { camera, settings, output } = { ...opening?.asked, ...this.updates.get(opening?.session ?? '') };
    if (!camera || !settings || !output) throw new Error('no session was opened, or its pose is not known');
    return { camera, settings, output };
  }

  /** Until every picture shows the newest pose in full, with the newest settings. */
  async isStill(): Promise<void> {
    await this.page.waitForFunction(() => {
      const panes = [...document.querySelectorAll<HTMLElement>('.pane')];
      const isLive = document.querySelector('.status')?.getAttribute('data-phase') === 'live';
      return (
        isLive && panes.length > 0 && panes.every(({ dataset }) => dataset['final'] === 'true' && dataset['shown'] === dataset['pose'])
      );
    });
  }

  /** The next frame after this moment has come, and the last one is there. */
  async becomesStillAfter(act: () => Promise<unknown>, pane = 0): Promise<void> {
    const element = this.page.locator('.pane').nth(pane);
    const before = await element.getAttribute('data-frame');
    await act();
    await this.page.waitForFunction(
      ([index, frame]) => document.querySelectorAll<HTMLElement>('.pane')[index]?.dataset['frame'] !== frame,
      [pane, before] as const,
    );
    await this.isStill();
  }

  /** The control of this name that is shown. */
  field(name: string): Locator {
    return this.page.getByLabel(name, { exact: true }).filter({ visible: true });
  }

  /** Types a number into the field of this name. */
  async setNumber(name: string, value: number): Promise<void> {
    await this.field(name).fill(String(value));
    await this.field(name).blur();
  }

  async drag(dx: number, dy: number): Promise<void> {
    const box = await this.page.locator('.stage').boundingBox();
    if (box === null) throw new Error('no stage');
    const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
    await this.page.mouse.move(x, y);
    await this.page.mouse.down();
    await this.page.mouse.move(x + dx, y + dy, { steps: 8 });
    await this.page.mouse.up();
  }

  /**
   * Moves the pointer over the stage at once. What the page shows is read while it handles the move, before it can take anything from the
   * server.
   */
  async dragAtOnce(dx: number, dy: number): Promise<Moment> {
    const box = await this.page.locator('.stage').boundingBox();
    if (box === null) throw new Error('no stage');
    const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
    await this.page.mouse.move(x, y);
    await this.page.mouse.down();
    const moment = this.page.evaluate(
      () =>
        new Promise<{ frame: string; warped: string | undefined; millis: number }>((told) => {
          let begun = 0;
          window.addEventListener('pointermove', () => (begun = performance.now()), { capture: true, once: true });
          const after = (): void => {
            const canvas = (kind: string) =>
              document.querySelector<HTMLCanvasElement>(`canvas.${kind}:not([hidden])`)?.toDataURL('image/png');
            const warped = canvas('warp');
            told({ millis: performance.now() - begun, frame: canvas('frame')!, warped });
          };
          // After the stage has it.
          window.addEventListener('pointermove', after, { once: true });
          document.documentElement.dataset['watched'] = 'true';
        }),
    );
    await this.page.locator('[data-watched]').waitFor({ state: 'attached' });
    await this.page.mouse.move(x + dx, y + dy);
    const { frame, warped, millis } = await moment;
    await this.page.evaluate(() => delete document.documentElement.dataset['watched']);
    await this.page.mouse.up();
    return { frame: fromUrl(frame), warped: warped === undefined ? undefined : fromUrl(warped), millis };
  }

  /** Pixels of a picture that are not those of an encoded image; all of them where sizes differ. `spoil` changes one pixel before. */
  async differingPixels(image: Uint8Array, pane = 0, spoil = false): Promise<number> {
    return this.page.evaluate(
      async ([base64, index, spoiled]) => {
        const canvas = document.querySelectorAll<HTMLCanvasElement>('canvas.frame')[index]!;
        const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
        const bitmap = await createImageBitmap(new Blob([bytes]), { colorSpaceConversion: 'none' });
        const { width, height } = canvas;
        if (bitmap.width !== width || bitmap.height !== height) return width * height;
        const other = new OffscreenCanvas(width, height).getContext('2d')!;
        other.drawImage(bitmap, 0, 0);
        const shown = new Uint32Array(canvas.getContext('2d')!.getImageData(0, 0, width, height).data.buffer);
        const wanted = new Uint32Array(other.getImageData(0, 0, width, height).data.buffer);
        if (spoiled) wanted[wanted.length >> 1]! ^= 0x010000;
        return shown.reduce((count, pixel, i) => count + (pixel === wanted[i] ? 0 : 1), 0);
      },
      [Buffer.from(image).toString('base64'), pane, spoil] as const,
    );
  }

  /** Of two encoded images of one size: the mean difference of their channels, of 255. */
  async meanDifference(first: Uint8Array, second: Uint8Array): Promise<number> {
    return this.page.evaluate(
      async (images) => {
        const pixels = async (base64: string): Promise<Uint8ClampedArray> => {
          const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (c) => c.charCodeAt(0))]));
          const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext('2d')!;
          context.drawImage(bitmap, 0, 0);
          return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
        };
        const [a, b] = [await pixels(images[0]!), await pixels(images[1]!)];
        if (a.length !== b.length) throw new Error('images of different sizes');
        return a.reduce((sum, value, i) => sum + Math.abs(value - b[i]!), 0) / a.length;
      },
      [first, second].map((image) => Buffer.from(image).toString('base64')),
    );
  }

  /** Red, green and blue codes of an encoded image, row by row. */
  async codes(image: Uint8Array): Promise<number[]> {
    return this.page.evaluate(async (base64) => {
      const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
      const bitmap = await createImageBitmap(new Blob([bytes]), { colorSpaceConversion: 'none' });
      const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext('2d')!;
      context.drawImage(bitmap, 0, 0);
      const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
      return Array.from(data.filter((_, i) => i % 4 !== 3));
    }, Buffer.from(image).toString('base64'));
  }

  /** The picture as PNG bytes. */
  async picture(pane = 0): Promise<Uint8Array> {
    const url = await this.page
      .locator('canvas.frame')
      .nth(pane)
      .evaluate((canvas: HTMLCanvasElement) => canvas.toDataURL('image/png'));
    return fromUrl(url);
  }

  /** Kept, to be looked at. */
  async screenshot(name: string): Promise<void> {
    mkdirSync(SCREENSHOTS, { recursive: true });
    await this.page.screenshot({ path: join(SCREENSHOTS, `${name}.png`) });
  }
}

/** The bytes of a data URL. */
function fromUrl(url: string): Uint8Array {
  return Buffer.from(url.slice(url.indexOf(',') + 1), 'base64');
}

async function nameSession(request: Request, opening: { session: string }): Promise<void> {
  const answer = await request.response();
  const message = firstMessage((await answer?.body()) ?? Buffer.alloc(0));
  if (message !== undefined) opening.session = fromBinary(OpenSessionResponseSchema, message).sessionId;
}

/** Without what is undefined. */
function known(asked: { [K in keyof Asked]: Asked[K] | undefined }): Asked {
  return Object.fromEntries(Object.entries(asked).filter(([, value]) => value !== undefined));
}
