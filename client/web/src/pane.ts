/** One live picture: a session, what it shows, and how long its frames took. A split view has two. */
import type { Size, Viewpoint } from './camera';
import { make } from './dom';
import type { Drawn } from './meters';
import { Picture } from './picture';
import { Session, type Phase } from './session';
import { passesOf, type Delivery, type Kind, type Settings } from './settings';
import { cameraMessage, sessionCalls, settingsMessage, type Camera, type Frame, type Opening, type SettingsUpdate } from './wire';

/** Who is told. */
export interface PaneListener {
  phase(phase: Phase): void;
  drawn(frame: Frame, measured: Drawn): void;
  /** For people. */
  rejected(message: string): void;
}

/** A pose or setting without a frame for so long: the connection may be dead without having said so. Doubled while that is of no use. */
const PATIENCE_MILLIS = 30_000;
/** Poses whose time of sending is remembered: more than can be on their way. */
const REMEMBERED_POSES = 64;

export class Pane {
  readonly element = make('div', { class: 'pane' });
  private readonly picture: Picture;
  // Over the picture's corner while more passes follow.
  private readonly refining = make('span', { class: 'refining', hidden: true });
  private passes = 1;
  private readonly session: Session<Camera, SettingsUpdate, Frame>;
  private readonly sentAt = new Map<bigint, number>();
  private view: Viewpoint | undefined;
  private size: Size = { width: 1, height: 1 };
  private newestPose = 0n;
  // Whether the picture is a frame of the newest pose, in full size.
  private isCurrent = false;
  private patience = PATIENCE_MILLIS;
  private watchdog: number | undefined;

  constructor(
    private readonly kind: Kind,
    opening: Opening,
    settings: Settings,
    delivery: Delivery,
    private readonly listener: PaneListener,
  ) {
    this.picture = new Picture(
      (message) => listener.rejected(message),
      () => this.session.reconnect(),
    );
    this.element.append(this.picture.element, this.refining);
    this.setLook(settings, delivery);
    this.session = new Session<Camera, SettingsUpdate, Frame>(
      sessionCalls(opening),
      settingsMessage(kind, settings, delivery),
      (frame) => frame.frameId,
      {
        phase: (phase) => listener.phase(phase),
        rejected: (message) => listener.rejected(message),
        frame: (frame, acknowledge) => this.picture.show(frame, () => this.shown(frame, acknowledge)),
      },
      sleep,
    );
  }

  /** Where the viewer is now; the frame has this many pixels. */
  setView(view: Viewpoint, size: Size): void {
    this.picture.setSize(size);
    this.view = view;
    this.size = size;
    const id = this.session.setPose(cameraMessage(view, size));
    this.newestPose = BigInt(id);
    this.isCurrent = false;
    this.refining.hidden = true;
    this.picture.awaits(view);
    this.expectFrame();
    this.sentAt.set(this.newestPose, performance.now());
    const oldest = this.sentAt.keys().next().value;
    if (this.sentAt.size > REMEMBERED_POSES && oldest !== undefined) this.sentAt.delete(oldest);
    this.element.dataset['pose'] = String(id);
  }

  /** The picture, if it shows the newest pose in full size. */
  current(): HTMLCanvasElement | undefined {
    return this.isCurrent ? this.picture.canvas : undefined;
  }

  setSettings(settings: Settings, delivery: Delivery): void {
    this.setLook(settings, delivery);
    this.isCurrent = false;
    this.session.setSettings(settingsMessage(this.kind, settings, delivery));
    this.expectFrame();
    // A pose of its own: a frame of the old settings, still on its way, is not taken for the new picture.
    if (this.view !== undefined) this.setView(this.view, this.size);
  }

  retry(): void {
    this.session.retry();
  }

  close(): void {
    window.clearTimeout(this.watchdog);
    this.session.close();
    this.picture.close();
    this.element.remove();
  }

  private setLook(settings: Settings, { warp }: Delivery): void {
    const { overlay } = settings;
    this.passes = passesOf(settings);
    this.refining.hidden = true;
    this.picture.setWarp(warp === 'depth');
    this.picture.setOverlay(overlay === 'state' || overlay === 'samples' ? overlay : undefined);
  }

  private expectFrame(): void {
    this.watchdog ??= window.setTimeout(() => {
      this.watchdog = undefined;
      this.patience *= 2;
      this.session.reconnect();
    }, this.patience);
  }

  private shown(frame: Frame, acknowledge: () => void): void {
    acknowledge();
    window.clearTimeout(this.watchdog);
    this.watchdog = undefined;
    this.patience = PATIENCE_MILLIS;
    this.isCurrent = frame.poseId === this.newestPose && this.picture.isFull(frame);
    if (frame.poseId === this.newestPose) {
      this.picture.hasArrived();
    } else if (this.view !== undefined) {
      this.picture.awaits(this.view);
      this.expectFrame();
    }
    const atMillis = performance.now();
    const sent = this.sentAt.get(frame.poseId);
    // Later frames of the same pose are refinements, not answers.
    this.sentAt.delete(frame.poseId);
    Object.assign(this.element.dataset, { shown: String(frame.poseId), final: String(frame.isFinal), frame: String(frame.frameId) });
    this.element.dataset['passes'] = String(frame.passesDone);
    // A first pass says nothing: most are of a moving viewer.
    this.refining.hidden = frame.isFinal || frame.passesDone < 2 || frame.poseId !== this.newestPose;
    this.refining.textContent = `refining ${frame.passesDone} / ${this.passes}`;
    const tier = frame.cache?.adapter ?? frame.cache;
    this.listener.drawn(frame, {
      atMillis,
      bytes: frame.color.length + frame.depth.length + frame.provenance.length,
      latencyMillis: sent === undefined ? undefined : atMillis - sent,
      hits: Number(tier?.hits ?? 0n),
      lookUps: Number(tier?.lookUps ?? 0n),
    });
  }
}

function sleep(millis: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const timer = window.setTimeout(resolve, millis);
    signal.addEventListener('abort', () => {
      window.clearTimeout(timer);
      resolve();
    });
  });
}
