// An avatar on a canvas: loads it and draws it whenever it has changed. No interface of its own; <avatar-view> and the page
// are built on this.
import { paint, png } from "./canvas.js";
import { AvatarError } from "./core.js";
import { FaceDriver } from "./drive.js";
import { blended, headTurn, idle, multiply, orbit, recorded } from "./motion.js";
import { Settings } from "./settings.js";
import { WebglRenderer, hasRealGpu } from "./webgl_renderer.js";

const BLEND_SECONDS = 0.4; // from one motion to another
const MARGIN = 10; // degrees by which the camera may leave what the training video shows
const ZOOM = [0.5, 4];
const STILL_AFTER = 250; // milliseconds without a change, after which the picture is drawn sharp
const LEAST_SIDE = 32, MOST_SIDE = 4096; // pixels

export class AvatarView extends EventTarget {
  /**
   * @param canvas  where to draw
   * @param parts   { worker: Worker, wasm: ArrayBuffer, perhaps gzip's, file: ArrayBuffer }
   * @param options { renderer: "auto" | "wasm" | "webgl", still: boolean }
   */
  constructor(canvas, parts, options = {}) {
    super();
    this.canvas = canvas;
    this.options = { renderer: "auto", still: false, ...options };
    this.view = { yaw: 0, pitch: 0, zoom: 1 };
    this.background = null; // red, green and blue from 0 to 1; null for those of training
    this.statistics = { milliseconds: 0, framesPerSecond: 0 };
    this.#worker = parts.worker;
    this.#worker.onmessage = ({ data }) => this.#receive(data);
    this.#worker.onerror = () => this.#fail("The drawing worker could not be started in this browser.");
    /** Resolves with the avatar's header when it can be drawn. */
    this.ready = new Promise((resolve, reject) => (this.#settle = { resolve, reject }));
    this.#worker.postMessage({ type: "load", wasm: parts.wasm, file: parts.file });
    const kind = this.options.renderer; // while the worker loads
    this.#wantsGpu = kind === "webgl" || (kind === "auto" && hasRealGpu());
  }

  #worker;
  #wantsGpu;
  #settle;
  #gpu;
  #context;
  #core; // { header, motion, poses }
  #source = { kind: "idle", since: 0, first: 0, frame: 0, paused: false };
  #driver;
  #previous; // the pose that a new motion blends from
  #pose;
  #settings;
  #shown; // what was asked for last
  #changed = 0; // when something else was to be seen for the last time
  #saving = []; // pictures that were asked for, in order
  #inFlight = false;
  #loop;
  #width = { moving: 0, still: 0 }; // pixels
  #times = [];

  get header() {
    return this.#core?.header;
  }

  get renderer() {
    return this.#gpu ? "webgl" : "wasm";
  }

  /** Seconds into the recorded motion. */
  get time() {
    return this.#source.kind === "recorded" ? this.#source.frame / this.header.fps : 0;
  }

  /** "idle", "recorded", "rest" or, while faces come, "driven". */
  get motion() {
    return this.#source.kind;
  }

  get isPlaying() {
    return this.#source.kind === "recorded" && !this.#source.paused;
  }

  get isBusy() {
    return this.#inFlight; // a picture is being drawn
  }

  get frameCount() {
    return this.#core ? this.#core.poses.length / 12 : 0;
  }

  get parameters() {
    return this.#pose?.parameters; // what is shown, in the order of `header.rest`
  }

  /** Expression coefficients by name or number, or controls as "Group: name" (`header.controls`); null lets go. Returns unknown names. */
  setExpression(values) {
    return this.#settings.setExpression(values);
  }

  /** Jaw, gaze and neck as rotation vectors in radians, lids from 0 (open) to 1; `head`: [yaw, pitch] in degrees; null lets go. */
  setPose(pose) {
    this.#settings.setPose(pose);
  }

  /** All parameters at once, in the order of `header.rest`; null lets go of them. Throws AvatarError for another number. */
  setParameters(values) {
    this.#settings.setParameters(values);
  }

  release() {
    this.#settings?.release();
  }

  /** Play "idle", "recorded" (the motion that came with the avatar) or "rest"; `from` in seconds. */
  play(kind = "recorded", { from } = {}) {
    if (kind === "recorded" && this.frameCount === 0) kind = "idle";
    this.#previous = this.#pose && { pose: this.#pose, since: performance.now() };
    const frame = kind === "recorded" ? this.#clampFrame((from ?? this.time) * this.header.fps) : 0;
    this.#source = { kind, since: performance.now(), first: frame, frame, paused: false };
    this.#tell("motion");
  }

  /**
   * Show a face: ARKit's blendshape scores by name (mouthSmileLeft), and the head's pose, 4x4 by columns in OpenGL's axes, both
   * as MediaPipe's face landmarker gives them. `taken`: when its picture was, in milliseconds of performance.now().
   */
  drive(scores, matrix = null, taken = performance.now()) {
    const numbers = [...Object.values(scores), ...(matrix ?? [])];
    if (!numbers.every(Number.isFinite) || (matrix && matrix.length !== 16))
      throw new AvatarError("A face is scores by name and 16 numbers of its pose.");
    const before = this.#source.kind === "driven" ? null : this.#pose && { pose: this.#pose, since: performance.now() };
    const pose = this.#driver.next({ scores, matrix }, taken / 1000);
    if (before) this.#previous = before;
    this.#source = { kind: "driven", since: 0, first: 0, frame: 0, paused: false, pose, taken };
    if (before) this.#tell("motion");
  }

  /** Take a face { scores, matrix }, by default the newest, for the driver's neutral one. */
  calibrate(face) {
    this.#driver.calibrate(face);
  }

  pause() {
    this.#source.paused = true;
    this.#tell("motion");
  }

  /** Show one frame of the recorded motion, and stay there. */
  seek(seconds) {
    if (this.frameCount === 0) return;
    const frame = this.#clampFrame(seconds * this.header.fps);
    this.#source = { kind: "recorded", since: performance.now(), first: frame, frame, paused: true };
    this.#tell("motion");
  }

  /** Turn the camera, within `limits`; `zoom` is a factor. */
  look(view) {
    const clamp = (value, [low, high], otherwise) =>
      Number.isFinite(value) ? Math.min(Math.max(value, low), high) : otherwise;
    const { yaw, pitch, zoom } = { ...this.view, ...view }, { limits } = this;
    this.view = {
      yaw: clamp(yaw, limits.yaw, this.view.yaw),
      pitch: clamp(pitch, limits.pitch, this.view.pitch),
      zoom: clamp(zoom, ZOOM, this.view.zoom),
    };
    this.#tell("view");
  }

  /** Degrees by which the camera may turn: what the training video shows, and a margin in which the avatar guesses. */
  get limits() {
    const widened = ([low, high]) => [low - MARGIN, high + MARGIN];
    return { yaw: widened(this.header.orbit.yaw), pitch: widened(this.header.orbit.pitch) };
  }

  /** Whether the camera is where the training video was. */
  get isSupported() {
    return ["yaw", "pitch"].every((axis) => {
      const [low, high] = this.header.orbit[axis];
      return this.view[axis] >= low - 0.01 && this.view[axis] <= high + 0.01;
    });
  }

  /** Width of the drawn picture in pixels, and of one that nothing has changed for a moment. */
  resize(width, still = width) {
    const bounded = (size) => Math.min(Math.max(LEAST_SIDE, Math.round(size)), MOST_SIDE);
    this.#width = { moving: bounded(width), still: bounded(Math.max(width, still)) };
  }

  /** A PNG of what is shown; drawn anew where a `width` is given, with no side above MOST_SIDE. */
  async screenshot(width) {
    if (!this.#shown) throw new AvatarError("The avatar is not drawn yet.");
    if (width === undefined) return png(this.canvas);
    const asked = Math.round(Math.min(Math.max(LEAST_SIDE, width), MOST_SIDE, MOST_SIDE * this.#shown.base.aspect));
    return new Promise((resolve, reject) => {
      const frame = this.#frame(this.#shown, asked);
      this.#saving.push({ resolve, reject, ...frame });
      this.#worker.postMessage({ ...frame, wants: "saved" });
    });
  }

  close() {
    this.ready.catch(() => {}); // nobody need listen
    this.#reject("The avatar was closed.");
    this.#worker.terminate();
    this.#gpu?.close();
    cancelAnimationFrame(this.#loop);
  }

  #clampFrame(frame) {
    return Math.min(Math.max(Math.round(frame) || 0, 0), Math.max(this.frameCount - 1, 0));
  }

  #receive(data) {
    if (data.type === "failed") {
      if (!this.#core) return this.#fail(data.sentence);
      if (data.wants === "saved") return this.#saving.shift().reject(new AvatarError(data.sentence));
      this.#inFlight = false; // what cannot be drawn is not asked for again before it changes
      return this.#tellFailed(data.sentence);
    }
    if (data.type === "ready") return this.#start(data);
    if (data.type === "saved") {
      const { resolve, width, height } = this.#saving.shift(), canvas = document.createElement("canvas");
      paint(canvas, canvas.getContext("2d"), data.values, width, height);
      return resolve(png(canvas));
    }
    this.#inFlight = false;
    const { camera, width, height, background } = this.#shown;
    if (data.type === "gaussians") {
      this.#gpu.draw(data.values, camera, width, height, background, this.header.blur);
    } else paint(this.canvas, this.#context, data.values, width, height);
    this.#count(data.milliseconds);
    this.dispatchEvent(new CustomEvent("drawn", { detail: { taken: this.#shown.taken } }));
  }

  #start({ header, motion, poses }) {
    this.#core = { header, motion, poses };
    this.#driver = new FaceDriver(header);
    this.#settings = new Settings(header);
    if (this.#width.moving === 0) this.resize(header.size);
    if (this.#wantsGpu) {
      try {
        this.#gpu = new WebglRenderer(this.canvas, () => this.#shown && (this.#shown = { ...this.#shown, key: undefined }));
      } catch (error) {
        return this.#fail(`This browser cannot draw with WebGL2 (${error.message}).`);
      }
    } else {
      this.#context = this.canvas.getContext("2d");
    }
    this.play(this.options.still ? "rest" : "idle");
    this.#settle.resolve(header);
    const loop = (now) => {
      this.#loop = requestAnimationFrame(loop);
      if (!this.#inFlight) this.#request(now);
    };
    this.#loop = requestAnimationFrame(loop);
  }

  #request(now) {
    const { header } = this, pose = this.#current(now), base = { ...header.camera, rotation: pose.rotation, translation: pose.translation };
    const [yaw, pitch] = [0, 1].map((i) => pose.turn[i] + this.#settings.turned[i]);
    const turn = headTurn([yaw, pitch]);
    base.rotation = multiply(base.rotation, turn);
    base.head = pose.head && multiply(pose.head, turn);
    const { parameters } = pose, { view, background } = this, key = JSON.stringify([Array.from(parameters), base, view, background]);
    if (key !== this.#shown?.key) this.#changed = now;
    const wanted = now - this.#changed < STILL_AFTER ? this.#width.moving : this.#width.still;
    const width = Math.max(1, Math.min(wanted, Math.floor(MOST_SIDE * base.aspect)));
    if (key === this.#shown?.key && width === this.#shown.width) return; // nothing has changed
    const frame = this.#frame({ parameters, base, view }, width);
    this.#shown = { ...frame, base, view, key, taken: this.#source.taken };
    this.#inFlight = true;
    this.#worker.postMessage({ ...frame, wants: this.#gpu ? "gaussians" : "picture" });
  }

  /** What the worker draws. */
  #frame({ parameters, base, view }, width) {
    const height = Math.max(1, Math.round(width / base.aspect)), background = this.background ?? this.header.background;
    const camera = orbit(base, view, width), head = base.head ?? camera.rotation;
    return { type: "frame", parameters, camera, head, width, height, background };
  }

  #current(now) {
    const { header } = this, source = this.#source, seconds = Math.max(now - source.since, 0) / 1000;
    let pose;
    if (source.kind === "recorded") {
      if (!source.paused) source.frame = Math.round(source.first + seconds * header.fps) % this.frameCount;
      pose = recorded(this.#core, source.frame);
    } else if (source.kind === "driven") {
      pose = source.pose;
    } else {
      pose = idle(header, seconds, source.kind === "rest" || source.paused);
    }
    const since = this.#previous ? (now - this.#previous.since) / 1000 : Infinity;
    pose = { ...header.camera, turn: [0, 0], ...pose, parameters: Float32Array.from(pose.parameters) };
    if (since < BLEND_SECONDS) Object.assign(pose, blended(this.#previous.pose, pose, Math.max(since, 0) / BLEND_SECONDS));
    this.#settings.apply(pose.parameters);
    return (this.#pose = pose);
  }

  #count(milliseconds) {
    const now = performance.now();
    this.#times = [...this.#times.filter((t) => now - t < 2000), now];
    const span = (now - this.#times[0]) / 1000;
    this.statistics = { milliseconds, framesPerSecond: span > 0.2 ? (this.#times.length - 1) / span : 0 };
  }

  #reject(sentence) {
    for (const { reject } of [this.#settle, ...this.#saving.splice(0)]) reject(new AvatarError(sentence));
  }

  #fail(sentence) {
    this.#reject(sentence);
    this.#tellFailed(sentence);
  }

  #tellFailed(sentence) {
    this.dispatchEvent(new CustomEvent("failed", { detail: sentence }));
  }

  #tell(kind) {
    this.dispatchEvent(new Event(kind));
  }
}
