/**
 * The frame on the screen: decoded, drawn, and its overlay. One frame is decoded at a time and one waits, the newest: what was overtaken is
 * let go, so that a slow device holds two frames and not a queue.
 */
import type { Size, Viewpoint } from './camera';
import { context2d, make } from './dom';
import { coloured, unpacked, type Overlay } from './provenance';
import { Warp } from './warp';
import { mediaType, type Frame } from './wire';

/** A frame to be shown and what to do once it is. */
interface Waiting {
  readonly frame: Frame;
  readonly shown: () => void;
}

export class Picture {
  readonly element = make('div', { class: 'picture' });
  readonly canvas = make('canvas', { class: 'frame' });
  private readonly overlay = make('canvas', { class: 'overlay' });
  private waiting: Waiting | undefined;
  private isDecoding = false;
  private overlayKind: Overlay | undefined;
  private warp: Warp | undefined;
  private size: Size = { width: 1, height: 1 };

  constructor(private readonly failed: (message: string) => void) {
    this.element.append(this.canvas, this.overlay);
  }

  /** Pixels of a still frame: smaller ones are drawn larger. */
  setSize(size: Size): void {
    this.size = size;
  }

  /** Whether each of its pixels is one of the picture's. */
  isFull(frame: Frame): boolean {
    return frame.widthPx === this.size.width && frame.heightPx === this.size.height;
  }

  setOverlay(kind: Overlay | undefined): void {
    this.overlayKind = kind;
    if (kind === undefined) this.overlay.width = 0;
  }

  /** Whether the last frame stands in for the next. */
  setWarp(isOn: boolean): void {
    if (isOn === (this.warp !== undefined)) return;
    this.warp?.close();
    this.warp = undefined;
    if (!isOn) return;
    try {
      this.warp = new Warp();
      this.canvas.after(this.warp.canvas);
    } catch (error) {
      this.failed(`no warp: ${error instanceof Error ? error.message : String(error)}`);
    }
  }

  /** Until the frame of this viewpoint comes. An overlay cannot be warped, so under one nothing is. */
  awaits(view: Viewpoint): void {
    if (this.overlayKind === undefined) this.warp?.show(view, this.size);
  }

  /** What is drawn is what was wanted. */
  hasArrived(): void {
    this.warp?.hide();
  }

  close(): void {
    this.setWarp(false);
    this.element.remove();
  }

  /** Draws it, unless a newer one comes first. */
  show(frame: Frame, shown: () => void): void {
    this.waiting = { frame, shown };
    if (!this.isDecoding) void this.drain();
  }

  private async drain(): Promise<void> {
    this.isDecoding = true;
    for (let next = this.waiting; next !== undefined; next = this.waiting) {
      this.waiting = undefined;
      try {
        await this.draw(next.frame);
      } catch (error) {
        this.failed(`a frame cannot be shown: ${error instanceof Error ? error.message : String(error)}`);
      }
      next.shown();
    }
    this.isDecoding = false;
  }

  private async draw(frame: Frame): Promise<void> {
    const blob = new Blob([frame.color as Uint8Array<ArrayBuffer>], { type: mediaType(frame) });
    const bitmap = await createImageBitmap(blob, { colorSpaceConversion: 'none' });
    // A canvas that is set to the size it has is cleared all the same.
    if (this.canvas.width !== this.size.width || this.canvas.height !== this.size.height) {
      this.canvas.width = this.size.width;
      this.canvas.height = this.size.height;
    }
    context2d(this.canvas).drawImage(bitmap, 0, 0, this.canvas.width, this.canvas.height);
    this.warp?.take(frame, bitmap);
    bitmap.close();
    this.drawOverlay(frame);
  }

  private drawOverlay(frame: Frame): void {
    if (this.overlayKind === undefined || frame.provenance.length === 0) {
      this.overlay.width = 0;
      return;
    }
    const pixels = frame.widthPx * frame.heightPx;
    const rgba = coloured(unpacked(frame.provenance, pixels), this.overlayKind);
    this.overlay.width = frame.widthPx;
    this.overlay.height = frame.heightPx;
    context2d(this.overlay).putImageData(new ImageData(rgba, frame.widthPx, frame.heightPx), 0, 0);
  }
}
