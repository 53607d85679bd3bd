/** A stream of H.264 into pictures (WebCodecs): one a frame, in order, none held back. */
import type { Frame } from './wire';

/** Baseline, level 5.2: what the server sends at most. */
const CONFIGURATION: VideoDecoderConfig = { codec: 'avc1.42E034', optimizeForLatency: true };

/** Whether this browser can. Without transport security, only pages of the machine itself can. */
export async function canDecodeVideo(): Promise<boolean> {
  if (typeof VideoDecoder === 'undefined') return false;
  return (await VideoDecoder.isConfigSupported(CONFIGURATION)).supported === true;
}

interface Awaited {
  readonly resolve: (picture: VideoFrame) => void;
  readonly reject: (error: Error) => void;
}

export class Video {
  private decoder: VideoDecoder | undefined;
  private awaited: Awaited[] = [];

  /** Every frame, in the order of the stream; the caller closes the picture. After an error the next key frame begins anew. */
  decode(frame: Frame): Promise<VideoFrame> {
    if (frame.isKey) this.decoder ??= this.opened();
    const { decoder } = this;
    if (decoder === undefined) return Promise.reject(new Error('frames before this one are missing'));
    return new Promise((resolve, reject) => {
      const type = frame.isKey ? 'key' : 'delta';
      decoder.decode(new EncodedVideoChunk({ type, timestamp: Number(frame.frameId), data: frame.color as Uint8Array<ArrayBuffer> }));
      this.awaited.push({ resolve, reject });
    });
  }

  /** Nobody waits any more. */
  close(): void {
    this.awaited = [];
    this.fail(new Error('closed'));
  }

  private opened(): VideoDecoder {
    const decoder = new VideoDecoder({
      output: (picture) => {
        const next = this.awaited.shift();
        if (next === undefined) picture.close();
        else next.resolve(picture);
      },
      error: (error) => this.fail(error),
    });
    decoder.configure(CONFIGURATION);
    return decoder;
  }

  private fail(error: Error): void {
    if (this.decoder !== undefined && this.decoder.state !== 'closed') this.decoder.close();
    this.decoder = undefined;
    for (const { reject } of this.awaited.splice(0)) reject(error);
  }
}
