/** Angles of `look`, `head` and `orbit` are degrees; jaw, gaze and neck are rotation vectors in radians. */
export type Range = [low: number, high: number];
export interface Header {
  name: string;
  licence: string; // what of the head model is in the file, and on what terms
  fps: number; // of the recorded motion
  size: number; // width of the training pictures
  expressions: string[]; // names of the coefficients
  controls: { group: string; name: string; values: number[]; range: Range }[]; // directions among them
  joints: Partial<Record<"jaw" | "look_down" | "look_left" | "left_lid" | "right_lid" | "nod" | "turn", Range>>;
  orbit: { yaw: Range; pitch: Range }; // what the training video shows
  rest: number[]; // the neutral face: expression, jaw 6, eyes 12, eyelids 2, neck 6
}
export interface Pose {
  jaw?: [number, number, number];
  gaze?: [number, number, number];
  neck?: [number, number, number];
  lids?: [left: number, right: number]; // 0 open, 1 closed
  head?: [yaw: number, pitch: number];
}
export type Motion = "idle" | "recorded" | "rest";
/** A sentence for people. */
export class AvatarError extends Error {}
/** Events: "drawn", "motion", "view", and "failed", whose detail is a sentence. */
export class AvatarView extends EventTarget {
  constructor(
    canvas: HTMLCanvasElement,
    parts: { worker: Worker; wasm: ArrayBuffer; file: ArrayBuffer },
    options?: { renderer?: "auto" | "wasm" | "webgl"; still?: boolean },
  );
  readonly ready: Promise<Header>;
  readonly header: Header;
  readonly renderer: "wasm" | "webgl";
  readonly time: number; // seconds into the recorded motion
  readonly isPlaying: boolean;
  readonly isBusy: boolean; // whether a picture is being drawn
  readonly isSupported: boolean; // whether the camera is where the training video was
  readonly frameCount: number;
  readonly limits: { yaw: Range; pitch: Range };
  readonly view: { yaw: number; pitch: number; zoom: number };
  readonly statistics: { milliseconds: number; framesPerSecond: number };
  /** Coefficients by name or number, or controls as "Group: name"; unknown names are returned. */
  setExpression(values: Record<string, number>): string[];
  setPose(pose: Pose): void;
  setParameters(values: ArrayLike<number> | null): void; // in the order of header.rest
  release(): void; // lets go of all that was set
  play(kind?: Motion, options?: { from?: number }): void;
  pause(): void;
  seek(seconds: number): void;
  look(view: { yaw?: number; pitch?: number; zoom?: number }): void;
  resize(width: number): void;
  screenshot(): Promise<Blob>;
  close(): void;
}
/** Pointer, touch, wheel and keys on an element turn and zoom a view, until the function that is returned is called. */
export function steer(view: AvatarView, element: HTMLElement): () => void;
/** <avatar-view src="..." renderer="auto">: fires "load", "drawn" and "error", whose detail is a sentence. */
export class AvatarViewElement extends HTMLElement {
  readonly view?: AvatarView;
  load(source: string | ArrayBuffer): Promise<Header>;
  setExpression(values: Record<string, number>): string[];
  setPose(pose: Pose): void;
  play(kind?: Motion, options?: { from?: number }): void;
  pause(): void;
}
