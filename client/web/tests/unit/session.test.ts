import { expect, test } from 'vitest';

import { backOffMillis, CallError, Session, type Calls, type Down, type Phase, type Update } from '../../src/session';

interface TestFrame {
  readonly id: bigint;
}
type TestUpdate = Update<string, string>;

/** A server whose every answer the test gives. */
class FakeServer implements Calls<string, string, TestFrame> {
  readonly opened: string[] = [];
  readonly closed: string[] = [];
  readonly streamed: string[] = [];
  readonly updates: TestUpdate[] = [];
  /** Answers to updates not answered yet: at most one, if the session keeps its promise. */
  readonly unanswered: ((error?: CallError) => void)[] = [];
  openError: CallError | undefined;
  private streams: { push: (message: Down<TestFrame>) => void; end: (error?: CallError) => void }[] = [];

  async open(change: string): Promise<string> {
    if (this.openError) throw this.openError;
    this.opened.push(change);
    return `session-${this.opened.length}`;
  }

  async *stream(session: string, signal: AbortSignal): AsyncIterable<Down<TestFrame>> {
    this.streamed.push(session);
    const waiting: (Down<TestFrame> | CallError | 'end')[] = [{ kind: 'opened' }];
    let wake = (): void => undefined;
    const put = (message: Down<TestFrame> | CallError | 'end'): void => {
      waiting.push(message);
      wake();
    };
    this.streams.push({ push: put, end: (error) => put(error ?? 'end') });
    signal.addEventListener('abort', () => put(new CallError('unavailable', 'aborted')));
    for (;;) {
      const next = waiting.shift();
      if (next === undefined) await new Promise<void>((resolve) => (wake = resolve));
      else if (next === 'end') return;
      else if (next instanceof CallError) throw next;
      else yield next;
    }
  }

  update(_: string, update: TestUpdate, signal: AbortSignal): Promise<void> {
    this.updates.push(update);
    return new Promise((resolve, reject) => {
      this.unanswered.push((error) => (error ? reject(error) : resolve()));
      signal.addEventListener('abort', () => reject(new CallError('unavailable', 'aborted')));
    });
  }

  async close(session: string): Promise<void> {
    this.closed.push(session);
  }

  push(message: Down<TestFrame>): void {
    this.streams.at(-1)!.push(message);
  }

  end(error?: CallError): void {
    this.streams.at(-1)!.end(error);
  }

  async answer(error?: CallError): Promise<void> {
    this.unanswered.shift()!(error);
    await settled();
  }
}

/** Until everything that can go on has. */
async function settled(): Promise<void> {
  for (let i = 0; i < 50; i++) await Promise.resolve();
}

async function started() {
  const server = new FakeServer();
  const phases: Phase[] = [];
  const rejections: string[] = [];
  const acknowledgements: (() => void)[] = [];
  const waits: number[] = [];
  let wake = (): void => undefined;
  const session = new Session<string, string, TestFrame>(
    server,
    'settings-1',
    (frame) => frame.id,
    {
      phase: (phase) => phases.push(phase),
      frame: (_, acknowledge) => acknowledgements.push(acknowledge),
      rejected: (message) => rejections.push(message),
    },
    (millis, signal) => {
      waits.push(millis);
      return new Promise((resolve) => {
        wake = resolve;
        signal.addEventListener('abort', () => resolve());
      });
    },
  );
  await settled();
  const endWait = async (): Promise<void> => {
    wake();
    await settled();
  };
  return { server, session, phases, rejections, acknowledgements, waits, endWait };
}

test('of many poses during one update only the newest is sent, and one update at a time', async () => {
  const { server, session } = await started();
  for (let i = 1; i <= 100; i++) session.setPose(`pose-${i}`);
  expect(server.updates.map(({ pose }) => pose?.camera)).toEqual(['pose-1']);
  expect(server.unanswered).toHaveLength(1);
  await server.answer();
  expect(server.updates.map(({ pose }) => pose?.camera)).toEqual(['pose-1', 'pose-100']);
  await server.answer();
  expect(server.updates).toHaveLength(2);
  expect(server.updates.map(({ sequence }) => sequence)).toEqual([1, 2]);
});

test('acknowledgements and settings travel with the next pose, the newest of each', async () => {
  const { server, session, acknowledgements } = await started();
  session.setPose('pose-1');
  server.push({ kind: 'frame', frame: { id: 1n } });
  server.push({ kind: 'frame', frame: { id: 2n } });
  await settled();
  acknowledgements.forEach((acknowledge) => acknowledge());
  session.setSettings('settings-2');
  session.setSettings('settings-3');
  session.setPose('pose-2');
  await server.answer();
  expect(server.updates[1]).toEqual({ sequence: 2, pose: { id: 2, camera: 'pose-2' }, change: 'settings-3', acknowledge: 2n });
});

test('a broken stream is resumed after a wait, in the same session, with the newest pose', async () => {
  const { server, session, phases, waits, endWait } = await started();
  session.setPose('pose-1');
  await server.answer();
  server.end(new CallError('unavailable', 'network'));
  await settled();
  session.setPose('pose-2');
  expect(phases.at(-1)).toEqual({ name: 'waiting', failures: 1, reason: 'network' });
  expect(waits).toHaveLength(1);
  await endWait();
  expect(server.streamed).toEqual(['session-1', 'session-1']);
  expect(server.updates.at(-1)?.pose).toEqual({ id: 2, camera: 'pose-2' });
  expect(phases.at(-1)).toEqual({ name: 'live' });
});

test('a stream that brings nothing can be replaced by another of the same session', async () => {
  const { server, session, phases, endWait } = await started();
  session.setPose('pose-1');
  await server.answer();
  session.reconnect();
  await settled();
  await endWait();
  expect(server.streamed).toEqual(['session-1', 'session-1']);
  expect(server.opened).toHaveLength(1);
  expect(server.updates.at(-1)?.pose).toEqual({ id: 1, camera: 'pose-1' });
  expect(phases.at(-1)).toEqual({ name: 'live' });
});

test('a session that the server forgot is opened anew, with the newest settings and pose', async () => {
  const { server, session, acknowledgements, endWait } = await started();
  session.setPose('pose-1');
  await server.answer();
  server.push({ kind: 'frame', frame: { id: 7n } });
  await settled();
  server.end();
  await settled();
  session.setSettings('settings-2');
  server.stream = (() => {
    const stream = server.stream.bind(server);
    return async function* (id: string, signal: AbortSignal) {
      if (id === 'session-1') throw new CallError('missing', 'no such session');
      yield* stream(id, signal);
    };
  })();
  await endWait();
  expect(server.opened).toEqual(['settings-1', 'settings-2']);
  expect(server.streamed).toEqual(['session-1', 'session-2']);
  expect(server.updates.at(-1)?.pose?.camera).toBe('pose-1');
  // A frame of the old session is nothing to the new one, and takes no acknowledgement's place.
  acknowledgements[0]!();
  await server.answer();
  expect(server.updates.at(-1)?.acknowledge).toBeUndefined();
  server.push({ kind: 'frame', frame: { id: 1n } });
  await settled();
  session.setPose('pose-2');
  acknowledgements[1]!();
  acknowledgements[0]!();
  await server.answer();
  expect(server.updates.at(-1)?.acknowledge).toBe(1n);
});

test('an update that is lost is sent again, with what is newer', async () => {
  const { server, session, endWait } = await started();
  session.setSettings('settings-2');
  session.setPose('pose-1');
  session.setPose('pose-2');
  await server.answer(new CallError('unavailable', 'network'));
  await endWait();
  expect(server.updates.at(-1)).toMatchObject({ change: 'settings-2', pose: { camera: 'pose-2' } });
});

test('an update that hangs in a broken connection holds up nothing in the next', async () => {
  const { server, session, phases, endWait } = await started();
  session.setPose('pose-1');
  server.end(new CallError('unavailable', 'network'));
  await settled();
  await endWait();
  expect(server.updates.map(({ pose }) => pose?.camera)).toEqual(['pose-1', 'pose-1']);
  // Its late failure is nothing to the new connection.
  await server.answer(new CallError('unavailable', 'too late'));
  expect(phases.at(-1)).toEqual({ name: 'live' });
});

test('a refused setting is told, and takes neither pose nor acknowledgement with it', async () => {
  const { server, session, rejections, acknowledgements } = await started();
  session.setPose('pose-1');
  server.push({ kind: 'frame', frame: { id: 1n } });
  await settled();
  acknowledgements[0]!();
  session.setSettings('nonsense');
  session.setPose('pose-2');
  await server.answer();
  await server.answer(new CallError('refused', 'blend: nonsense'));
  expect(rejections).toEqual(['blend: nonsense']);
  expect(server.updates.at(-1)).toEqual({ sequence: 3, pose: { id: 2, camera: 'pose-2' }, acknowledge: 1n });
});

test('a refused pose is not sent again', async () => {
  const { server, session } = await started();
  session.setPose('NaN');
  await server.answer(new CallError('refused', 'camera'));
  expect(server.updates).toHaveLength(1);
});

test('a session that cannot be opened fails, and tries again with other settings', async () => {
  const server = new FakeServer();
  server.openError = new CallError('refused', 'no such blend');
  const phases: Phase[] = [];
  const listener = { phase: (phase: Phase) => phases.push(phase), frame: () => undefined, rejected: () => undefined };
  const session = new Session<string, string, TestFrame>(
    server,
    'bad',
    (frame) => frame.id,
    listener,
    async () => undefined,
  );
  await settled();
  expect(phases.at(-1)).toEqual({ name: 'failed', reason: 'no such blend' });
  server.openError = undefined;
  session.setSettings('good');
  await settled();
  expect(server.opened).toEqual(['good']);
  expect(phases.at(-1)).toEqual({ name: 'live' });
});

test('closing closes it on the server and sends nothing any more', async () => {
  const { server, session } = await started();
  session.close();
  session.setPose('pose-1');
  await settled();
  expect(server.closed).toEqual(['session-1']);
  expect(server.updates).toEqual([]);
  expect(server.streamed).toHaveLength(1);
});

test('waits grow to a bound and are spread', () => {
  const waits = [1, 2, 3, 4, 5, 6, 50].map((failures) => backOffMillis(failures, 0.5));
  expect(waits).toEqual([250, 500, 1000, 2000, 4000, 5000, 5000]);
  expect(backOffMillis(1, 0)).toBeLessThan(backOffMillis(1, 0.99));
});
