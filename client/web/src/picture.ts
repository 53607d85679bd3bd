/**
 * The frame on the screen: decoded, drawn, and its overlay. One frame is decoded at a time and one waits, the newest: what was overtaken is
 * let go, so that a slow device holds two frames and not a queue. Of a stream all are decoded, since they build on each other.
 */
import type { Size, Viewpoint } from './camera';
import { context2d, make } from './dom';
import { coloured, unpacked, type Overlay } from './provenance';
import { Warp } from './warp';
import { Video } from './video';
import { isVideo, mediaType, type Frame } from './wire';

/** A frame to be shown and what to do once it is. */
interface Waiting {
  readonly frame: Frame;
  /** Of a stream, whose frames are all decoded. */
  readonly picture: Promise<VideoFrame> | undefined;
  readonly shown: () => void;
}

const MOST_BROKEN_STREAMS = 3;

export class Picture {
  readonly element = make('div', { class: 'picture' });
  readonly canvas = make('canvas', { class: 'frame' });
  private readonly overlay = make('canvas', { class: 'overlay' });
  private waiting: Waiting | undefined;
  private isDecoding = false;
  private overlayKind: Overlay | undefined;
  private warp: Warp | undefined;
  private size: Size = { width: 1, height: 1 };

  private readonly video = new Video();
  /** In a row. */
  private brokenStreams = 0;

  /** `broken`: a stream that must begin anew. */
  constructor(
    private readonly failed: (message: string) => void,
    private readonly broken: () => void,
  ) {
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
    this.video.close();
    this.element.remove();
  }

  /** Draws it, unless a newer one comes first. */
  show(frame: Frame, shown: () => void): void {
    const picture = isVideo(frame) ? this.video.decode(frame) : undefined;
    picture?.then(
      () => (this.brokenStreams = 0),
      () => this.beginAnew(),
    );
    // Its error has been heard of.
    void this.waiting?.picture?.then(
      (overtaken) => overtaken.close(),
      () => undefined,
    );
    this.waiting = { frame, picture, shown };
    if (!this.isDecoding) void this.drain();
  }

  /** A browser that says it can and cannot is not asked for ever. */
  private beginAnew(): void {
    this.brokenStreams++;
    if (this.brokenStreams <= MOST_BROKEN_STREAMS) this.broken();
    else this.failed('this browser cannot decode the H.264 that comes; choose another encoding');
  }

  private async drain(): Promise<void> {
    this.isDecoding = true;
    for (let next = this.waiting; next !== undefined; next = this.waiting) {
      this.waiting = undefined;
      try {
        this.draw(next.frame, await this.bitmap(next));
      } catch (error) {
        this.failed(`a frame cannot be shown: ${error instanceof Error ? error.message : String(error)}`);
      }
      next.shown();
    }
    this.isDecoding = false;
  }

  private async bitmap({ frame, picture }: Waiting): Promise<ImageBitmap> {
    if (picture === undefined) {
      const blob = new Blob([frame.color as Uint8Array<ArrayBuffer>], { type: mediaType(frame) });
      return createImageBitmap(blob, { colorSpaceConversion: 'none' });
    }
    const decoded = await picture;
    try {
      // Without the margin to even sides.
      return await createImageBitmap(decoded, 0, 0, frame.widthPx, frame.heightPx);
    } finally {
      decoded.close();
    }
  }

  private draw(frame: Frame, bitmap: ImageBitmap): void {
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
