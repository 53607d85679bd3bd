/**
 * The live session of one picture, kept alive: opened, its stream read, poses sent, frames acknowledged; after a broken connection resumed
 * or opened anew, with the newest pose and settings. Nothing queues: one update is on its way, and the next holds only what is newest by
 * then. The calls and the clock are passed in, so that tests can lose, delay and refuse them.
 */

/** What goes up in one call. */
export interface Update<Camera, Change> {
  readonly sequence: number;
  readonly pose?: { readonly id: number; readonly camera: Camera };
  readonly change?: Change;
  readonly acknowledge?: bigint;
}

/** What comes down. */
export type Down<Frame> =
  | { readonly kind: 'opened' }
  | { readonly kind: 'frame'; readonly frame: Frame }
  | { readonly kind: 'status'; readonly message: string };

/** Why a call failed, as far as the session acts on it. */
export type Failure =
  /** The session, or what it shows, is not there. */
  | 'missing'
  /** The request is wrong: trying again is of no use. */
  | 'refused'
  /** Anything that may be better later. */
  | 'unavailable';

/** A call's failure. */
export class CallError extends Error {
  constructor(
    readonly failure: Failure,
    message: string,
  ) {
    super(message);
  }
}

/** The calls; every rejection is a CallError. */
export interface Calls<Camera, Change, Frame> {
  open(change: Change): Promise<string>;
  stream(session: string, signal: AbortSignal): AsyncIterable<Down<Frame>>;
  update(session: string, update: Update<Camera, Change>, signal: AbortSignal): Promise<void>;
  close(session: string): Promise<void>;
}

/** How the session stands. */
export type Phase =
  | { readonly name: 'connecting' }
  | { readonly name: 'live' }
  /** After so many failures in a row. */
  | { readonly name: 'waiting'; readonly failures: number; readonly reason: string }
  | { readonly name: 'failed'; readonly reason: string };

/** Who is told. */
export interface Listener<Frame> {
  phase(phase: Phase): void;
  /** `acknowledge` is to be called once the frame, and with it all before it, is shown. */
  frame(frame: Frame, acknowledge: () => void): void;
  /** A pose or a setting was rejected, or a frame failed; the session goes on. */
  rejected(message: string): void;
}

/** Waits, or less where the signal comes. */
export type Sleep = (millis: number, signal: AbortSignal) => Promise<void>;

const FIRST_WAIT_MILLIS = 250;
const LONGEST_WAIT_MILLIS = 5000;

/** How long to wait after this many failures in a row, from 1; `chance` in [0, 1) spreads clients that lost the same server. */
export function backOffMillis(failures: number, chance: number): number {
  const wait = Math.min(FIRST_WAIT_MILLIS * 2 ** (failures - 1), LONGEST_WAIT_MILLIS);
  return wait * (0.75 + 0.5 * chance);
}

export class Session<Camera, Change, Frame> {
  private id: string | undefined;
  private isLive = false;
  private isSending = false;
  private hasFailed = false;
  private isClosed = false;
  private sequence = 0;
  private poseId = 0;
  private newestPose: { id: number; camera: Camera } | undefined;
  // What the next update holds.
  private pose: { id: number; camera: Camera } | undefined;
  private change: Change | undefined;
  private acknowledged: { session: string; frame: bigint } | undefined;
  private connection = new AbortController();
  private pause = new AbortController();

  constructor(
    private readonly calls: Calls<Camera, Change, Frame>,
    private settings: Change,
    private readonly frameId: (frame: Frame) => bigint,
    private readonly listener: Listener<Frame>,
    private readonly sleep: Sleep,
  ) {
    void this.run();
  }

  /** The latest pose wins. Returns its number, which its frame has, too. */
  setPose(camera: Camera): number {
    this.newestPose = { id: ++this.poseId, camera };
    this.pose = this.newestPose;
    this.flush();
    return this.poseId;
  }

  /** From now on. A session that was refused for its old settings tries again. */
  setSettings(settings: Change): void {
    this.settings = settings;
    this.change = settings;
    if (this.hasFailed) {
      void this.run();
    } else {
      this.flush();
    }
  }

  /** Does not wait any longer to try again. */
  retry(): void {
    if (this.hasFailed) {
      void this.run();
    } else {
      this.pause.abort();
    }
  }

  /** Takes up another stream of the session: this one has stopped bringing anything. */
  reconnect(): void {
    if (this.isLive) this.connection.abort();
  }

  /** Ends it, here and on the server. */
  close(): void {
    this.isClosed = true;
    this.isLive = false;
    this.pause.abort();
    this.connection.abort();
    // The server forgets a session that nobody closes, too.
    if (this.id !== undefined) this.calls.close(this.id).catch(() => undefined);
  }

  private async run(): Promise<void> {
    this.hasFailed = false;
    let failures = 0;
    let isReopening = false;
    while (!this.isClosed) {
      let reason = 'the server ended the stream';
      try {
        this.listener.phase({ name: 'connecting' });
        for await (const message of await this.connected()) {
          if (this.isClosed) return;
          // A session that can be opened and then brings nothing is no success.
          if (message.kind === 'frame') failures = 0;
          isReopening = false;
          this.take(message);
        }
      } catch (error) {
        if (this.isClosed) return;
        const { failure, message } = asCallError(error);
        reason = message;
        if (failure === 'missing' && this.id !== undefined) {
          // Forgotten, as by a server that was restarted: open another, at once, but do not make a loop of it.
          this.id = undefined;
          if (!isReopening) {
            isReopening = true;
            continue;
          }
        } else if (failure !== 'unavailable') {
          this.hasFailed = true;
          this.isLive = false;
          this.listener.phase({ name: 'failed', reason });
          return;
        }
      } finally {
        this.isLive = false;
        // An update on its way is of no use to the next connection, and must not hold it up.
        this.connection.abort();
      }
      if (this.isClosed) return;
      failures += 1;
      const wait = backOffMillis(failures, Math.random());
      this.listener.phase({ name: 'waiting', failures, reason });
      this.pause = new AbortController();
      await this.sleep(wait, this.pause.signal);
    }
  }

  /** The stream of a session that is there: the old one, or a new one. */
  private async connected(): Promise<AsyncIterable<Down<Frame>>> {
    if (this.id === undefined) {
      const settings = this.settings;
      const id = await this.calls.open(settings);
      if (this.isClosed) {
        this.calls.close(id).catch(() => undefined);
        throw new CallError('unavailable', 'closed');
      }
      this.id = id;
      if (this.settings === settings) this.change = undefined;
    }
    this.connection = new AbortController();
    return this.calls.stream(this.id, this.connection.signal);
  }

  private take(message: Down<Frame>): void {
    switch (message.kind) {
      case 'opened':
        this.isLive = true;
        this.listener.phase({ name: 'live' });
        // Frames on their way were lost with the old connection.
        this.pose = this.newestPose;
        this.flush();
        break;
      case 'frame': {
        const session = this.id;
        const frame = this.frameId(message.frame);
        this.listener.frame(message.frame, () => {
          if (session === undefined || session !== this.id) return;
          this.acknowledged = { session, frame };
          this.flush();
        });
        break;
      }
      case 'status':
        this.listener.rejected(message.message);
        break;
    }
  }

  /** Sends what is newest, unless an update is on its way: then its answer sends the next. */
  private flush(): void {
    const { id, pose, change } = this;
    const acknowledged = this.acknowledged?.session === id ? this.acknowledged : undefined;
    if (!this.isLive || this.isSending || id === undefined || (pose ?? change ?? acknowledged) === undefined) return;
    this.pose = undefined;
    this.change = undefined;
    this.acknowledged = undefined;
    this.isSending = true;
    const { connection } = this;
    const update: Update<Camera, Change> = {
      sequence: ++this.sequence,
      ...(pose && { pose }),
      ...(change !== undefined && { change }),
      ...(acknowledged && { acknowledge: acknowledged.frame }),
    };
    this.calls
      .update(id, update, connection.signal)
      .catch((error: unknown) => {
        const { failure, message } = asCallError(error);
        if (failure === 'refused') {
          this.listener.rejected(message);
          // All or nothing: what came with the refused part was not taken either.
          if (change !== undefined) this.pose ??= pose;
          if (change !== undefined || pose !== undefined) this.acknowledged ??= acknowledged;
          return;
        }
        this.pose ??= pose;
        this.change ??= change;
        this.acknowledged ??= acknowledged;
        if (connection === this.connection) this.isLive = false;
        connection.abort();
      })
      .finally(() => {
        this.isSending = false;
        this.flush();
      });
  }
}

function asCallError(error: unknown): CallError {
  return error instanceof CallError ? error : new CallError('unavailable', error instanceof Error ? error.message : String(error));
}
