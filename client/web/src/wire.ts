/** The only file that names the wire's types: cameras and settings into messages, calls and their errors out of Connect's. */
import { create } from '@bufbuild/protobuf';
import { Code, ConnectError, createClient } from '@connectrpc/connect';
import { createGrpcWebTransport } from '@connectrpc/connect-web';

import { focalLength, pose, type Bounds, type Size, type Viewpoint } from './camera';
import { Datasets, type Dataset as WireDataset, type Vector3 as WireVector3 } from './generated/lumisphere/v1alpha1/datasets_pb';
import {
  CameraSchema,
  DepthFormat,
  Encoding,
  OffsetSurfaceLightFieldSettings_Blend as Blend,
  OffsetSurfaceLightFieldSettings_Component as Component,
  OffsetSurfaceLightFieldSettings_Filter as Filter,
  OffsetSurfaceLightFieldSettings_Gloss_Order as Order,
  OffsetSurfaceLightFieldSettings_Refraction_Body as Body,
  OutputSettingsSchema,
  ParameterMapSettings_Show as Show,
  Rendering,
  RenderSettingsSchema,
  SettingsUpdateSchema,
  type Camera,
  type Frame,
  type OutputSettings,
  type RenderSettings,
  type SettingsUpdate,
} from './generated/lumisphere/v1alpha1/rendering_pb';
import { System } from './generated/lumisphere/v1alpha1/system_pb';
import { CallError, type Calls } from './session';
import type { Delivery, Kind, Settings } from './settings';
import type { Vector3 } from './vector';

export type { Camera, Frame, SettingsUpdate };

/** A dataset as the list shows it. */
export interface Dataset {
  readonly name: string;
  /** Empty until there is a version. */
  readonly kind: string;
  /** Ascending. */
  readonly versions: readonly Version[];
  /** 0: none yet. */
  readonly latestVersion: number;
}

/** One version. */
export interface Version {
  readonly version: number;
  readonly sizeBytes: number;
  readonly created: Date | undefined;
  /** Only `dataset` tells it. */
  readonly bounds: Bounds | undefined;
}

/** What the page wants to know of the server. */
export interface ServerInfo {
  readonly maxPixels: number;
  /** The least of several. */
  readonly roundTripMillis: number;
  /** Whether it sends H.264. */
  readonly hasVideo: boolean;
}

/** A call that takes longer has lost its server, and so has a stream that does not begin. */
const CALL_TIMEOUT_MILLIS = 15_000;
/** Calls by which the link's round trip is measured. */
const ROUND_TRIPS = 3;
/** A still in full size may take long on a software adapter. */
const RENDER_TIMEOUT_MILLIS = 120_000;

// Where the page came from, also behind a proxy that serves it below a path.
const transport = createGrpcWebTransport({
  baseUrl: new URL('.', document.baseURI).href.replace(/\/$/, ''),
  // A session is closed while its page goes away.
  fetch: (input, init) => fetch(input, { ...init, keepalive: String(input).endsWith('/CloseSession') }),
});
const datasets = createClient(Datasets, transport);
const rendering = createClient(Rendering, transport);
const system = createClient(System, transport);

/** All datasets, by name. */
export async function listDatasets(): Promise<Dataset[]> {
  return called(async () => {
    const all: Dataset[] = [];
    for (let pageToken = ''; ; ) {
      const page = await datasets.listDatasets({ pageToken, pageSize: 1000 }, { timeoutMs: CALL_TIMEOUT_MILLIS });
      all.push(...page.datasets.map(datasetFrom));
      pageToken = page.nextPageToken;
      if (pageToken === '') return all;
    }
  });
}

/** One dataset, with its versions' boxes. */
export async function getDataset(name: string): Promise<Dataset> {
  return called(async () => datasetFrom(await datasets.getDataset({ name }, { timeoutMs: CALL_TIMEOUT_MILLIS })));
}

export async function serverInfo(): Promise<ServerInfo> {
  return called(async () => {
    const info = await system.getServerInfo({}, { timeoutMs: CALL_TIMEOUT_MILLIS });
    const { features } = await system.getVersion({}, { timeoutMs: CALL_TIMEOUT_MILLIS });
    let roundTripMillis = Infinity;
    for (let i = 0; i < ROUND_TRIPS; i++) {
      const begin = performance.now();
      await system.measureLink({}, { timeoutMs: CALL_TIMEOUT_MILLIS });
      roundTripMillis = Math.min(roundTripMillis, performance.now() - begin);
    }
    const maxPixels = Number(info.limits?.maxPixelsPerFrame ?? 0n);
    return { maxPixels, roundTripMillis, hasVideo: features.includes('encoding.h264') };
  });
}

/** One frame. */
export async function renderFrame(
  dataset: string,
  version: number,
  camera: Camera,
  update: SettingsUpdate,
  signal?: AbortSignal,
): Promise<Frame> {
  const { settings, output } = update;
  if (settings === undefined || output === undefined) throw new CallError('refused', 'a frame needs settings and output');
  return called(() =>
    rendering.renderFrame(
      { dataset, version: BigInt(version), camera, settings, output },
      { timeoutMs: RENDER_TIMEOUT_MILLIS, ...(signal && { signal }) },
    ),
  );
}

/** What a session needs to be opened. */
export interface Opening {
  readonly dataset: string;
  readonly version: number;
  /** Frames that may be unacknowledged. */
  readonly credits: number;
  readonly framesPerSecond: number;
}

/** The session's calls over this page's connection. */
export function sessionCalls(opening: Opening): Calls<Camera, SettingsUpdate, Frame> {
  return {
    open: (change) =>
      called(async () => {
        const { settings, output } = change;
        const open = {
          dataset: opening.dataset,
          version: BigInt(opening.version),
          credits: opening.credits,
          movingFramesPerSecond: opening.framesPerSecond,
          ...(settings && { settings }),
          ...(output && { output }),
        };
        return (await rendering.openSession({ open }, { timeoutMs: CALL_TIMEOUT_MILLIS })).sessionId;
      }),
    async *stream(sessionId, signal) {
      const late = new AbortController();
      const timer = setTimeout(() => late.abort(), CALL_TIMEOUT_MILLIS);
      try {
        for await (const { message } of rendering.streamFrames({ sessionId }, { signal: AbortSignal.any([signal, late.signal]) })) {
          clearTimeout(timer);
          if (message.case === 'opened') yield { kind: 'opened' };
          if (message.case === 'frame') yield { kind: 'frame', frame: message.value };
          if (message.case === 'status') yield { kind: 'status', message: message.value.message };
        }
      } catch (error) {
        throw callError(error);
      } finally {
        clearTimeout(timer);
      }
    },
    update: (sessionId, { sequence, pose, change, acknowledge }, signal) =>
      called(async () => {
        await rendering.updateSession(
          {
            sessionId,
            sequence: BigInt(sequence),
            ...(pose && { pose: { poseId: BigInt(pose.id), camera: pose.camera } }),
            ...(change && { settings: change }),
            ...(acknowledge !== undefined && { acknowledge: { frameId: acknowledge } }),
          },
          { timeoutMs: CALL_TIMEOUT_MILLIS, signal },
        );
      }),
    close: (sessionId) =>
      called(async () => {
        await rendering.closeSession({ sessionId }, { timeoutMs: CALL_TIMEOUT_MILLIS });
      }),
  };
}

/** A picture's camera. */
export function cameraMessage(view: Viewpoint, size: Size): Camera {
  const { position, right, up, backward } = pose(view);
  const axis = ([x, y, z]: Vector3): { x: number; y: number; z: number } => ({ x, y, z });
  return create(CameraSchema, {
    pose: { position: axis(position), right: axis(right), up: axis(up), backward: axis(backward) },
    intrinsics: { widthPx: size.width, heightPx: size.height, focalXPx: focalLength(view, size) },
  });
}

/** What to compute and how to send it. */
export function settingsMessage(kind: Kind, settings: Settings, delivery: Delivery): SettingsUpdate {
  return create(SettingsUpdateSchema, { settings: renderSettings(kind, settings), output: liveOutput(settings, delivery) });
}

/** The same picture in another encoding, colour alone. */
export function stillMessage(kind: Kind, settings: Settings, encoding: 'png' | 'exr' | 'jpeg'): SettingsUpdate {
  const output = create(OutputSettingsSchema, { ...exposure(settings), encoding: ENCODINGS[encoding], jpegQuality: 85 });
  return create(SettingsUpdateSchema, { settings: renderSettings(kind, settings), output });
}

const ENCODINGS = { png: Encoding.PNG, exr: Encoding.EXR, jpeg: Encoding.JPEG } as const;

/** MIME type of a frame's colour. */
export function mediaType(frame: Frame): string {
  return frame.encoding === Encoding.PNG ? 'image/png' : 'image/jpeg';
}

/** Whether its colour is no picture by itself, but one of a stream. */
export function isVideo(frame: Frame): boolean {
  return frame.encoding === Encoding.H264;
}

const LIVE_ENCODINGS: Readonly<Record<string, Encoding>> = { jpeg: Encoding.JPEG, png: Encoding.PNG, h264: Encoding.H264 };

const COMPONENTS: Readonly<Record<string, Component>> = {
  reconstruction: Component.RECONSTRUCTION,
  mirror: Component.MIRROR,
  full: Component.FULL,
  glossy: Component.GLOSSY,
  refraction: Component.REFRACTION,
};
const BLENDS: Readonly<Record<string, Blend>> = {
  distance: Blend.DISTANCE,
  angle: Blend.ANGLE,
  average: Blend.AVERAGE,
  reflection: Blend.REFLECTION,
  normal: Blend.NORMAL,
  'environment-map': Blend.ENVIRONMENT_MAP,
  corrected: Blend.CORRECTED,
};
const FILTERS: Readonly<Record<string, Filter>> = { footprint: Filter.FOOTPRINT, bilinear: Filter.BILINEAR };
const SHOWS: Readonly<Record<string, Show>> = { radiance: Show.RADIANCE, models: Show.MODELS, flags: Show.FLAGS };

function renderSettings(kind: Kind, settings: Settings): RenderSettings {
  const truth = settings.source === 'truth' && { groundTruth: { pathsPerPixel: 1, passes: settings.truthPasses } };
  if (kind === 'parameter_map') {
    const value = { show: SHOWS[settings.show] ?? Show.SHOW_UNSPECIFIED };
    return create(RenderSettingsSchema, { representation: { case: 'parameterMap', value }, ...truth });
  }
  const value = {
    component: COMPONENTS[settings.component] ?? Component.COMPONENT_UNSPECIFIED,
    blend: BLENDS[settings.blend] ?? Blend.BLEND_UNSPECIFIED,
    exponent: settings.exponent,
    specularReflectance: { x: settings.specularRed, y: settings.specularGreen, z: settings.specularBlue },
    reflections: settings.reflections,
    filter: FILTERS[settings.filter] ?? Filter.FILTER_UNSPECIFIED,
    ...(settings.component === 'glossy' && {
      gloss: {
        brdf: settings.brdf,
        directions: settings.directions,
        passes: settings.passes,
        order: settings.integrationOrder === 'integrate-first' ? Order.INTEGRATE_FIRST : Order.BLEND_FIRST,
      },
    }),
    ...relighting(settings),
    ...(settings.component === 'refraction' && {
      refraction: { index: settings.refractionIndex, body: settings.body === 'thin' ? Body.THIN : Body.SOLID },
    }),
  };
  return create(RenderSettingsSchema, { representation: { case: 'offsetSurfaceLightField', value }, ...truth });
}

function relighting({ environmentTurn, pointLights }: Settings): { relighting?: object } {
  const lights = pointLights.split(' ').filter((light) => light !== '');
  if (environmentTurn === 0 && lights.length === 0) return {};
  return { relighting: { environmentTurnDeg: environmentTurn, pointLights: lights.map(pointLight) } };
}

/** What is no number becomes NaN: the server says what it expects. */
function pointLight(text: string): { position: object; intensity: object } {
  const [position, intensity] = text.split(':').map((vector) => {
    const [x = Number.NaN, y = Number.NaN, z = Number.NaN] = vector.split(',').map((c) => (c.trim() === '' ? Number.NaN : Number(c)));
    return { x, y, z };
  });
  const none = { x: Number.NaN, y: Number.NaN, z: Number.NaN };
  return { position: position ?? none, intensity: intensity ?? none };
}

/** Of so many columns and rows the warp needs one depth: its sheet is no finer in a large frame. */
const DEPTH_STEP = 4;

function liveOutput(settings: Settings, delivery: Delivery): OutputSettings {
  return create(OutputSettingsSchema, {
    ...exposure(settings),
    encoding: LIVE_ENCODINGS[delivery.encoding] ?? Encoding.JPEG,
    encodingAtRest: LIVE_ENCODINGS[delivery.atRest] ?? Encoding.UNSPECIFIED,
    jpegQuality: delivery.quality,
    wantDepth: delivery.warp === 'depth',
    depthFormat: DepthFormat.INVERSE_16,
    depthStep: DEPTH_STEP,
    wantProvenance: settings.overlay !== 'none' && settings.source === 'stored',
  });
}

function exposure(settings: Settings): { exposureStops: number; exposureGamma: number } {
  return { exposureStops: settings.exposureStops, exposureGamma: settings.exposureGamma };
}

function datasetFrom(message: WireDataset): Dataset {
  const versions = message.versions.map(({ version, sizeBytes, createTime, objectBounds }) => ({
    version: Number(version),
    sizeBytes: Number(sizeBytes),
    created: createTime && new Date(Number(createTime.seconds) * 1000),
    bounds: objectBounds?.min && objectBounds.max && { min: vector(objectBounds.min), max: vector(objectBounds.max) },
  }));
  return { name: message.name, kind: message.kind, versions, latestVersion: Number(message.latestVersion) };
}

function vector({ x, y, z }: WireVector3): Vector3 {
  return [x, y, z];
}

async function called<T>(call: () => Promise<T>): Promise<T> {
  try {
    return await call();
  } catch (error) {
    throw callError(error);
  }
}

function callError(error: unknown): CallError {
  const { code, rawMessage } = ConnectError.from(error);
  const message = rawMessage || Code[code];
  switch (code) {
    case Code.NotFound:
      return new CallError('missing', message);
    case Code.InvalidArgument:
    case Code.FailedPrecondition:
    case Code.OutOfRange:
    case Code.DataLoss:
    case Code.Unimplemented:
    case Code.PermissionDenied:
    case Code.Unauthenticated:
      return new CallError('refused', message);
    default:
      return new CallError('unavailable', message);
  }
}
