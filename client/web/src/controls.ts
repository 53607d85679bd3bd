/**
 * Mouse, touch and keys on a stage, as changes of the viewpoint. Orbit turns around the target; fly turns the head and moves with W A S D.
 */
import { dolly, fly, look, orbit, pan, withFieldOfView, type Size, type Viewpoint } from './camera';

/** What dragging does. */
export type Mode = 'orbit' | 'fly';

/** What the controls act on. */
export interface Steered {
  /** The picture, CSS pixels. */
  size(): Size;
  mode(): Mode;
  /** Of the object, scene units: the measure of speed. */
  objectRadius(): number;
  change(move: (view: Viewpoint) => Viewpoint): void;
  reset(): void;
  toggleMode(): void;
}

/** A drag across the shorter side turns by this. */
const ORBIT_PER_SIDE = Math.PI;
const KEY_TURN_PER_SECOND = Math.PI / 3;
const KEY_DOLLY_PER_SECOND = 2;
const KEY_RADII_PER_SECOND = 1;
const KEY_FIELD_OF_VIEW_PER_SECOND = Math.PI / 9;
const WHEEL_DOLLY_PER_PIXEL = 0.001;
const WHEEL_LINE_PX = 16;
/** A key that is pressed and let go moves at least this long. */
const FIRST_STEP_SECONDS = 1 / 30;
/** After a stall the motion goes on instead of leaping. */
const LONGEST_STEP_SECONDS = 0.1;

/** Keys that move while they are held, by KeyboardEvent.code; the view is asked for anew at every step. */
const HELD_KEYS: Readonly<Record<string, (seconds: number, steered: Steered, isShifted: boolean) => (view: Viewpoint) => Viewpoint>> = {
  ArrowLeft: arrow(-1, 0),
  ArrowRight: arrow(1, 0),
  ArrowUp: arrow(0, 1),
  ArrowDown: arrow(0, -1),
  KeyA: flight(-1, 0, 0),
  KeyD: flight(1, 0, 0),
  KeyQ: flight(0, -1, 0),
  KeyE: flight(0, 1, 0),
  KeyW: flight(0, 0, 1),
  KeyS: flight(0, 0, -1),
  Equal: closer(-1),
  NumpadAdd: closer(-1),
  PageUp: closer(-1),
  Minus: closer(1),
  NumpadSubtract: closer(1),
  PageDown: closer(1),
  BracketLeft: lens(-1),
  BracketRight: lens(1),
};

function arrow(x: number, y: number) {
  return (seconds: number, steered: Steered, isShifted: boolean) => (view: Viewpoint) => {
    const angle = KEY_TURN_PER_SECOND * seconds;
    if (isShifted) {
      const size = steered.size();
      const pixels = Math.min(size.width, size.height) * seconds;
      return pan(view, -x * pixels, y * pixels, size);
    }
    return steered.mode() === 'fly' ? look(view, -x * angle, -y * angle) : orbit(view, x * angle, y * angle);
  };
}

function flight(right: number, up: number, forward: number) {
  return (seconds: number, steered: Steered, isShifted: boolean) => (view: Viewpoint) => {
    const step = KEY_RADII_PER_SECOND * (isShifted ? 4 : 1) * steered.objectRadius() * seconds;
    return fly(view, right * step, up * step, forward * step);
  };
}

function closer(direction: number) {
  return (seconds: number, steered: Steered) => (view: Viewpoint) =>
    dolly(view, KEY_DOLLY_PER_SECOND ** (direction * seconds), steered.objectRadius());
}

function lens(direction: number) {
  return (seconds: number) => (view: Viewpoint) =>
    withFieldOfView(view, view.fieldOfView + direction * KEY_FIELD_OF_VIEW_PER_SECOND * seconds);
}

/** Listens until the signal comes. */
export function steer(stage: HTMLElement, steered: Steered, signal: AbortSignal): void {
  steerByPointer(stage, steered, signal);
  steerByKeys(stage, steered, signal);
  const wheel = (event: WheelEvent): void => {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? WHEEL_LINE_PX : 1);
    steered.change((view) => approach(view, Math.exp(pixels * WHEEL_DOLLY_PER_PIXEL), steered));
  };
  stage.addEventListener('wheel', wheel, { passive: false, signal });
  stage.addEventListener('contextmenu', (event) => event.preventDefault(), { signal });
}

/** Toward the target; in fly mode past it. */
function approach(view: Viewpoint, factor: number, steered: Steered): Viewpoint {
  return steered.mode() === 'fly'
    ? fly(view, 0, 0, -Math.log(factor) * steered.objectRadius())
    : dolly(view, factor, steered.objectRadius());
}

interface Pointer {
  readonly x: number;
  readonly y: number;
}

function steerByPointer(stage: HTMLElement, steered: Steered, signal: AbortSignal): void {
  const pointers = new Map<number, Pointer>();
  let isPanning = false;
  const down = (event: PointerEvent): void => {
    if (event.target instanceof Element && event.target.closest('button, input, a, select') !== null) return;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    isPanning = event.button !== 0 || event.shiftKey;
    stage.setPointerCapture(event.pointerId);
    stage.focus({ preventScroll: true });
    // Else the middle button scrolls.
    event.preventDefault();
  };
  const move = (event: PointerEvent): void => {
    const before = pointers.get(event.pointerId);
    if (before === undefined) return;
    const now = { x: event.clientX, y: event.clientY };
    pointers.set(event.pointerId, now);
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const size = steered.size();
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, pointer]) => pointer);
    const other = others[0];
    if (other !== undefined) {
      // Two fingers: each carries half of the shift, and their distance is the distance.
      const spread = (p: Pointer): number => Math.max(Math.hypot(p.x - other.x, p.y - other.y), 1);
      steered.change((view) => pan(approach(view, spread(before) / spread(now), steered), dx / 2, dy / 2, size));
    } else if (isPanning) {
      steered.change((view) => pan(view, dx, dy, size));
    } else {
      steered.change((view) => turn(view, dx, dy, size, steered.mode()));
    }
  };
  const up = (event: PointerEvent): void => {
    pointers.delete(event.pointerId);
  };
  stage.addEventListener('pointerdown', down, { signal });
  stage.addEventListener('pointermove', move, { signal });
  stage.addEventListener('pointerup', up, { signal });
  stage.addEventListener('pointercancel', up, { signal });
}

/** What is seen follows the pointer. */
function turn(view: Viewpoint, dx: number, dy: number, size: Size, mode: Mode): Viewpoint {
  const side = Math.min(size.width, size.height);
  if (mode === 'orbit') {
    const perPixel = ORBIT_PER_SIDE / side;
    return orbit(view, -dx * perPixel, dy * perPixel);
  }
  const perPixel = view.fieldOfView / side;
  return look(view, dx * perPixel, -dy * perPixel);
}

function steerByKeys(stage: HTMLElement, steered: Steered, signal: AbortSignal): void {
  const held = new Set<string>();
  let isShifted = false;
  let last: number | undefined;
  const step = (seconds: number): void => {
    for (const code of held) {
      const motion = HELD_KEYS[code];
      if (motion !== undefined) steered.change(motion(seconds, steered, isShifted));
    }
  };
  const tick = (now: number): void => {
    if (held.size === 0 || signal.aborted) {
      last = undefined;
      return;
    }
    if (last !== undefined) step(Math.min((now - last) / 1000, LONGEST_STEP_SECONDS));
    last = now;
    requestAnimationFrame(tick);
  };
  const down = (event: KeyboardEvent): void => {
    // Keys of a control inside the stage are the control's.
    if (event.target !== stage || event.ctrlKey || event.metaKey || event.altKey) return;
    isShifted = event.shiftKey;
    if (event.code in HELD_KEYS) {
      event.preventDefault();
      if (held.has(event.code)) return;
      if (held.size === 0) requestAnimationFrame(tick);
      held.add(event.code);
      const motion = HELD_KEYS[event.code];
      if (motion !== undefined) steered.change(motion(FIRST_STEP_SECONDS, steered, isShifted));
    } else if (event.code === 'KeyR' || event.code === 'Home') {
      steered.reset();
    } else if (event.code === 'KeyF') {
      steered.toggleMode();
    }
  };
  const up = (event: KeyboardEvent): void => {
    isShifted = event.shiftKey;
    held.delete(event.code);
  };
  stage.addEventListener('keydown', down, { signal });
  stage.addEventListener('keyup', up, { signal });
  stage.addEventListener('blur', () => held.clear(), { signal });
}
