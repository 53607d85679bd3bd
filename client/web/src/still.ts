/** Saving a still: the view in full size, rendered on its own, as a file. */
import type { Kind, Settings } from './settings';
import { renderFrame, stillMessage, type Camera } from './wire';

const MEDIA_TYPES = { png: 'image/png', exr: 'image/x-exr' } as const;

/** PNG as it is shown; EXR linear and unexposed. */
export async function saveStill(
  dataset: string,
  version: number,
  kind: Kind,
  settings: Settings,
  camera: Camera,
  encoding: 'png' | 'exr',
): Promise<void> {
  const frame = await renderFrame(dataset, version, camera, stillMessage(kind, settings, encoding));
  const url = URL.createObjectURL(new Blob([frame.color as Uint8Array<ArrayBuffer>], { type: MEDIA_TYPES[encoding] }));
  const anchor = document.createElement('a');
  anchor.href = url;
  anchor.download = `${dataset}-${version}.${encoding}`;
  anchor.click();
  // The download has its own hold on the bytes by then.
  window.setTimeout(() => URL.revokeObjectURL(url), 10_000);
}
