/** The real binaries: a server on a folder of its own, which can be killed and started again on the same port, and the command line. */
import { execFileSync, spawn, type ChildProcess } from 'node:child_process';
import { createHash, X509Certificate } from 'node:crypto';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { connect } from 'node:http2';
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
  private httpAddress = '127.0.0.1:0';
  private log = '';
  private readonly folder = mkdtempSync(join(tmpdir(), 'lumisphere-viewer-'));
  /** PEM, of a server with TLS. */
  private certificate: Buffer | undefined;

  /** `settings`: flags more. */
  constructor(private readonly settings: readonly string[] = []) {}

  /** "http://127.0.0.1:…", with TLS "https://…"; the same after every start. */
  get url(): string {
    return `${this.certificate === undefined ? 'http' : 'https'}://${this.address}`;
  }

  /** From the next start on it has TLS, by a certificate of its own. Returns that key's SHA-256, in base64. */
  secure(): string {
    const [certificate, key] = [join(this.folder, 'certificate.pem'), join(this.folder, 'key.pem')];
    const kind = ['-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:P-256', '-nodes', '-days', '2'];
    const name = ['-subj', '/CN=localhost', '-addext', 'subjectAltName=IP:127.0.0.1,DNS:localhost'];
    execFileSync('openssl', ['req', '-x509', ...kind, ...name, '-keyout', key, '-out', certificate], {
      stdio: ['ignore', 'ignore', 'pipe'],
    });
    this.certificate = readFileSync(certificate);
    const { publicKey } = new X509Certificate(this.certificate);
    return createHash('sha256')
      .update(publicKey.export({ type: 'spki', format: 'der' }))
      .digest('base64');
  }

  async start(): Promise<void> {
    const addresses = ['--listen-address', this.address, '--http-address', this.httpAddress];
    const tls = ['--tls-certificate', join(this.folder, 'certificate.pem'), '--tls-private-key', join(this.folder, 'key.pem')];
    const secured = this.certificate === undefined ? [] : tls;
    const flags = [...addresses, '--data-dir', join(this.folder, 'data'), ...secured, ...this.settings];
    const child = spawn(join(BINARIES, 'lumisphere-server'), flags, { stdio: ['ignore', 'pipe', 'pipe'], env: environment() });
    this.child = child;
    child.stderr.on('data', (text: Buffer) => (this.log += text.toString()));
    const lines = createInterface({ input: child.stdout });
    const [address, httpAddress] = await new Promise<[string, string]>((found, failed) => {
      lines.on('line', (line) => {
        const [, grpc, http] = /^listening grpc=(\S+) http=(\S+)/.exec(line) ?? [];
        if (grpc !== undefined && http !== undefined) found([grpc, http]);
      });
      child.on('error', failed);
      child.on('exit', () => failed(new Error(`the server ended:\n${this.log}`)));
    });
    this.address = address;
    this.httpAddress = httpAddress;
  }

  /** A gauge of its metrics. */
  async gauge(name: string): Promise<number> {
    const metrics = await (await fetch(`http://${this.httpAddress}/metrics`)).text();
    return Number(new RegExp(`^(?:\\w+_)?${name} (\\S+)$`, 'm').exec(metrics)?.[1]);
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

  /** The light field "patchwork". */
  fillLightField(): void {
    const what = ['--scene', 'patchwork', '--object', 'patchwork', '--dataset', 'patchwork'];
    this.lumisphere('job', 'submit', 'capture', ...what, ...QUICK_CAPTURE, '--watch', '--quiet');
  }

  /** The light field "patchwork"; "seen", what a plane was seen to be, and its parameter map "map"; and "empty". */
  fill(): void {
    const wait = ['--watch', '--quiet'];
    this.fillLightField();
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
    const answer = await this.post('/lumisphere.v1alpha1.Rendering/RenderFrame', Buffer.concat([envelopeHeader(request.length), request]));
    const message = firstMessage(answer);
    if (message === undefined) throw new Error(`RenderFrame: ${answer.toString()}`);
    return fromBinary(FrameSchema, message);
  }

  private async post(path: string, body: Buffer): Promise<Buffer> {
    const headers = { 'content-type': 'application/grpc-web+proto', 'x-grpc-web': '1' };
    if (this.certificate === undefined) {
      const answer = await fetch(this.url + path, { method: 'POST', headers, body: new Uint8Array(body) });
      return Buffer.from(await answer.arrayBuffer());
    }
    // fetch takes no certificate.
    const link = connect(this.url, { ca: this.certificate });
    try {
      const stream = link.request({ ':method': 'POST', ':path': path, ...headers });
      stream.end(body);
      const parts: Buffer[] = [];
      for await (const part of stream) parts.push(part as Buffer);
      return Buffer.concat(parts);
    } finally {
      link.close();
    }
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
