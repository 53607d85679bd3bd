/**
 * The last frame seen from the newest pose, while the next frame is awaited: every pixel is put where its depth says it lies and looked at
 * from there, as a sheet of small triangles (post-rendering 3D warping: Mark, McMillan and Bishop 1997). What the frame did not see is
 * stretched from its edges; the next frame replaces it all.
 */
import { decompress } from 'fzstd';

import { focalLength, pose, type Size, type Viewpoint } from './camera';
import { make } from './dom';
import type { Vector3 } from './vector';
import type { Frame } from './wire';

/** Cells along the longer side: fine enough for silhouettes, few enough for every frame. */
const CELLS = 160;
/** What the background's infinite distance becomes, in distances of the target. */
const BACKGROUND_DISTANCES = 1e3;
/** Nearest depth that is told apart, in distances of the target. */
const NEAREST_DISTANCES = 1e-3;

// One cell is two triangles; the sheet's outermost cells reach far out, so that turning shows no rim.
const VERTEX_SHADER = `#version 300 es
precision highp float;
uniform highp sampler2D depth;
uniform ivec2 cells;
uniform vec2 source_size, source_focal, source_center, target_scale;
uniform mat3 world_from_source, target_from_world;
uniform vec3 source_position, target_position;
uniform float background, nearest;
out vec2 place;
const ivec2 CORNERS[6] = ivec2[6](ivec2(0, 0), ivec2(1, 0), ivec2(0, 1), ivec2(0, 1), ivec2(1, 0), ivec2(1, 1));
void main() {
  int cell = gl_VertexID / 6;
  ivec2 corner = ivec2(cell % cells.x, cell / cells.x) + CORNERS[gl_VertexID % 6];
  vec2 depths = vec2(textureSize(depth, 0));
  place = vec2(corner - 1) / vec2(cells - 2);
  vec2 clamped_place = clamp(place, 0.0, 1.0);
  vec2 rim = sign(place - clamped_place);
  place = clamped_place;
  vec2 pixel = (place + 0.5 * rim) * source_size;
  float distance = min(texelFetch(depth, ivec2(min(place * depths, depths - 1.0)), 0).r, background);
  vec3 ray = normalize(vec3((pixel.x - source_center.x) / source_focal.x, -(pixel.y - source_center.y) / source_focal.y, -1.0));
  vec3 world = source_position + distance * (world_from_source * ray);
  vec3 seen = target_from_world * (world - target_position);
  gl_Position = vec4(target_scale * seen.xy, -seen.z - 2.0 * nearest, -seen.z);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision mediump float;
uniform sampler2D color;
in vec2 place;
out vec4 shown;
void main() {
  shown = vec4(texture(color, place).rgb, 1.0);
}`;

type Uniform = (typeof UNIFORMS)[number];
const UNIFORMS = [
  'depth',
  'color',
  'cells',
  'source_size',
  'source_focal',
  'source_center',
  'target_scale',
  'world_from_source',
  'target_from_world',
  'source_position',
  'target_position',
  'background',
  'nearest',
] as const;

type DepthPlane = Pick<Frame, 'depth' | 'depthWidthPx' | 'depthHeightPx' | 'nearestDepth'>;

/** A frame that can be warped, by its camera. */
interface Source {
  readonly cells: readonly [number, number];
  readonly size: readonly [number, number];
  readonly focal: readonly [number, number];
  readonly center: readonly [number, number];
  readonly position: Vector3;
  /** Columns: right, up, backward. */
  readonly worldFromSource: Float32Array;
}

export class Warp {
  readonly canvas = make('canvas', { class: 'warp', hidden: true, 'aria-hidden': 'true' });
  private readonly gl: WebGL2RenderingContext;
  private readonly uniforms: Readonly<Record<Uniform, WebGLUniformLocation | null>>;
  private source: Source | undefined;

  /** Throws where there is no WebGL 2. */
  constructor() {
    const gl = this.canvas.getContext('webgl2', { alpha: false, antialias: false });
    if (gl === null) throw new Error('this browser has no WebGL 2');
    this.gl = gl;
    const program = linked(gl);
    gl.useProgram(program);
    this.uniforms = Object.fromEntries(UNIFORMS.map((name) => [name, gl.getUniformLocation(program, name)])) as Record<
      Uniform,
      WebGLUniformLocation | null
    >;
    texture(gl, 0);
    texture(gl, 1);
    gl.uniform1i(this.uniforms.color, 0);
    gl.uniform1i(this.uniforms.depth, 1);
    gl.enable(gl.DEPTH_TEST);
    this.canvas.addEventListener('webglcontextlost', () => {
      this.source = undefined;
      this.hide();
    });
  }

  /** The newest frame and its picture; without depth there is nothing to warp. */
  take(frame: Frame, picture: ImageBitmap): void {
    this.source = undefined;
    const { depthWidthPx: width, depthHeightPx: height } = frame;
    const source = sourceOf(frame);
    if (frame.depth.length === 0 || source === undefined || this.gl.isContextLost()) return;
    const depths = distances(frame);
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    gl.activeTexture(gl.TEXTURE1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, width, height, 0, gl.RED, gl.FLOAT, depths);
    this.source = source;
  }

  /** Shows the newest frame as from here. */
  show(view: Viewpoint, size: Size): void {
    const { gl, uniforms, source, canvas } = this;
    if (source === undefined) return;
    canvas.width = size.width;
    canvas.height = size.height;
    const { position, right, up, backward } = pose(view);
    const focal = focalLength(view, size);
    gl.viewport(0, 0, size.width, size.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniform2iv(uniforms.cells, source.cells);
    gl.uniform2fv(uniforms.source_size, source.size);
    gl.uniform2fv(uniforms.source_focal, source.focal);
    gl.uniform2fv(uniforms.source_center, source.center);
    gl.uniform2f(uniforms.target_scale, (2 * focal) / size.width, (2 * focal) / size.height);
    gl.uniformMatrix3fv(uniforms.world_from_source, false, source.worldFromSource);
    // The inverse of a rotation is its transpose.
    gl.uniformMatrix3fv(uniforms.target_from_world, true, Float32Array.from([...right, ...up, ...backward]));
    gl.uniform3fv(uniforms.source_position, source.position);
    gl.uniform3fv(uniforms.target_position, position);
    gl.uniform1f(uniforms.background, BACKGROUND_DISTANCES * view.distance);
    gl.uniform1f(uniforms.nearest, NEAREST_DISTANCES * view.distance);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * source.cells[0] * source.cells[1]);
    canvas.hidden = false;
  }

  hide(): void {
    this.canvas.hidden = true;
  }

  /** Gives the adapter's memory back. */
  close(): void {
    this.gl.getExtension('WEBGL_lose_context')?.loseContext();
    this.canvas.remove();
  }
}

/** Of 16 bits of inverse distance each; infinite where nothing was hit. */
export function distances({ depth, depthWidthPx, depthHeightPx, nearestDepth }: DepthPlane): Float32Array {
  const bytes = 2 * depthWidthPx * depthHeightPx;
  const raw = decompress(depth);
  if (raw.byteLength !== bytes) throw new RangeError(`depth of ${raw.byteLength} bytes, ${bytes} expected`);
  const codes = new DataView(raw.buffer, raw.byteOffset, bytes);
  return Float32Array.from({ length: bytes / 2 }, (_, at) => {
    const code = codes.getUint16(2 * at, true);
    return code === 0 ? Infinity : (nearestDepth * 65535) / code;
  });
}

function sourceOf({ camera, widthPx, heightPx }: Frame): Source | undefined {
  const { pose: axes, intrinsics } = camera ?? {};
  if (!axes?.position || !axes.right || !axes.up || !axes.backward || !intrinsics) return undefined;
  const vector = ({ x, y, z }: { x: number; y: number; z: number }): Vector3 => [x, y, z];
  const cell = Math.max(1, Math.max(widthPx, heightPx) / CELLS);
  return {
    // And the rim.
    cells: [Math.ceil(widthPx / cell) + 2, Math.ceil(heightPx / cell) + 2],
    size: [widthPx, heightPx],
    focal: [intrinsics.focalXPx, intrinsics.focalYPx || intrinsics.focalXPx],
    center: [intrinsics.centerXPx ?? widthPx / 2, intrinsics.centerYPx ?? heightPx / 2],
    position: vector(axes.position),
    worldFromSource: Float32Array.from([...vector(axes.right), ...vector(axes.up), ...vector(axes.backward)]),
  };
}

function linked(gl: WebGL2RenderingContext): WebGLProgram {
  const program = gl.createProgram();
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, VERTEX_SHADER],
    [gl.FRAGMENT_SHADER, FRAGMENT_SHADER],
  ] as const) {
    const shader = gl.createShader(kind);
    if (shader === null) throw new Error('WebGL is lost');
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`the warp's shaders: ${gl.getProgramInfoLog(program)}`);
  return program;
}

/** An empty texture on this unit. */
function texture(gl: WebGL2RenderingContext, unit: number): void {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  // f32 cannot be interpolated everywhere; the colour of an 8-bit picture can.
  const filter = unit === 0 ? gl.LINEAR : gl.NEAREST;
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
}
