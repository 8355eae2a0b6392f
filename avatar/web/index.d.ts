/** The 40 lines that others build on. Angles of `look` and `head` are degrees, rotation vectors radians. */
export interface Header {
  name: string;
  fps: number;
  expressions: string[]; // names of the coefficients that setExpression takes
  range: [number[], number[]]; // of each coefficient in the training video
  rest: number[]; // expression, jaw 6, eyes 12, eyelids 2, neck 6
  yaw: [number, number]; // degrees that the training video shows
}
export interface Pose {
  jaw?: [number, number, number];
  gaze?: [number, number, number];
  neck?: [number, number, number];
  lids?: [number, number]; // left, right: 0 open, 1 closed
  head?: [number, number]; // yaw, pitch
}
export type Motion = "idle" | "recorded" | "rest";
export class AvatarError extends Error {}
/** Events: "drawn", "motion", "view", "failed" (its detail is a sentence). */
export class AvatarView extends EventTarget {
  constructor(
    canvas: HTMLCanvasElement,
    parts: { worker: Worker; wasm: ArrayBuffer; file: ArrayBuffer },
    options?: { renderer?: "auto" | "wasm" | "webgl"; still?: boolean },
  );
  readonly ready: Promise<Header>;
  readonly header: Header;
  readonly renderer: "wasm" | "webgl";
  readonly time: number;
  readonly isPlaying: boolean;
  readonly frameCount: number;
  readonly limits: [number, number];
  readonly statistics: { milliseconds: number; framesPerSecond: number };
  setExpression(values: Record<string, number>): string[];
  setPose(pose: Pose): void;
  setParameters(values: ArrayLike<number> | null): void;
  release(): void;
  play(kind?: Motion, options?: { from?: number }): void;
  pause(): void;
  seek(seconds: number): void;
  look(view: { yaw?: number; pitch?: number; zoom?: number }): void;
  resize(width: number): void;
  screenshot(): Promise<Blob>;
  close(): void;
}
export function steer(view: AvatarView, element: HTMLElement): () => void;
/** <avatar-view src="..." renderer="auto">: fires "load" and "error"; `load` takes a URL or a file's bytes. */
export class AvatarViewElement extends HTMLElement {
  readonly view?: AvatarView;
  load(source: string | ArrayBuffer): Promise<Header>;
  setExpression(values: Record<string, number>): string[];
  setPose(pose: Pose): void;
  play(kind?: Motion, options?: { from?: number }): void;
  pause(): void;
}
