/**
 * Where the viewer is, and how input moves it. A viewpoint is an orbit around a target: angles as the command line's orbit has them
 * (client/src/cameras.rs), so that both frame a dataset alike. There is no roll; every function returns a new viewpoint.
 */
import { add, cross, length, scale, subtract, type Vector3 } from './vector';

/** A viewpoint. Angles in radians, lengths in scene units. */
export interface Viewpoint {
  /** What the orbit turns around. */
  readonly target: Vector3;
  /** From the target to the eye; positive. */
  readonly distance: number;
  /** From +Z toward +X. */
  readonly azimuth: number;
  /** Above the horizon, −π/2 to π/2. */
  readonly elevation: number;
  /** Across the shorter side of the picture. */
  readonly fieldOfView: number;
}

/** Rigid world_from_camera: the eye and the camera's axes, orthonormal; the camera looks along −backward. */
export interface Pose {
  readonly position: Vector3;
  readonly right: Vector3;
  readonly up: Vector3;
  readonly backward: Vector3;
}

/** World-space box. */
export interface Bounds {
  readonly min: Vector3;
  readonly max: Vector3;
}

/** Width and height in pixels. */
export interface Size {
  readonly width: number;
  readonly height: number;
}

const DEGREE = Math.PI / 180;
/** Of the command line's orbit. */
const DEFAULT_FIELD_OF_VIEW = 40 * DEGREE;
const DEFAULT_ELEVATION = 25 * DEGREE;
const DEFAULT_DISTANCE_RADII = 3.5;
export const FIELD_OF_VIEW_RANGE = [5 * DEGREE, 120 * DEGREE] as const;
/** In radii of the object. */
const DISTANCE_RANGE_RADII = [0.02, 200] as const;

/** Half the diagonal: the radius of the sphere around the box. */
export function radius(bounds: Bounds): number {
  return 0.5 * length(subtract(bounds.max, bounds.min));
}

/** The viewpoint that a dataset opens with: the first of the command line's orbit. */
export function defaultViewpoint(bounds: Bounds): Viewpoint {
  return {
    target: scale(0.5, add(bounds.min, bounds.max)),
    distance: DEFAULT_DISTANCE_RADII * radius(bounds),
    azimuth: 0,
    elevation: DEFAULT_ELEVATION,
    fieldOfView: DEFAULT_FIELD_OF_VIEW,
  };
}

/** The camera's axes and eye. Defined at the poles, too, where a look-at is not. */
export function pose(view: Viewpoint): Pose {
  const [sinAzimuth, cosAzimuth] = [Math.sin(view.azimuth), Math.cos(view.azimuth)];
  const [sinElevation, cosElevation] = [Math.sin(view.elevation), Math.cos(view.elevation)];
  const backward: Vector3 = [cosElevation * sinAzimuth, sinElevation, cosElevation * cosAzimuth];
  const right: Vector3 = [cosAzimuth, 0, -sinAzimuth];
  return { position: add(view.target, scale(view.distance, backward)), right, up: cross(backward, right), backward };
}

/** Focal length in pixels, of square pixels. */
export function focalLength(view: Viewpoint, size: Size): number {
  return (0.5 * Math.min(size.width, size.height)) / Math.tan(0.5 * view.fieldOfView);
}

/** Turns around the target. */
export function orbit(view: Viewpoint, azimuth: number, elevation: number): Viewpoint {
  return { ...view, azimuth: wrapped(view.azimuth + azimuth), elevation: clamp(view.elevation + elevation, -Math.PI / 2, Math.PI / 2) };
}

/** Turns the head: the eye stays, the target moves. */
export function look(view: Viewpoint, azimuth: number, elevation: number): Viewpoint {
  const eye = pose(view).position;
  const turned = orbit(view, azimuth, elevation);
  return { ...turned, target: subtract(eye, scale(view.distance, pose(turned).backward)) };
}

/** Shifts eye and target along the camera's axes, in scene units. */
export function fly(view: Viewpoint, right: number, up: number, forward: number): Viewpoint {
  const axes = pose(view);
  const shift = add(add(scale(right, axes.right), scale(up, axes.up)), scale(-forward, axes.backward));
  return { ...view, target: add(view.target, shift) };
}

/** Shifts so that what lies at the target's distance follows a pointer that moved by these pixels (y down). */
export function pan(view: Viewpoint, dx: number, dy: number, size: Size): Viewpoint {
  const unitsPerPixel = view.distance / focalLength(view, size);
  return fly(view, -dx * unitsPerPixel, dy * unitsPerPixel, 0);
}

/** Multiplies the distance to the target, within bounds that keep numbers sane. */
export function dolly(view: Viewpoint, factor: number, objectRadius: number): Viewpoint {
  const [least, most] = DISTANCE_RANGE_RADII;
  return { ...view, distance: clamp(view.distance * factor, least * objectRadius, most * objectRadius) };
}

/** Another lens from the same place. */
export function withFieldOfView(view: Viewpoint, fieldOfView: number): Viewpoint {
  return { ...view, fieldOfView: clamp(fieldOfView, FIELD_OF_VIEW_RANGE[0], FIELD_OF_VIEW_RANGE[1]) };
}

export function clamp(value: number, least: number, most: number): number {
  return Math.min(Math.max(value, least), most);
}

/** To (−π, π]. */
function wrapped(angle: number): number {
  return angle - 2 * Math.PI * Math.ceil((angle - Math.PI) / (2 * Math.PI));
}
