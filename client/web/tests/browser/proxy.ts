/** A link between a browser and a server: every byte takes its time, and the link can be cut in the middle of a message or be down. */
import { createConnection, createServer, type AddressInfo, type Server, type Socket } from 'node:net';

export class Proxy {
  private readonly listener: Server;
  private readonly sockets = new Set<Socket>();
  private isDown = false;
  /** Bytes that still come down before the cut; undefined while none is planned. */
  private bytesToCut: number | undefined;
  private told: (() => void) | undefined;

  /** To a server's URL; `delayMillis` each way. */
  constructor(
    private readonly target: string,
    private readonly delayMillis: number,
  ) {
    this.listener = createServer((near) => this.connect(near));
  }

  /** Its URL, once it listens. */
  async start(): Promise<string> {
    await new Promise<void>((listening) => this.listener.listen(0, '127.0.0.1', listening));
    const { protocol } = new URL(this.target);
    return `${protocol}//127.0.0.1:${(this.listener.address() as AddressInfo).port}`;
  }

  /** Every connection is lost once so many more bytes have come down; then new ones are taken. Resolves at the cut. */
  cutAfter(bytes: number): Promise<void> {
    this.bytesToCut = bytes;
    return new Promise((told) => (this.told = told));
  }

  /** Every connection is lost, and none is made until `mend`. */
  breakDown(): void {
    this.isDown = true;
    this.cut();
  }

  mend(): void {
    this.isDown = false;
  }

  async close(): Promise<void> {
    this.breakDown();
    await new Promise((closed) => this.listener.close(closed));
  }

  private cut(): void {
    for (const socket of this.sockets) socket.destroy();
    this.sockets.clear();
  }

  private connect(near: Socket): void {
    if (this.isDown) {
      near.destroy();
      return;
    }
    const { hostname, port } = new URL(this.target);
    const far = createConnection(Number(port), hostname);
    for (const socket of [near, far]) {
      this.sockets.add(socket);
      socket.setNoDelay(true);
      // A lost connection is what is asked for.
      socket.on('error', () => undefined);
    }
    this.carry(near, far, (data) => data);
    this.carry(far, near, (data) => this.counted(data));
  }

  private carry(from: Socket, to: Socket, passed: (data: Buffer) => Buffer): void {
    from.on('data', (data) =>
      this.later(() => {
        if (to.writable) to.write(passed(data));
        if (this.bytesToCut === 0) this.cutNow();
      }),
    );
    from.on('close', () =>
      this.later(() => {
        to.end();
        this.sockets.delete(from);
      }),
    );
  }

  /** In order: timers of one delay fire in the order in which they were set. */
  private later(act: () => void): void {
    setTimeout(act, this.delayMillis);
  }

  /** What comes down of it before the cut. */
  private counted(data: Buffer): Buffer {
    if (this.bytesToCut === undefined) return data;
    const passed = data.subarray(0, this.bytesToCut);
    this.bytesToCut -= passed.length;
    return passed;
  }

  private cutNow(): void {
    this.bytesToCut = undefined;
    // What was written is sent before the connection ends.
    setImmediate(() => {
      this.cut();
      this.told?.();
    });
  }
}
