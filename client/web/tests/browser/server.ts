/** The real binaries: a server on a folder of its own, which can be killed and started again on the same port, and the command line. */
import { execFileSync, spawn, type ChildProcess } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { createInterface } from 'node:readline';
import { fileURLToPath } from 'node:url';

import { create, fromBinary, toBinary } from '@bufbuild/protobuf';

import {
  FrameSchema,
  RenderFrameRequestSchema,
  type Camera,
  type Frame,
  type OutputSettings,
  type RenderSettings,
} from '../../src/generated/lumisphere/v1alpha1/rendering_pb';

const REPOSITORY = fileURLToPath(new URL('../../../..', import.meta.url));
const BINARIES = join(process.env['CARGO_TARGET_DIR'] ?? join(REPOSITORY, 'target'), 'debug');
/** Smallest captures that show something: a moment each. */
const QUICK_CAPTURE = [
  '--points',
  '16',
  '--face-size-texels',
  '16',
  '--samples-per-texel',
  '1',
  '--max-bounces',
  '1',
  '--sample-map-size-texels',
  '16',
];
const QUICK_OBSERVATION = ['--size-texels', '16', '--samples-per-observation', '4', '--max-bounces', '1'];

export class Server {
  private child: ChildProcess | undefined;
  private address = '127.0.0.1:0';
  private log = '';
  private readonly folder = mkdtempSync(join(tmpdir(), 'lumisphere-viewer-'));

  /** "http://127.0.0.1:…", the same after every start. */
  get url(): string {
    return `http://${this.address}`;
  }

  async start(): Promise<void> {
    const flags = ['--listen-address', this.address, '--http-address', '127.0.0.1:0', '--data-dir', join(this.folder, 'data')];
    const child = spawn(join(BINARIES, 'lumisphere-server'), flags, { stdio: ['ignore', 'pipe', 'pipe'], env: environment() });
    this.child = child;
    child.stderr.on('data', (text: Buffer) => (this.log += text.toString()));
    const lines = createInterface({ input: child.stdout });
    const address = await new Promise<string>((found, failed) => {
      lines.on('line', (line) => {
        const grpc = /^listening grpc=(\S+)/.exec(line)?.[1];
        if (grpc !== undefined) found(grpc);
      });
      child.on('error', failed);
      child.on('exit', () => failed(new Error(`the server ended:\n${this.log}`)));
    });
    this.address = address;
  }

  /** `kill -9`. */
  async kill(): Promise<void> {
    const child = this.child;
    if (child === undefined || child.exitCode !== null || child.signalCode !== null) return;
    await new Promise((ended) => {
      child.on('exit', ended);
      child.kill('SIGKILL');
    });
  }

  /** Answers nothing until `resume`. */
  pause(): void {
    this.child?.kill('SIGSTOP');
  }

  resume(): void {
    this.child?.kill('SIGCONT');
  }

  /** Memory of the process; undefined where the system does not say (other than Linux). */
  residentBytes(): number | undefined {
    const status = `/proc/${this.child?.pid}/status`;
    if (!existsSync(status)) return undefined;
    return 1024 * Number(/^VmRSS:\s+(\d+) kB/m.exec(readFileSync(status, 'utf8'))?.[1]);
  }

  async remove(): Promise<void> {
    await this.kill();
    rmSync(this.folder, { recursive: true, force: true });
  }

  lumisphere(...words: string[]): void {
    execFileSync(join(BINARIES, 'lumisphere'), words, {
      env: { ...environment(), LUMISPHERE_SERVER: this.url },
      stdio: ['ignore', 'ignore', 'pipe'],
    });
  }

  /** The first picture of the command line's orbit, in the viewer's default settings, as PNG. */
  orbitPicture(dataset: string, width: number, height: number, azimuthDegrees: number): Buffer {
    const out = mkdtempSync(join(this.folder, 'orbit-'));
    const path = ['--path', 'orbit', '--frames', '1', '--size', `${width}x${height}`, '--azimuth-deg', String(azimuthDegrees)];
    this.lumisphere('render', '--dataset', dataset, ...path, '--component', 'reconstruction', '--blend', 'corrected', '--out', out);
    return readFileSync(join(out, 'frame-00000.png'));
  }

  /** The light field "patchwork"; "seen", what a plane was seen to be, and its parameter map "map"; and "empty". */
  fill(): void {
    const wait = ['--watch', '--quiet'];
    this.lumisphere(
      'job',
      'submit',
      'capture',
      '--scene',
      'patchwork',
      '--object',
      'patchwork',
      '--dataset',
      'patchwork',
      ...QUICK_CAPTURE,
      ...wait,
    );
    this.lumisphere(
      'job',
      'submit',
      'observe',
      '--scene',
      'glossy_plane',
      '--object',
      'plane',
      '--dataset',
      'seen',
      ...QUICK_OBSERVATION,
      ...wait,
    );
    this.lumisphere('job', 'submit', 'fit', '--observations', 'seen', '--dataset', 'map', '--model', 'phong:1', ...wait);
    this.lumisphere('dataset', 'create', 'empty');
  }

  /** Rendering.RenderFrame, called as any program would. */
  async renderFrame(dataset: string, camera: Camera, settings: RenderSettings, output: OutputSettings): Promise<Frame> {
    const request = toBinary(RenderFrameRequestSchema, create(RenderFrameRequestSchema, { dataset, camera, settings, output }));
    const answer = await fetch(`${this.url}/lumisphere.v1alpha1.Rendering/RenderFrame`, {
      method: 'POST',
      headers: { 'content-type': 'application/grpc-web+proto', 'x-grpc-web': '1' },
      body: Buffer.concat([envelopeHeader(request.length), request]),
    });
    const message = firstMessage(Buffer.from(await answer.arrayBuffer()));
    if (message === undefined) throw new Error(`RenderFrame: ${answer.status} ${answer.headers.get('grpc-message')}`);
    return fromBinary(FrameSchema, message);
  }
}

/** What a gRPC-Web body begins with: no compression, and the message's length. */
function envelopeHeader(length: number): Buffer {
  const header = Buffer.alloc(5);
  header.writeUInt32BE(length, 1);
  return header;
}

/** The first message of a gRPC-Web body; undefined where there are only trailers. */
export function firstMessage(body: Buffer): Buffer | undefined {
  if (body.length < 5 || body[0] !== 0) return undefined;
  return body.subarray(5, 5 + body.readUInt32BE(1));
}

/** Nothing of the caller's own configuration. */
function environment(): NodeJS.ProcessEnv {
  const own = Object.entries(process.env).filter(([name]) => !name.startsWith('LUMISPHERE_'));
  return { ...Object.fromEntries(own), XDG_CONFIG_HOME: '/nonexistent' };
}
