/** Angles of `look`, `head` and `orbit` are degrees; jaw, gaze and neck are rotation vectors in radians. */
export type Range = [low: number, high: number];
export interface Header {
  name: string;
  licence: string; // what of the head model is in the file, and on what terms
  fps: number; // of the recorded motion
  size: number; // width of the training pictures
  expressions: string[]; // names of the coefficients
  controls: { group: string; name: string; values: number[]; range: Range }[]; // directions among them
  joints: Partial<Record<"jaw" | "look_down" | "look_left" | "left_lid" | "right_lid" | "lean" | "turn", Range>>;
  orbit: { yaw: Range; pitch: Range }; // what the training video shows, from the front
  drive: { // what a face moves: places are expression, jaw 3, eyes 6 and eyelids 2, as departures from the neutral face
    blendshapes: Record<string, [place: number, weight: number][]>; // by ARKit's names: mouthSmileLeft
    low: number[]; // of each place, as far as training showed
    high: number[];
  };
  rest: number[]; // the neutral face: expression, jaw 6, eyes 12, eyelids 2, neck 6
}
export type Vector = [x: number | null, y: number | null, z: number | null];
export interface Pose { // null lets go, also of one number
  jaw?: Vector | null;
  gaze?: Vector | null;
  neck?: Vector | null;
  lids?: [left: number | null, right: number | null] | null; // 0 open, 1 closed
  head?: [yaw: number, pitch: number] | null;
}
export type Motion = "idle" | "recorded" | "rest";
/** As MediaPipe's face landmarker gives them: scores by ARKit's names; the head's pose, 4x4 by columns, OpenGL's axes. */
export interface Face {
  scores: Record<string, number>;
  matrix: ArrayLike<number> | null;
}
/** A sentence for people. */
export class AvatarError extends Error {}
/** Events: "drawn" (detail: { taken }, of a face that drives), "motion", "view", and "failed", whose detail is a sentence. */
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
  readonly motion: Motion | "driven";
  readonly isPlaying: boolean;
  readonly isBusy: boolean; // whether a picture is being drawn
  readonly isSupported: boolean; // whether the camera is where the training video was
  readonly frameCount: number;
  readonly limits: { yaw: Range; pitch: Range };
  readonly view: { yaw: number; pitch: number; zoom: number };
  readonly parameters?: Float32Array; // what is shown, in the order of header.rest
  background: [red: number, green: number, blue: number] | null; // from 0 to 1; null: that of training
  readonly statistics: { milliseconds: number; framesPerSecond: number };
  /** Coefficients by name or number, or controls as "Group: name"; unknown names are returned. */
  setExpression(values: Record<string, number | null>): string[]; // null lets go
  setPose(pose: Pose): void;
  setParameters(values: ArrayLike<number> | null): void; // in the order of header.rest
  /** Show a face; `taken` in milliseconds of performance.now(), of its picture. Faces depart from the neutral one. */
  drive(scores: Face["scores"], matrix?: Face["matrix"], taken?: number): void;
  calibrate(face?: Face): void; // the neutral one; by default the newest
  release(): void; // lets go of all that was set
  play(kind?: Motion, options?: { from?: number }): void;
  pause(): void;
  seek(seconds: number): void;
  look(view: { yaw?: number; pitch?: number; zoom?: number }): void;
  resize(width: number, still?: number): void; // pixels of what moves, and of what does not
  screenshot(width?: number): Promise<Blob>; // a PNG of what is shown, drawn anew where a width is given
  close(): void;
}
/** A camera that drives a view, once. Event: "state". `worker` is of landmarker_worker.js, a classic one. Nothing leaves the page. */
export class FaceCamera extends EventTarget {
  constructor(view: AvatarView, worker: Worker, video?: HTMLVideoElement);
  readonly video: HTMLVideoElement; // the camera's picture
  readonly state: "off" | "starting" | "calibrating" | "following";
  readonly sentence: string; // for people: what to do, or what is wrong
  readonly statistics: { latency: number; framesPerSecond: number; landmarks: number }; // latency, landmarks: milliseconds
  start(landmarker?: string | URL | Blob): Promise<void>; // the file that avatar export --webcam writes, or its address
  stop(): void;
  mirror(isMirror: boolean): void; // left is right, as at first
  calibrate(): void;
}
/** Pointer, touch, wheel and keys on an element turn and zoom a view, until the function that is returned is called. */
export function orbitControls(view: AvatarView, element: HTMLElement): () => void;
/** <avatar-view src="..." renderer="auto">: fires "load", "drawn" and "error", whose detail is a sentence. */
export class AvatarViewElement extends HTMLElement {
  readonly view?: AvatarView;
  load(source: string | ArrayBuffer): Promise<Header>;
  setExpression(values: Record<string, number | null>): string[]; // null lets go
  setPose(pose: Pose): void;
  play(kind?: Motion, options?: { from?: number }): void;
  pause(): void;
  drive(scores: Face["scores"], matrix?: Face["matrix"], taken?: number): void;
  startCamera(landmarker?: string | URL | Blob): Promise<FaceCamera>; // asks for permission: call it on a click
  stopCamera(): void;
}
