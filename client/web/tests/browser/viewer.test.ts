/**
 * The viewer as a person uses it. One server and one browser for all; every picture that is compared is compared pixel for pixel with
 * Rendering.RenderFrame of the camera and settings that the page sent.
 */
import { readFileSync } from 'node:fs';

import type { Browser } from 'playwright-core';
import { afterAll, beforeAll, describe, expect, test } from 'vitest';

import {
  Encoding,
  OffsetSurfaceLightFieldSettings_Blend as Blend,
  OffsetSurfaceLightFieldSettings_Component as Component,
  OffsetSurfaceLightFieldSettings_Gloss_Order as Order,
  OffsetSurfaceLightFieldSettings_Refraction_Body as Body,
} from '../../src/generated/lumisphere/v1alpha1/rendering_pb';
import { apart } from './colours';
import { readExr, type Radiance } from './exr';
import { startBrowser, VIEWPORT, ViewerPage } from './page';
import { Server } from './server';

/** How long somebody drags on and on: 10 for the figures in docs/measurements.md. */
const DRAG_MINUTES = Number(process.env['DRAG_MINUTES'] ?? 0);
/** For what takes long on a software adapter. */
const SMALL = { width: 400, height: 300 };
/** The same, with room for the settings beside it. */
const LOW = { width: 800, height: 320 };

const server = new Server();
let browser: Browser;

beforeAll(async () => {
  await server.start();
  server.fill();
  browser = await startBrowser();
});

afterAll(async () => {
  await browser?.close();
  await server.remove();
});

/** Pixels in which a picture differs from RenderFrame of what its session was asked. */
async function wrongPixels(viewer: ViewerPage, dataset: string, before = 0, pane = 0): Promise<number> {
  const { camera, settings, output } = viewer.asked(before);
  const frame = await server.renderFrame(dataset, camera, settings, { ...output, wantProvenance: false, wantDepth: false });
  return viewer.differingPixels(frame.color, pane);
}

/** The picture becomes what RenderFrame shows: another frame of the same pose may be on its way. */
async function seen(viewer: ViewerPage, dataset: string, before = 0, pane = 0): Promise<void> {
  await expect.poll(() => wrongPixels(viewer, dataset, before, pane), { timeout: 20_000, interval: 250 }).toBe(0);
}

function dot(a: { x: number; y: number; z: number }, b: { x: number; y: number; z: number }): number {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

function address(viewer: ViewerPage): URLSearchParams {
  return new URLSearchParams(new URL(viewer.page.url()).hash.slice(1));
}

describe('a person', () => {
  let viewer: ViewerPage;

  beforeAll(async () => {
    viewer = await ViewerPage.open(browser, server.url);
  });

  test('sees all datasets, with pictures of those that have one', async () => {
    await viewer.page.waitForFunction(() => document.querySelectorAll('.thumbnail img').length === 2);
    expect(await viewer.page.locator('.card .name').allTextContents()).toEqual(['empty', 'map', 'patchwork', 'seen']);
    expect(await viewer.page.locator('a.card').count()).toBe(2);
    await viewer.screenshot('list');
  });

  test('opens one by a click and sees what RenderFrame shows', async () => {
    await viewer.page.getByRole('link', { name: 'patchwork' }).click();
    await viewer.isStill();
    await seen(viewer, 'patchwork');
    await viewer.screenshot('live');
  });

  test('begins with the view that the command line’s orbit begins with', async () => {
    const { width, height } = (await viewer.page.locator('.pictures').boundingBox())!;
    const orbit = (azimuth: number): Buffer => server.orbitPicture('patchwork', Math.floor(width), Math.floor(height), azimuth);
    const picture = await viewer.picture();
    // The same camera but for f32's rounding, of both, and JPEG's.
    expect(await viewer.meanDifference(picture, orbit(0))).toBeLessThan(2);
    expect(await viewer.meanDifference(picture, orbit(5))).toBeGreaterThan(4);
  });

  test('is not told that other pictures are the same', async () => {
    const { camera, settings, output } = viewer.asked();
    const frame = await server.renderFrame('patchwork', camera, settings, output);
    expect(await viewer.differingPixels(frame.color, 0, true)).toBe(1);
    const elsewhere = { ...camera, pose: { ...camera.pose!, position: { ...camera.pose!.position!, x: camera.pose!.position!.x + 0.2 } } };
    const other = await server.renderFrame('patchwork', elsewhere, settings, output);
    expect(await viewer.differingPixels(other.color)).toBeGreaterThan(1000);
  });

  test('drags, and the picture follows', async () => {
    const before = await viewer.picture();
    const azimuth = Number(address(viewer).get('az'));
    await viewer.becomesStillAfter(() => viewer.drag(100, 0));
    await seen(viewer, 'patchwork');
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    // Half a turn for the shorter side; what is seen goes with the pointer, so the eye goes the other way.
    const { width, height } = (await viewer.page.locator('.stage').boundingBox())!;
    await expect.poll(() => Number(address(viewer).get('az')) - azimuth).toBeCloseTo((-180 * 100) / Math.min(width, height), 3);
  });

  test('goes nearer by the wheel, shifts with shift, turns by keys, and resets', async () => {
    const stage = viewer.page.locator('.stage');
    const distance = Number(address(viewer).get('r'));
    const target = address(viewer).get('at');
    await stage.hover();
    await viewer.becomesStillAfter(() => viewer.page.mouse.wheel(0, -300));
    await expect.poll(() => Number(address(viewer).get('r')) / distance).toBeCloseTo(Math.exp(-0.3), 5);
    await viewer.page.keyboard.down('Shift');
    await viewer.becomesStillAfter(() => viewer.drag(40, 30));
    await viewer.page.keyboard.up('Shift');
    await expect.poll(() => address(viewer).get('at')).not.toBe(target);
    await stage.focus();
    const elevation = Number(address(viewer).get('el'));
    await viewer.becomesStillAfter(() => viewer.page.keyboard.press('ArrowUp'));
    await expect.poll(() => Number(address(viewer).get('el'))).toBeGreaterThan(elevation + 1);
    await seen(viewer, 'patchwork');
    await viewer.becomesStillAfter(() => viewer.page.keyboard.press('r'));
    await expect.poll(() => [address(viewer).get('az'), address(viewer).get('el')]).toEqual(['0', '25']);
  });

  test('flies: dragging turns the head, keys move along the gaze', async () => {
    const stage = viewer.page.locator('.stage');
    await stage.focus();
    await viewer.page.keyboard.press('f');
    const start = viewer.asked().camera.pose!;
    await viewer.becomesStillAfter(() => viewer.drag(60, 0));
    const turned = viewer.asked().camera.pose!;
    for (const axis of ['x', 'y', 'z'] as const) expect(turned.position![axis]).toBeCloseTo(start.position![axis], 4);
    // What is seen goes right: the head turned left, so its back turned right.
    expect(dot(turned.backward!, start.right!)).toBeGreaterThan(0.03);
    await viewer.becomesStillAfter(() => viewer.page.keyboard.press('w'));
    const { position } = viewer.asked().camera.pose!;
    const step = { x: position!.x - turned.position!.x, y: position!.y - turned.position!.y, z: position!.z - turned.position!.z };
    // Along the gaze and no other way.
    expect(-dot(step, turned.backward!) / Math.hypot(step.x, step.y, step.z)).toBeCloseTo(1, 3);
    await seen(viewer, 'patchwork');
    await viewer.page.keyboard.press('f');
    await viewer.becomesStillAfter(() => viewer.page.keyboard.press('r'));
  });

  test('changes a setting, and the picture shows it', async () => {
    const before = await viewer.picture();
    await viewer.becomesStillAfter(() => viewer.field('Component').selectOption('mirror'));
    const { camera, settings, output } = viewer.asked();
    const mirror = settings.representation;
    if (mirror.case !== 'offsetSurfaceLightField') throw new Error('another kind');
    expect([mirror.value.component, mirror.value.blend]).toEqual([Component.MIRROR, Blend.CORRECTED]);
    const frame = await server.renderFrame('patchwork', camera, settings, output);
    expect(await viewer.differingPixels(frame.color)).toBe(0);
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    await expect.poll(() => address(viewer).get('component')).toBe('mirror');
  });

  test('is told what the server refuses, and goes on', async () => {
    // A glossy frame takes long on a software adapter: a small one.
    await viewer.becomesStillAfter(() => viewer.page.setViewportSize(SMALL));
    await viewer.becomesStillAfter(async () => {
      await viewer.field('Component').selectOption('glossy');
      await viewer.setNumber('Passes at rest', 1);
    });
    const text = viewer.field('BRDF');
    const good = await text.inputValue();
    await text.fill('{"model": "rubber"}');
    await text.blur();
    await viewer.page.getByRole('alert').getByText('rubber').waitFor();
    await viewer.screenshot('refused');
    await viewer.becomesStillAfter(async () => {
      await text.fill(good);
      await text.blur();
      await viewer.field('Exposure, stops').fill('-1');
    });
    expect(await viewer.page.getByRole('alert').isVisible()).toBe(false);
    await seen(viewer, 'patchwork');
    await viewer.becomesStillAfter(() => viewer.field('Component').selectOption('mirror'));
    await viewer.becomesStillAfter(() => viewer.page.setViewportSize(VIEWPORT));
  });

  test('sends a link that shows another the same view', async () => {
    await viewer.becomesStillAfter(() => viewer.drag(-37, 21));
    await viewer.page.context().grantPermissions(['clipboard-read', 'clipboard-write']);
    await viewer.page.getByRole('button', { name: 'Copy link' }).click();
    await viewer.page.getByRole('alert').getByText('The link is copied.').waitFor();
    const other = await ViewerPage.open(browser, await viewer.page.evaluate(() => navigator.clipboard.readText()));
    await other.isStill();
    expect(await other.differingPixels(await viewer.picture())).toBe(0);
    await other.close();
  });

  test('compares two settings, each of which is right', async () => {
    await viewer.field('Compare').selectOption('wipe');
    await viewer.isStill();
    await viewer.page.getByRole('button', { name: 'B', exact: true }).click();
    await viewer.becomesStillAfter(() => viewer.field('Component').selectOption('reconstruction'), 1);
    await seen(viewer, 'patchwork', 1, 0);
    await seen(viewer, 'patchwork', 0, 1);
    expect(await viewer.differingPixels(await viewer.picture(0), 1)).toBeGreaterThan(1000);
    await viewer.screenshot('wipe');
    await expect.poll(() => address(viewer).get('split')).toBe('wipe');
    const other = await ViewerPage.open(browser, viewer.page.url());
    await other.isStill();
    expect(await other.differingPixels(await viewer.picture(0), 0)).toBe(0);
    expect(await other.differingPixels(await viewer.picture(1), 1)).toBe(0);
    await other.close();
    await viewer.field('Compare').selectOption('side');
    await viewer.isStill();
    await viewer.becomesStillAfter(() => viewer.drag(30, 10));
    await seen(viewer, 'patchwork', 1, 0);
    await seen(viewer, 'patchwork', 0, 1);
    await viewer.screenshot('side');
    await viewer.field('Compare').selectOption('none');
    await viewer.isStill();
  });

  async function saved(name: string): Promise<Buffer> {
    const [download] = await Promise.all([viewer.page.waitForEvent('download'), viewer.page.getByRole('button', { name }).click()]);
    return readFileSync((await download.path())!);
  }

  /** The most by which a code of the picture is not that of this radiance on a screen. */
  async function farthestCode({ rgb }: Radiance, lightOf: (radiance: number) => number): Promise<number> {
    const codes = await viewer.codes(await viewer.picture());
    expect(codes.length).toBe(rgb.length);
    const encoded = (y: number): number => (y <= 0.0031308 ? 12.92 * y : 1.055 * Math.pow(y, 1 / 2.4) - 0.055);
    return codes.reduce((most, code, i) => Math.max(most, Math.abs(code - 255 * encoded(Math.min(lightOf(rgb[i]!), 1)))), 0);
  }

  test('saves the still as PNG and as EXR', async () => {
    const png = await saved('Save PNG');
    await viewer.becomesStillAfter(() => viewer.field('Encoding').selectOption('png'));
    expect(await viewer.differingPixels(png)).toBe(0);
    const radiance = readExr(await saved('Save EXR'));
    // Unexposed, where the picture is half as bright; rounding is half a code.
    expect(viewer.asked().output.exposureStops).toBe(-1);
    expect(await farthestCode(radiance, (light) => light / 2)).toBeLessThan(0.51);
    expect(radiance.rgb.reduce((count, light) => count + (light > 0.01 ? 1 : 0), 0)).toBeGreaterThan(10_000);
  });

  test('looks through another lens, and by an exposure that never clips', async () => {
    const before = await viewer.picture();
    await viewer.becomesStillAfter(() => viewer.field('Field of view, °').fill('70'));
    const { widthPx, heightPx, focalXPx } = viewer.asked().camera.intrinsics!;
    // Across the shorter side.
    expect(Math.min(widthPx, heightPx) / 2 / focalXPx).toBeCloseTo(Math.tan((35 * Math.PI) / 180), 5);
    await seen(viewer, 'patchwork');
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    const clipping = await viewer.picture();
    await viewer.becomesStillAfter(() => viewer.field('Exposure γ').fill('2.5'));
    expect(viewer.asked().output.exposureGamma).toBe(2.5);
    await seen(viewer, 'patchwork');
    expect(await viewer.differingPixels(clipping)).toBeGreaterThan(1000);
    const radiance = readExr(await saved('Save EXR'));
    expect(await farthestCode(radiance, (light) => 1 - Math.exp(-2.5 * 0.5 * light))).toBeLessThan(0.51);
    await viewer.becomesStillAfter(() => viewer.field('Exposure γ').fill('0'));
    await viewer.becomesStillAfter(() => viewer.field('Field of view, °').fill('40'));
    expect(await viewer.differingPixels(before)).toBe(0);
  });

  test('sees how fast frames come, how late, how large, and from the cache', async () => {
    await viewer.drag(20, 0);
    await viewer.drag(-20, 0);
    const graphs = viewer.page.locator('.graphs > div');
    const shown = [/^Frames\/s[1-9]\d*$/, /^Latency[1-9]\d* ms$/, /^Transfer[1-9][\d.]* [kM]B\/s$/, /^Cache hits(\d+) %$/];
    for (const [i, text] of shown.entries()) await expect.poll(() => graphs.nth(i).textContent()).toMatch(text);
    // A line has points in columns side by side.
    const columns = (i: number): Promise<number> =>
      graphs
        .nth(i)
        .locator('canvas')
        .evaluate((canvas: HTMLCanvasElement) => {
          const { width, height } = canvas;
          const { data } = canvas.getContext('2d')!.getImageData(0, 0, width, height);
          return Array.from({ length: width }, (_, x) => x).filter((x) =>
            Array.from({ length: height }, (_, y) => y).some((y) => data[4 * (y * width + x) + 3]! > 0),
          ).length;
        });
    for (const i of shown.keys()) await expect.poll(() => columns(i)).toBeGreaterThan(2);
    await viewer.isStill();
  });

  test('is sent H.264 in motion and PNG at rest, both right', async () => {
    await viewer.becomesStillAfter(() => viewer.field('Encoding').selectOption('h264'));
    const truth = async (): Promise<Buffer> => {
      const { camera, settings, output } = viewer.asked();
      return Buffer.from((await server.renderFrame('patchwork', camera, settings, { ...output, encoding: Encoding.PNG })).color);
    };
    // 4:2:0 and quantised; another view is far away.
    const isVideoOf = async (picture: Uint8Array): Promise<void> => {
      await expect.poll(async () => viewer.meanDifference(await viewer.picture(), picture), { timeout: 20_000 }).toBeLessThan(3);
    };
    await isVideoOf(await truth());
    const before = await truth();
    await viewer.becomesStillAfter(() => viewer.drag(90, 10));
    await isVideoOf(await truth());
    expect(await viewer.meanDifference(await viewer.picture(), before)).toBeGreaterThan(6);
    await viewer.screenshot('h264');
    await viewer.becomesStillAfter(() => viewer.field('At rest').selectOption('png'));
    await viewer.becomesStillAfter(() => viewer.drag(-30, 5));
    await expect.poll(async () => viewer.differingPixels(await truth()), { timeout: 20_000 }).toBe(0);
    await viewer.field('At rest').selectOption('same');
    await viewer.becomesStillAfter(() => viewer.field('Encoding').selectOption('png'));
    // To where it was: what the warp below is judged by depends on the view's highlights.
    await viewer.becomesStillAfter(() => viewer.drag(-60, -15));
  });

  test('sees where pixels come from', async () => {
    const overlay = viewer.page.locator('canvas.overlay');
    expect(await overlay.isVisible()).toBe(false);
    await viewer.becomesStillAfter(() => viewer.field('Provenance').selectOption('samples'));
    expect(await overlay.isVisible()).toBe(true);
    const colours = await overlay.evaluate((canvas: HTMLCanvasElement) => {
      const data = canvas.getContext('2d')!.getImageData(0, 0, canvas.width, canvas.height).data;
      return new Set(new Uint32Array(data.buffer)).size;
    });
    // Background and several of the 16 sample points.
    expect(colours).toBeGreaterThan(3);
    await viewer.screenshot('provenance');
    await viewer.field('Provenance').selectOption('none');
    expect(await overlay.isVisible()).toBe(false);
  });

  test('sees the last frame warped to the newest pose while the server lets it wait', async () => {
    await viewer.becomesStillAfter(() => viewer.field('While waiting').selectOption('depth'));
    const warp = viewer.page.locator('canvas.warp');
    const before = await viewer.picture();
    server.pause();
    await viewer.drag(30, -8);
    await warp.waitFor({ state: 'visible' });
    const warped = await viewer.page.locator('.pictures').screenshot();
    server.resume();
    await viewer.isStill();
    expect(await warp.isVisible()).toBe(false);
    await seen(viewer, 'patchwork');
    const truth = await viewer.picture();
    // What only the new pose sees, and what moves with the eye, cannot be right.
    expect(await viewer.meanDifference(warped, truth)).toBeLessThan(0.5 * (await viewer.meanDifference(before, truth)));
    await viewer.becomesStillAfter(() => viewer.field('While waiting').selectOption('off'));
  });

  test('keeps the view when the server is killed and comes back on its port', async () => {
    await server.kill();
    await viewer.page.getByRole('alert').getByText('Trying again').waitFor();
    expect(await viewer.page.locator('.status').textContent()).toBe('reconnecting');
    await viewer.screenshot('reconnecting');
    // Moved meanwhile: the pose that is newest then is what comes back.
    const before = await viewer.picture();
    await viewer.drag(80, 20);
    await server.start();
    await viewer.isStill();
    await seen(viewer, 'patchwork');
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    expect(await viewer.page.getByRole('alert').isVisible()).toBe(false);
    await viewer.becomesStillAfter(() => viewer.drag(-50, 0));
    await seen(viewer, 'patchwork');
  });

  test(
    'drags for long, and neither the page nor the server grows',
    async () => {
      const cdp = await viewer.page.context().newCDPSession(viewer.page);
      const held = async (): Promise<{ objects: number; bytes: number; server: number }> => {
        await cdp.send('HeapProfiler.collectGarbage');
        const { usedSize, backingStorageSize } = await cdp.send('Runtime.getHeapUsage');
        return { objects: usedSize, bytes: backingStorageSize, server: server.residentBytes() ?? 0 };
      };
      const drags = async (count: number): Promise<void> => {
        for (let i = 0; i < count; i++) await viewer.drag(i % 2 ? 60 : -60, i % 3 ? 8 : -16);
      };
      await viewer.becomesStillAfter(() => drags(10));
      const before = await held();
      const begun = performance.now();
      const frame = (): Promise<string | null> => viewer.page.locator('.pane').getAttribute('data-frame');
      const first = Number(await frame());
      // Thirty at least; more for as many minutes as are asked for.
      for (let minutes = 0, told = 0; told === 0 || minutes < DRAG_MINUTES; told++) {
        await viewer.becomesStillAfter(() => drags(30));
        const now = await held();
        minutes = (performance.now() - begun) / 60_000;
        const frames = Number(await frame()) - first;
        if (DRAG_MINUTES > 0) console.log(JSON.stringify({ minutes: Number(minutes.toFixed(2)), frames, ...now }));
        // Frames are kilobytes each, thousands in ten minutes, and must not stay; a megabyte is room for the browser's own tables.
        expect(now.bytes - before.bytes).toBeLessThan(5e4);
        expect(now.objects - before.objects).toBeLessThan(1e6);
        // All pages are there since the first drags. What a software adapter holds comes and goes by thirty megabytes; a frame that stays
        // takes one or two.
        expect(now.server - before.server).toBeLessThan(64 << 20);
      }
      await seen(viewer, 'patchwork');
    },
    90_000 + 90_000 * DRAG_MINUTES,
  );

  test('goes back to the list, and the session is closed', async () => {
    const closed = (): number => viewer.requests.filter((url) => url.endsWith('/CloseSession')).length;
    const before = closed();
    await viewer.page.getByRole('link', { name: 'Datasets' }).click();
    await viewer.page.getByRole('link', { name: 'map' }).waitFor();
    expect(closed()).toBe(before + 1);
  });

  test('has caused no complaint of the browser but those of the killed server, and no request to anybody else', async () => {
    expect(
      viewer.complaints.filter(
        (text) => !/ERR_CONNECTION_REFUSED|ERR_INCOMPLETE_CHUNKED|ERR_EMPTY_RESPONSE|ERR_CONNECTION_RESET/.test(text),
      ),
    ).toEqual([]);
    expect([...new Set(viewer.requests.map((url) => new URL(url).origin))]).toEqual([server.url]);
    await viewer.close();
  });
});

describe('a picture of several passes', () => {
  test('is refined at rest, and says how far it is', async () => {
    const glossy = '#d=patchwork&component=glossy&blend=normal&directions=16&passes=1';
    const viewer = await ViewerPage.open(browser, `${server.url}/${glossy}`, { viewport: LOW });
    await viewer.isStill();
    expect(await viewer.page.locator('.pane').getAttribute('data-passes')).toBe('1');
    await viewer.page.evaluate(() => {
      const note = document.querySelector('.refining')!;
      const told: string[] = [];
      new MutationObserver(() => note.checkVisibility() && told.push(note.textContent)).observe(note, {
        attributes: true,
        childList: true,
      });
      Object.assign(window, { told });
    });
    await viewer.becomesStillAfter(() => viewer.setNumber('Passes at rest', 64));
    const told = await viewer.page.evaluate(() => (window as unknown as { told: string[] }).told);
    const passes = told.map((text) => Number(/^refining (\d+) \/ 64$/.exec(text)?.[1]));
    expect(passes.length).toBeGreaterThan(0);
    expect(passes.every((n, i) => n > 1 && n < 64 && n >= (passes[i - 1] ?? 0))).toBe(true);
    expect(await viewer.page.locator('.pane').getAttribute('data-passes')).toBe('64');
    expect(await viewer.page.locator('.refining').isVisible()).toBe(false);
    await seen(viewer, 'patchwork');
    await viewer.screenshot('refined');
    expect(viewer.complaints).toEqual([]);
    await viewer.close();
  });
});

describe('light and matter', () => {
  const address = '#d=patchwork&component=full&blend=average&encoding=png&directions=8&passes=1';
  let viewer: ViewerPage;

  beforeAll(async () => {
    viewer = await ViewerPage.open(browser, `${server.url}/${address}`, { viewport: LOW });
    await viewer.isStill();
  });

  afterAll(async () => {
    expect(viewer.complaints).toEqual([]);
    await viewer.close();
  });

  const asked = () => {
    const { representation } = viewer.asked(0).settings;
    if (representation.case !== 'offsetSurfaceLightField') throw new Error('settings of another kind');
    return representation.value;
  };
  const fill = (name: string, value: string) => async () => {
    await viewer.field(name).fill(value);
    await viewer.field(name).blur();
  };

  test('the environment is turned and lamps are added, as RenderFrame shows it', async () => {
    const before = await viewer.picture();
    await viewer.becomesStillAfter(fill('Environment turned, °', '90'));
    expect(asked().relighting?.environmentTurnDeg).toBe(90);
    await seen(viewer, 'patchwork');
    await viewer.becomesStillAfter(fill('Point lights', '2,3,2:40,20,5 -2,3,2:5,20,40'));
    expect(asked().relighting?.pointLights.map((light) => light.intensity?.x)).toEqual([40, 5]);
    await seen(viewer, 'patchwork');
    expect(await viewer.differingPixels(before)).toBeGreaterThan(1000);
    await viewer.screenshot('relit');
  });

  test('every field is as wide as the panel that it is in', async () => {
    const wider = await viewer.page.locator('.panel').evaluate((panel) => {
      const isWider = (box: Element) => box.scrollWidth > box.clientWidth;
      return [panel, ...panel.querySelectorAll('.field:not([hidden])')].filter(isWider).map((box) => box.textContent);
    });
    expect(wider).toEqual([]);
  });

  test("lights of one's own are no preset, and the preset without any puts them out", async () => {
    const presets = viewer.field('Point lights, presets');
    expect(await presets.locator('option:checked').textContent()).toBe('own');
    await viewer.becomesStillAfter(() => presets.selectOption({ label: 'none' }));
    expect(asked().relighting?.pointLights).toEqual([]);
  });

  test('a clear body has its index and is solid or a shell', async () => {
    await viewer.becomesStillAfter(() => viewer.field('Component').selectOption('refraction'));
    await seen(viewer, 'patchwork');
    await viewer.becomesStillAfter(() => viewer.field('Body').selectOption('thin'));
    await viewer.becomesStillAfter(fill('Index of refraction', '2.5'));
    expect([asked().refraction?.index, asked().refraction?.body]).toEqual([2.5, Body.THIN]);
    await seen(viewer, 'patchwork');
  });

  test('a glossy object is integrated in either order', async () => {
    await viewer.becomesStillAfter(() => viewer.field('Component').selectOption('glossy'));
    await seen(viewer, 'patchwork');
    expect(asked().gloss?.order).toBe(Order.BLEND_FIRST);
    const blended = await viewer.picture();
    await viewer.becomesStillAfter(() => viewer.field('Order').selectOption('integrate-first'));
    expect(asked().gloss?.order).toBe(Order.INTEGRATE_FIRST);
    await seen(viewer, 'patchwork');
    expect(await viewer.differingPixels(blended)).toBeGreaterThan(100);
  });
});

describe('ground truth', () => {
  const address = '#d=patchwork&component=full&blend=average&encoding=png&truthPasses=4';
  let viewer: ViewerPage;

  beforeAll(async () => {
    viewer = await ViewerPage.open(browser, `${server.url}/${address}`, { viewport: LOW });
    await viewer.isStill();
  });
  afterAll(() => viewer.close());

  /** What the legend tells, once it is of these pictures: by another formula, from what RenderFrame returns. */
  async function agrees(): Promise<{ mean: number; percentile95: number }> {
    const codes = async (before: number): Promise<number[]> => {
      const { camera, settings, output } = viewer.asked(before);
      return viewer.codes((await server.renderFrame('patchwork', camera, settings, output)).color);
    };
    const expected = apart(await codes(1), await codes(0));
    const told = async (): Promise<number> => Number(await viewer.page.locator('.error-legend').getAttribute('data-mean'));
    await expect.poll(async () => Math.abs((await told()) - expected.mean)).toBeLessThan(1e-3 * (1 + expected.mean));
    const percentile95 = Number(await viewer.page.locator('.error-legend').getAttribute('data-percentile95'));
    expect(Math.abs(percentile95 - expected.percentile95)).toBeLessThan(1e-3 * (1 + expected.percentile95));
    const text = `mean ${expected.mean.toFixed(2)}, 95 % of pixels at most ${expected.percentile95.toFixed(2)}`;
    expect(await viewer.page.locator('.error-legend output').textContent()).toContain(text);
    return expected;
  }

  /** Pixels of the overlay that are not clear; undefined while there is none. */
  async function colouredPixels(): Promise<number | undefined> {
    return viewer.page.locator('canvas.error').evaluate((canvas: HTMLCanvasElement) => {
      if (canvas.width === 0) return undefined;
      const { data } = canvas.getContext('2d')!.getImageData(0, 0, canvas.width, canvas.height);
      return data.reduce((count, value, i) => count + (i % 4 === 3 && value > 0 ? 1 : 0), 0);
    });
  }

  test('is traced for the picture whose source it is, pass by pass', async () => {
    const stored = await viewer.picture();
    await viewer.becomesStillAfter(() => viewer.field('Source').selectOption('truth'));
    expect(viewer.asked().settings.groundTruth).toMatchObject({ pathsPerPixel: 1, passes: 4 });
    expect(await viewer.page.locator('.pane').getAttribute('data-passes')).toBe('4');
    await seen(viewer, 'patchwork');
    expect(await viewer.differingPixels(stored)).toBeGreaterThan(1000);
    // How texels are read changes no truth.
    expect(await viewer.field('Blend').isVisible()).toBe(false);
    expect(await viewer.field('Component').isVisible()).toBe(true);
    await viewer.becomesStillAfter(() => viewer.drag(30, 10));
    await seen(viewer, 'patchwork');
    await viewer.becomesStillAfter(() => viewer.field('Source').selectOption('stored'));
    expect(await viewer.field('Blend').isVisible()).toBe(true);
    await seen(viewer, 'patchwork');
  });

  test('is what B shows after a click, beside A', async () => {
    const click = viewer.page.getByRole('button', { name: 'B: truth of A' });
    expect(await click.isVisible()).toBe(false);
    await viewer.field('Compare').selectOption('wipe');
    await viewer.isStill();
    expect(viewer.asked(0).settings).toEqual(viewer.asked(1).settings);
    await viewer.becomesStillAfter(() => click.click(), 1);
    expect(viewer.asked(1).settings.groundTruth).toBeUndefined();
    expect(viewer.asked(0).settings).toEqual({ ...viewer.asked(1).settings, groundTruth: viewer.asked(0).settings.groundTruth });
    expect(viewer.asked(0).settings.groundTruth?.passes).toBe(4);
    await seen(viewer, 'patchwork', 1, 0);
    await seen(viewer, 'patchwork', 0, 1);
    await viewer.screenshot('truth-wipe');
  });

  test('is how far from A is told pixel by pixel, by keyboard, and in the link', async () => {
    await viewer.field('Compare').focus();
    await viewer.page.keyboard.press('End');
    expect(await viewer.field('Compare').inputValue()).toBe('error');
    await viewer.isStill();
    const { mean } = await agrees();
    expect(mean).toBeGreaterThan(1);
    expect(await colouredPixels()).toBeGreaterThan(1000);
    await viewer.screenshot('error');
    await viewer.becomesStillAfter(() => viewer.drag(-40, 15));
    await viewer.isStill();
    expect((await agrees()).mean).not.toBe(mean);
    await expect.poll(() => new URL(viewer.page.url()).hash).toContain('split=error');
    const other = await ViewerPage.open(browser, viewer.page.url(), { viewport: LOW });
    await other.isStill();
    const told = (page: ViewerPage) => page.page.locator('.error-legend output').textContent();
    await expect.poll(() => told(other)).toBe(await told(viewer));
    await other.close();
  });

  test('or another setting: no error where it is the same, and the error of another blend', async () => {
    await viewer.field('Compare').selectOption('none');
    await viewer.isStill();
    await viewer.field('Compare').selectOption('error');
    await viewer.isStill();
    expect(await agrees()).toEqual({ mean: 0, percentile95: 0 });
    expect(await colouredPixels()).toBe(0);
    await viewer.page.getByRole('button', { name: 'B', exact: true }).click();
    await viewer.becomesStillAfter(() => viewer.field('Blend').selectOption('distance'), 1);
    expect((await agrees()).mean).toBeGreaterThan(0.01);
    expect(await colouredPixels()).toBeGreaterThan(1000);
    expect(viewer.complaints).toEqual([]);
  });
});

describe('on a small screen, with a light scheme', () => {
  test('everything fits 400 pixels, and a finger turns the view', async () => {
    const viewer = await ViewerPage.open(browser, `${server.url}/#d=map`, {
      viewport: { width: 400, height: 700 },
      hasTouch: true,
      isMobile: true,
      colorScheme: 'light',
    });
    await viewer.isStill();
    // Not against the window's own width, which a phone's browser makes as large as the page.
    const contentWidth = (): Promise<number> => viewer.page.evaluate(() => document.scrollingElement!.scrollWidth);
    expect(await contentWidth()).toBe(400);
    const stage = (await viewer.page.locator('.stage').boundingBox())!;
    expect(stage.height).toBeGreaterThan(350);
    await viewer.screenshot('small');

    const cdp = await viewer.page.context().newCDPSession(viewer.page);
    const touch = (type: 'touchStart' | 'touchMove' | 'touchEnd', ...points: [number, number][]): Promise<unknown> =>
      cdp.send('Input.dispatchTouchEvent', { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
    const [x, y] = [stage.x + stage.width / 2, stage.y + stage.height / 2];
    await viewer.becomesStillAfter(async () => {
      await touch('touchStart', [x, y]);
      await touch('touchMove', [x + 50, y]);
      await touch('touchEnd');
    });
    await expect.poll(() => Number(address(viewer).get('az'))).toBeCloseTo((-180 * 50) / stage.width, 3);
    await seen(viewer, 'map');

    const distance = Number(address(viewer).get('r'));
    await viewer.becomesStillAfter(async () => {
      await touch('touchStart', [x - 40, y], [x + 40, y]);
      await touch('touchMove', [x - 80, y], [x + 80, y]);
      await touch('touchEnd');
    });
    await expect.poll(() => Number(address(viewer).get('r'))).toBeCloseTo(distance / 2, 3);

    await viewer.page.getByRole('button', { name: 'Settings' }).click();
    await viewer.becomesStillAfter(() => viewer.field('Show').selectOption('models'));
    expect(await viewer.field('Component').isVisible()).toBe(false);
    await seen(viewer, 'map');
    expect(await contentWidth()).toBe(400);
    await viewer.screenshot('small-settings');
    expect(viewer.complaints).toEqual([]);
    await viewer.close();
  });
});

describe('in a light and in a dark scheme', () => {
  /** Colours of the page, and of its texts those that stand out too little from what is behind them (WCAG 2: 4.5 to 1). */
  async function colours(viewer: ViewerPage): Promise<{ ground: string; faint: string[] }> {
    return viewer.page.evaluate(() => {
      const canvas = new OffscreenCanvas(1, 1).getContext('2d', { willReadFrequently: true })!;
      const codes = (color: string): number[] => {
        canvas.clearRect(0, 0, 1, 1);
        canvas.fillStyle = color;
        canvas.fillRect(0, 0, 1, 1);
        return [...canvas.getImageData(0, 0, 1, 1).data];
      };
      const luminance = ([r, g, b]: number[]): number => {
        const [x, y, z] = [r!, g!, b!].map((c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4));
        return 0.2126 * x! + 0.7152 * y! + 0.0722 * z!;
      };
      const behind = (element: Element | null): number[] => {
        if (element === null) return [255, 255, 255];
        const own = codes(getComputedStyle(element).backgroundColor);
        return own[3] === 255 ? own : behind(element.parentElement);
      };
      const hasText = (element: Element): boolean =>
        element.matches('select, input:not([type=range]), textarea') ||
        [...element.childNodes].some((node) => node.nodeType === Node.TEXT_NODE && node.textContent!.trim() !== '');
      const texts = [...document.body.querySelectorAll('*')].filter((element) => element.checkVisibility() && hasText(element));
      const faint = texts.flatMap((element) => {
        const [a, b] = [luminance(codes(getComputedStyle(element).color)), luminance(behind(element))];
        const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
        return contrast < 4.5 ? [`${element.tagName} ${element.textContent}: ${contrast.toFixed(2)}`] : [];
      });
      if (texts.length < 10) throw new Error(`${texts.length} texts`);
      return { ground: getComputedStyle(document.body).backgroundColor, faint };
    });
  }

  test.each([400, 800, 1440])('everything can be read, %i pixels wide', async (width) => {
    const viewer = await ViewerPage.open(browser, server.url, { viewport: { width, height: 720 }, colorScheme: 'light' });
    const both = async (name: string): Promise<void> => {
      const grounds = [];
      for (const colorScheme of ['light', 'dark'] as const) {
        await viewer.page.emulateMedia({ colorScheme });
        const { ground, faint } = await colours(viewer);
        expect(faint).toEqual([]);
        grounds.push(ground);
        await viewer.screenshot(`${name}-${width}-${colorScheme}`);
      }
      expect(grounds[0]).not.toBe(grounds[1]);
      expect(await viewer.page.evaluate(() => document.scrollingElement!.scrollWidth)).toBe(width);
    };
    // A narrow list's second one is out of sight, and not asked for.
    await viewer.page.locator('.thumbnail img').first().waitFor();
    await both('list');
    await viewer.page.getByRole('link', { name: 'map' }).click();
    await viewer.isStill();
    await both('map');
    expect(viewer.complaints).toEqual([]);
    await viewer.close();
  });
});

describe('by keyboard alone', () => {
  test('a dataset is opened, and every control has a name and is reached in order', async () => {
    const viewer = await ViewerPage.open(browser, server.url);
    await viewer.page.locator('a.card').first().waitFor();
    await viewer.page.keyboard.press('Tab');
    await viewer.page.keyboard.press('Enter');
    await viewer.isStill();
    const seen: string[] = [];
    for (let i = 0; i < 40; i++) {
      await viewer.page.keyboard.press('Tab');
      const name = await viewer.page.evaluate(() => {
        const element = document.activeElement as HTMLInputElement | null;
        if (element === null || element === document.body) return '';
        const named = element.getAttribute('aria-label') ?? element.labels?.[0]?.textContent ?? element.textContent ?? '';
        return named === '' ? `nameless ${element.outerHTML}` : named;
      });
      if (name === '') break;
      seen.push(name);
    }
    expect(seen.slice(0, 7)).toEqual(['Datasets', 'Reset', 'Fly', 'Compare', 'Copy link', 'Settings', 'map, live view']);
    expect(seen.slice(7)).toEqual([
      'Source',
      'Show',
      'Exposure, stops',
      'Exposure γ',
      'Provenance',
      'Field of view, °',
      'Encoding',
      'At rest',
      'Quality',
      'Resolution',
      'Frames/s moving',
      'While waiting',
      'Save PNG',
      'Save EXR',
    ]);
    await viewer.close();
  });
});

describe('a link that cannot be followed', () => {
  test.each([
    ['#d=nobody', 'There is no dataset “nobody”'],
    ['#d=patchwork&v=9', 'has no version 9; there are: 1'],
    ['#d=empty', '“empty” is empty'],
    ['#d=seen', 'observation map'],
    ['#d=patchwork&blend=shiny', 'blend=shiny'],
    ['#nonsense', 'names no dataset'],
  ])('%s says why', async (hash, message) => {
    const viewer = await ViewerPage.open(browser, `${server.url}/${hash}`);
    await viewer.page.getByRole('alert').getByText(message).waitFor();
    await viewer.page.getByRole('link', { name: 'All datasets' }).click();
    await viewer.page.getByRole('link', { name: 'patchwork' }).waitFor();
    await viewer.close();
  });
});
