// An avatar on a canvas: loads it, draws it whenever it has changed, and turns it under the pointer. No interface of its own;
// <avatar-view> and the page are built on this.
import { AvatarError } from "./core.js";
import { idle, mix, multiply, orbit, places, recorded, rotation, sixD } from "./motion.js";
import { WebglRenderer, hasRealGpu } from "./webgl.js";

const BLEND_SECONDS = 0.4; // from one motion to another
const MARGIN = 12; // degrees beyond what the training video shows
const MAX_PITCH = 20;

/** @typedef {{ parameters: Float32Array, turn?: number[], rotation?: number[], translation?: number[] }} Pose */

export class AvatarView extends EventTarget {
  /**
   * @param canvas  where to draw
   * @param parts   { worker: Worker, wasm: ArrayBuffer, file: ArrayBuffer }
   * @param options { renderer: "auto" | "wasm" | "webgl", size: number, still: boolean }
   */
  constructor(canvas, parts, options = {}) {
    super();
    this.canvas = canvas;
    this.options = { renderer: "auto", still: false, ...options };
    this.view = { yaw: 0, pitch: 0, zoom: 1, shift: [0, 0] };
    this.statistics = { milliseconds: 0, framesPerSecond: 0 };
    this.#worker = parts.worker;
    this.#worker.onmessage = ({ data }) => this.#receive(data);
    this.#worker.onerror = () => this.#fail("The drawing worker could not be started in this browser.");
    const kind = this.options.renderer;
    this.#wantsGpu = kind === "webgl" || (kind === "auto" && hasRealGpu());
    this.#worker.postMessage({ type: "load", wasm: parts.wasm, file: parts.file, wantsColours: this.#wantsGpu });
    /** Resolves with the avatar's header when it can be drawn. */
    this.ready = new Promise((resolve, reject) => Object.assign(this, { _resolve: resolve, _reject: reject }));
  }

  #worker;
  #wantsGpu;
  #gpu;
  #header;
  #core; // { header, motion, poses }: what `recorded` needs
  #source = { kind: "idle", since: 0 };
  #previous; // the pose that a new motion blends from
  #pinned = new Map(); // parameter index -> value that a caller has set
  #turned = [0, 0];
  #pose;
  #id = 0;
  #inFlight = false;
  #size = 0;
  #times = [];
  #last; // the posed Gaussians, to draw again from elsewhere

  get header() {
    return this.#header;
  }

  get renderer() {
    return this.#gpu ? "webgl" : "wasm";
  }

  /** Seconds into the motion that plays. */
  get time() {
    return this.#source.kind === "recorded" ? this.#source.frame / this.#header.fps : 0;
  }

  get isPlaying() {
    return this.#source.kind === "recorded" && !this.#source.paused;
  }

  get frameCount() {
    return this.#core ? this.#core.poses.length / 12 : 0;
  }

  /** Expression coefficients by name or index; they stay until `release`. Unknown names are ignored and returned. */
  setExpression(values) {
    const unknown = [];
    for (const [key, value] of Object.entries(values)) {
      const index = /^\d+$/.test(key) ? Number(key) : this.#header.expressions.indexOf(key);
      if (index < 0 || index >= this.#header.sizes.expressions || !Number.isFinite(value)) unknown.push(key);
      else this.#pinned.set(index, value);
    }
    return unknown;
  }

  /** Jaw, gaze and neck as rotation vectors in radians, lids from 0 (open) to 1; `head`: [yaw, pitch] in degrees. */
  setPose({ jaw, gaze, neck, lids, head } = {}) {
    const at = places(this.#header.sizes.expressions);
    const pin = (start, values) => values.forEach((v, i) => this.#pinned.set(start + i, v));
    if (jaw) pin(at.jaw, sixD(rotation(jaw)));
    if (neck) pin(at.neck, sixD(rotation(neck)));
    if (gaze) [at.eyes, at.eyes + 6].forEach((start) => pin(start, sixD(rotation(gaze))));
    if (lids) pin(at.eyelids, lids);
    if (head) this.#turned = head;
  }

  /** All parameters at once, in the order of `header.rest`; null lets go of them. */
  setParameters(values) {
    this.#pinned.clear();
    if (values) values.forEach((value, i) => this.#pinned.set(i, value));
  }

  /** Let go of what was set. */
  release() {
    this.#pinned.clear();
    this.#turned = [0, 0];
  }

  /** Play "idle", "recorded" (the motion that came with the avatar) or "rest"; `from` in seconds. */
  play(kind = "recorded", { from } = {}) {
    this.#previous = this.#pose && { pose: this.#pose, since: performance.now() };
    const frame = kind === "recorded" ? this.#clampFrame((from ?? this.time) * this.#header.fps) : 0;
    this.#source = { kind, since: performance.now(), first: frame, frame, paused: false };
    this.#tell("motion");
  }

  pause() {
    this.#source.paused = true;
    this.#tell("motion");
  }

  /** Show one frame of the recorded motion, and stay there. */
  seek(seconds) {
    const frame = this.#clampFrame(seconds * this.#header.fps);
    this.#source = { kind: "recorded", since: performance.now(), first: frame, frame, paused: true };
    this.#tell("motion");
  }

  /** Turn the camera, within what the training video supports. */
  look(view) {
    const [low, high] = this.limits;
    Object.assign(this.view, view);
    this.view.yaw = Math.min(Math.max(this.view.yaw, low), high);
    this.view.pitch = Math.min(Math.max(this.view.pitch, -MAX_PITCH), MAX_PITCH);
    this.view.zoom = Math.min(Math.max(this.view.zoom, 0.5), 4);
    this.#tell("view");
  }

  /** Degrees of yaw, beyond which the avatar would guess. */
  get limits() {
    return [this.#header.yaw[0] - MARGIN, this.#header.yaw[1] + MARGIN];
  }

  /** Width of the drawn picture in pixels. */
  resize(width) {
    this.#size = Math.max(32, Math.round(width));
  }

  /** A PNG of what is shown. */
  screenshot() {
    return new Promise((resolve) => this.canvas.toBlob(resolve, "image/png"));
  }

  close() {
    this.#worker.terminate();
    cancelAnimationFrame(this.#id);
  }

  #clampFrame(frame) {
    return Math.min(Math.max(Math.round(frame), 0), Math.max(this.frameCount - 1, 0));
  }

  #receive(data) {
    if (data.type === "failed") return this.#fail(data.sentence);
    if (data.type === "ready") return this.#start(data);
    this.#inFlight = false;
    if (data.type === "gaussians") {
      this.#last = data;
      this.#gpu.draw(data, this.#shown.camera, this.#shown.width, this.#shown.height, this.#header.background);
    } else {
      const { canvas } = this;
      if (canvas.width !== data.width || canvas.height !== data.height)
        Object.assign(canvas, { width: data.width, height: data.height });
      this.#context.putImageData(new ImageData(data.pixels, data.width, data.height), 0, 0);
    }
    this.#count(data.milliseconds);
    this.#tell("drawn");
  }

  #shown;
  #context;

  #start({ header, motion, poses, sh }) {
    this.#header = header;
    this.#core = { header, motion, poses };
    this.#size ||= header.size;
    if (this.#wantsGpu) {
      try {
        this.#gpu = new WebglRenderer(this.canvas, header.sizes.gaussians, sh);
      } catch (error) {
        if (this.options.renderer === "webgl") return this.#fail(`This browser cannot draw with WebGL2 (${error.message}).`);
      }
    }
    if (!this.#gpu) this.#context = this.canvas.getContext("2d");
    this.play(this.options.still ? "rest" : "idle");
    this._resolve(header);
    const loop = (now) => {
      this.#id = requestAnimationFrame(loop);
      if (!this.#inFlight) this.#request(now);
    };
    this.#id = requestAnimationFrame(loop);
  }

  #request(now) {
    const pose = this.#current(now), base = { ...this.#header.camera };
    if (pose.rotation) Object.assign(base, { rotation: pose.rotation, translation: pose.translation });
    const [yaw, pitch] = [0, 1].map((i) => (pose.turn?.[i] ?? 0) + this.#turned[i]);
    base.rotation = multiply(base.rotation, rotation([(pitch * Math.PI) / 180, (yaw * Math.PI) / 180, 0]));
    const width = this.#size, height = Math.max(1, Math.round(width / base.aspect));
    const camera = orbit(base, this.view, width);
    const key = JSON.stringify([Array.from(pose.parameters), camera, width]);
    if (key === this.#shown?.key) return; // nothing has changed
    this.#shown = { camera, width, height, key };
    this.#inFlight = true;
    this.#worker.postMessage({
      type: "frame", id: this.#id, parameters: pose.parameters, camera, width, height,
      background: this.#header.background, wants: this.#gpu ? "gaussians" : "picture",
    });
  }

  #current(now) {
    const source = this.#source, seconds = (now - source.since) / 1000;
    let pose;
    if (source.kind === "recorded") {
      if (!source.paused) source.frame = Math.round(source.first + seconds * this.#header.fps) % Math.max(this.frameCount, 1);
      pose = recorded(this.#core, source.frame);
    } else {
      pose = idle(this.#header, seconds, source.kind === "rest" || source.paused);
    }
    const since = this.#previous ? (now - this.#previous.since) / 1000 : Infinity;
    let parameters = Float32Array.from(pose.parameters);
    if (since < BLEND_SECONDS) parameters = mix(this.#previous.pose.parameters, parameters, since / BLEND_SECONDS);
    for (const [index, value] of this.#pinned) parameters[index] = value;
    this.#pose = { ...pose, parameters };
    return this.#pose;
  }

  #count(milliseconds) {
    const now = performance.now();
    this.#times = [...this.#times.filter((t) => now - t < 2000), now];
    const span = (now - this.#times[0]) / 1000;
    this.statistics = { milliseconds, framesPerSecond: span > 0.2 ? (this.#times.length - 1) / span : 0 };
  }

  #fail(sentence) {
    this._reject(new AvatarError(sentence));
    this.dispatchEvent(new CustomEvent("failed", { detail: sentence }));
  }

  #tell(kind) {
    this.dispatchEvent(new Event(kind));
  }
}

/** Pointer, wheel, touch and arrow keys turn and zoom a view. Returns a function that lets go. */
export function steer(view, element) {
  const held = new Map();
  const spread = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  const on = (type, handler, options) => {
    element.addEventListener(type, handler, options);
    return () => element.removeEventListener(type, handler, options);
  };
  const offs = [
    on("pointerdown", (e) => {
      element.setPointerCapture?.(e.pointerId);
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
    }),
    on("pointermove", (e) => {
      const before = held.get(e.pointerId);
      if (!before) return;
      const width = element.clientWidth || 1;
      if (held.size === 2) {
        const old = spread();
        held.set(e.pointerId, { x: e.clientX, y: e.clientY });
        view.look({ zoom: (view.view.zoom * spread()) / (old || 1) });
        return;
      }
      const [dx, dy] = [(e.clientX - before.x) / width, (e.clientY - before.y) / width];
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
      view.look({ yaw: view.view.yaw + 70 * dx, pitch: view.view.pitch + 50 * dy });
    }),
    ...["pointerup", "pointercancel", "lostpointercapture"].map((type) => on(type, (e) => held.delete(e.pointerId))),
    on("wheel", (e) => {
      e.preventDefault();
      view.look({ zoom: view.view.zoom * Math.exp(-0.0015 * e.deltaY) });
    }, { passive: false }),
    on("dblclick", () => view.look({ yaw: 0, pitch: 0, zoom: 1, shift: [0, 0] })),
    on("keydown", (e) => {
      const step = e.shiftKey ? 8 : 3, { yaw, pitch, zoom } = view.view;
      const moves = {
        ArrowLeft: { yaw: yaw - step }, ArrowRight: { yaw: yaw + step }, ArrowUp: { pitch: pitch - step },
        ArrowDown: { pitch: pitch + step }, "+": { zoom: zoom * 1.1 }, "=": { zoom: zoom * 1.1 }, "-": { zoom: zoom / 1.1 },
        Home: { yaw: 0, pitch: 0, zoom: 1, shift: [0, 0] },
      };
      if (!moves[e.key]) return;
      e.preventDefault();
      view.look(moves[e.key]);
    }),
  ];
  return () => offs.forEach((off) => off());
}
