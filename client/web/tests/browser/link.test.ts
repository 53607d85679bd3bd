/**
 * The page over links that are long, cut, down for a while, or encrypted. A server and a browser of its own; pictures are compared with
 * Rendering.RenderFrame, past the link.
 */
import type { Browser } from 'playwright-core';
import { afterAll, beforeAll, describe, expect, test } from 'vitest';

import type { Frame } from '../../src/generated/lumisphere/v1alpha1/rendering_pb';
import { startBrowser, ViewerPage } from './page';
import { Proxy } from './proxy';
import { Server } from './server';

/** Each way. */
const DELAY_MILLIS = 50;
/** What docs/measurements.md tells of the warp is asked for. */
const HAS_FIGURES = process.env['WARP_FIGURES'] !== undefined;

const server = new Server(['--session-expiry-seconds', '2']);
let browser: Browser;

beforeAll(async () => {
  await server.start();
  server.fillLightField();
  browser = await startBrowser();
});

afterAll(async () => {
  await browser?.close();
  await server.remove();
});

/** RenderFrame's picture of what the page asked for. */
async function truth(viewer: ViewerPage): Promise<Uint8Array> {
  const { camera, settings, output } = viewer.asked();
  return (await server.renderFrame('patchwork', camera, settings, { ...output, wantDepth: false })).color;
}

/** The picture becomes what RenderFrame shows. */
async function seen(viewer: ViewerPage): Promise<void> {
  await expect.poll(async () => viewer.differingPixels(await truth(viewer)), { timeout: 20_000, interval: 250 }).toBe(0);
}

const calls = (viewer: ViewerPage, method: string): number => viewer.requests.filter((url) => url.endsWith(`/${method}`)).length;

describe('100 ms away', () => {
  let proxy: Proxy;
  let viewer: ViewerPage;

  beforeAll(async () => {
    proxy = new Proxy(server.url, DELAY_MILLIS);
    viewer = await ViewerPage.open(browser, `${await proxy.start()}/#d=patchwork`);
    await viewer.isStill();
  });

  afterAll(async () => {
    await viewer.close();
    await proxy.close();
  });

  test('the picture turns at once, before the server can know of it', async () => {
    expect(viewer.asked().output.wantDepth).toBe(true);
    const before = await viewer.picture();
    const { frame, warped } = await viewer.dragAtOnce(40, -10);
    await viewer.isStill();
    const after = await truth(viewer);
    // No frame of the new pose was there.
    expect(await viewer.meanDifference(frame, before)).toBe(0);
    expect(warped).toBeDefined();
    // What only the new pose sees, and what moves with the eye, cannot be right.
    expect(await viewer.meanDifference(warped!, after)).toBeLessThan(0.5 * (await viewer.meanDifference(before, after)));
    await seen(viewer);
    expect(await viewer.page.locator('canvas.warp').isVisible()).toBe(false);
  });

  test('or stands until the frame comes, where that is wanted', async () => {
    await viewer.becomesStillAfter(() => viewer.field('While waiting').selectOption('off'));
    expect(viewer.asked().output.wantDepth).toBe(false);
    const before = await viewer.picture();
    const { frame, warped } = await viewer.dragAtOnce(40, -10);
    expect(warped).toBeUndefined();
    expect(await viewer.meanDifference(frame, before)).toBe(0);
    await viewer.isStill();
    expect(await viewer.meanDifference(frame, await truth(viewer))).toBeGreaterThan(2);
    await viewer.becomesStillAfter(() => viewer.field('While waiting').selectOption('auto'));
    expect(viewer.asked().output.wantDepth).toBe(true);
  });

  test.runIf(HAS_FIGURES)('figures', async () => {
    const median = (values: number[]): number => values.sort((a, b) => a - b)[values.length >> 1]!;
    const all = [];
    for (const warp of ['depth', 'off']) {
      await viewer.field('While waiting').selectOption(warp);
      await viewer.isStill();
      const millis: number[] = [];
      const differences: number[] = [];
      for (let i = 0; i < 9; i++) {
        const { frame, warped, millis: taken } = await viewer.dragAtOnce(i % 2 ? -40 : 40, 0);
        millis.push(taken);
        await viewer.isStill();
        differences.push(await viewer.meanDifference(warped ?? frame, await truth(viewer)));
      }
      const { camera, settings, output } = viewer.asked();
      const frames: Frame[] = [];
      for (let i = 0; i < 9; i++) frames.push(await server.renderFrame('patchwork', camera, settings, output));
      const { color, depth, widthPx, heightPx } = frames[0]!;
      const micros = (of: 'renderMicros' | 'encodeMicros'): number => median(frames.map(({ timings }) => Number(timings?.[of] ?? 0n)));
      all.push({
        warp,
        moveMillis: median(millis),
        error: median(differences),
        latency: await viewer.page.locator('.graphs dd').nth(1).textContent(),
        size: `${widthPx}x${heightPx}`,
        color: color.length,
        depth: depth.length,
        renderMicros: micros('renderMicros'),
        encodeMicros: micros('encodeMicros'),
      });
    }
    console.log(all.map((figures) => JSON.stringify(figures)).join('\n'));
  });
});

describe('over a link that breaks', () => {
  let proxy: Proxy;
  let viewer: ViewerPage;

  beforeAll(async () => {
    proxy = new Proxy(server.url, 0);
    viewer = await ViewerPage.open(browser, `${await proxy.start()}/#d=patchwork`);
    await viewer.isStill();
  });

  afterAll(async () => {
    await viewer.close();
    await proxy.close();
  });

  /** Until the server has given the session up; then there is a link again. */
  async function forgotten(act: () => Promise<unknown>): Promise<void> {
    proxy.breakDown();
    await expect.poll(() => server.gauge('sessions_active')).toBe(0);
    await act();
    const opened = viewer.page.waitForResponse((answer) => answer.url().endsWith('/OpenSession'));
    proxy.mend();
    await opened;
  }

  test('the server next door is not waited for with a warp', async () => {
    expect(viewer.asked().output.wantDepth).toBe(false);
    expect(await viewer.page.locator('canvas.warp').count()).toBe(0);
  });

  test('a frame that was cut in the middle is asked for again, in the same session', async () => {
    const before = await viewer.picture();
    await viewer.page.locator('.stage').hover();
    const streams = calls(viewer, 'StreamFrames');
    // More than the answers to updates, less than a frame.
    const cut = proxy.cutAfter(6000);
    await viewer.page.mouse.wheel(0, -300);
    await cut;
    await viewer.isStill();
    await seen(viewer);
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    expect(calls(viewer, 'StreamFrames')).toBeGreaterThan(streams);
    expect(calls(viewer, 'OpenSession')).toBe(1);
  });

  test('a session that the server forgot meanwhile is opened anew, with the newest pose', async () => {
    const before = await viewer.picture();
    await forgotten(async () => {
      await viewer.drag(70, 15);
    });
    await viewer.isStill();
    await seen(viewer);
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    expect(calls(viewer, 'OpenSession')).toBe(2);
  });

  test('or with the pose that it had, where nobody moved', async () => {
    await forgotten(() => viewer.page.locator('canvas.frame').evaluate((canvas: HTMLCanvasElement) => (canvas.width = 1)));
    // The picture was wiped: this is a frame of the new session.
    await seen(viewer);
    expect(calls(viewer, 'OpenSession')).toBe(3);
  });

  test('nothing else went wrong', () => {
    expect(viewer.complaints.filter((text) => !text.startsWith('Failed to load resource: net::ERR_'))).toEqual([]);
  });
});

describe('over TLS', () => {
  let trusting: Browser;

  beforeAll(async () => {
    await server.kill();
    trusting = await startBrowser([`--ignore-certificate-errors-spki-list=${server.secure()}`]);
    await server.start();
  });

  afterAll(() => trusting?.close());

  test('a person opens a dataset and drags, and the picture follows', async () => {
    expect(server.url).toMatch(/^https:/);
    const viewer = await ViewerPage.open(trusting, server.url);
    await viewer.page.getByRole('link', { name: 'patchwork' }).click();
    await viewer.isStill();
    await seen(viewer);
    const before = await viewer.picture();
    await viewer.becomesStillAfter(() => viewer.drag(100, 0));
    await seen(viewer);
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    expect([...new Set(viewer.requests.map((url) => new URL(url).origin))]).toEqual([server.url]);
    expect(viewer.complaints).toEqual([]);
    await viewer.close();
  });

  test('a browser that trusts another certificate is not led here', async () => {
    await expect(ViewerPage.open(browser, server.url)).rejects.toThrow('ERR_CERT_AUTHORITY_INVALID');
  });
});
