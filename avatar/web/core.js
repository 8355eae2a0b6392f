// An avatar in memory and the WebAssembly module that draws it. Runs in a page, a worker and node; no DOM.

export const MAGIC = "AVW4";
// The arrays that the module takes, in its order (avatar/csrc/web/web_avatar.h).
const ARRAYS = [
  "shape", "expression_dirs", "pose_dirs", "weights", "eyelid_dirs", "joints_at_rest", "expression_joints", "barycentric",
  "of_code", "for_condition", "input_bias", "hidden_weights", "hidden_biases", "output_weights", "output_bias",
  "grid_weights", "head_matrix", "head_bias", "quats", "log_scales", "opacity_logits", "sh",
  "skull_share",
];
const SIZES = [
  "vertices", "expressions", "gaussians", "nodes", "latent", "width", "layers", "coefficients", "has_grid", "has_heads",
  "has_skull_binding", "has_head_rotation",
];
const TYPES = { f4: Float32Array, i2: Int16Array, i1: Int8Array, u4: Uint32Array, u2: Uint16Array };
const MAX_BYTES = 2 ** 28; // of an unpacked file
export const PACKED = 13; // values of a packed Gaussian: mean 3, opacity, colour 3, covariance 6

/** What is wrong with a file, for people. */
export class AvatarError extends Error {}

/** Unpack a gzip file's bytes. Throws AvatarError. */
export async function unpack(bytes) {
  const parts = [];
  let size = 0;
  try {
    const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")).getReader();
    for (let part = await reader.read(); !part.done && size <= MAX_BYTES; part = await reader.read()) {
      parts.push(part.value);
      size += part.value.length;
    }
  } catch {
    throw new AvatarError("The avatar file is damaged or not one: it cannot be unpacked.");
  }
  if (size > MAX_BYTES) throw new AvatarError("The avatar file is too large for this viewer.");
  const whole = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

/** Header and arrays of an unpacked file: a Map from names to typed arrays, not yet scaled. Throws AvatarError. */
export function parse(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const magic = new TextDecoder().decode(bytes.subarray(0, 4));
  if (magic !== MAGIC) throw new AvatarError(`This is not an avatar of this viewer (it begins with “${printable(magic)}”).`);
  const length = bytes.byteLength >= 8 ? view.getUint32(4, true) : 0;
  if (length === 0 || 8 + length > bytes.byteLength) throw new AvatarError("The avatar file is cut short.");
  let header;
  try {
    header = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(bytes.subarray(8, 8 + length)));
  } catch {
    throw new AvatarError("The avatar file is damaged: its header cannot be read.");
  }
  const start = 8 + length, arrays = new Map();
  for (const [name, entry] of Object.entries(header?.arrays ?? {})) {
    const type = TYPES[entry?.type];
    const { offset, length: count } = entry ?? {};
    const isWhole = [offset, count].every((n) => Number.isInteger(n) && n >= 0 && n < MAX_BYTES);
    if (!type || !isWhole || start + offset + count * type.BYTES_PER_ELEMENT > bytes.byteLength)
      throw new AvatarError(`The avatar file is damaged: ${printable(name)} lies outside of it.`);
    // Copied, so that it is aligned whatever the file's own offset is.
    const data = bytes.slice(start + offset, start + offset + count * type.BYTES_PER_ELEMENT);
    arrays.set(name, new type(data.buffer));
  }
  check(header, arrays);
  return { header, arrays };
}

function check(header, arrays) {
  const need = (condition, what) => {
    if (!condition) throw new AvatarError(`The avatar file is damaged: ${what}.`);
  };
  const finite = (values, count) =>
    Array.isArray(values) && values.length === count && values.every((v) => Number.isFinite(v));
  const texts = (values) => Array.isArray(values) && values.every((v) => typeof v === "string");
  const s = header.sizes;
  need(s && SIZES.every((name) => Number.isInteger(s[name]) && s[name] >= 0), "its sizes are missing");
  const E = s.expressions, parameters = E + 26;
  need(typeof header.name === "string" && typeof header.licence === "string", "its name is missing");
  need(finite(header.rest, parameters), "the neutral face is missing");
  need(texts(header.expressions) && header.expressions.length === E, "names are missing");
  need(finite(header.parents, 5) && finite(header.background, 3), "its joints are missing");
  need(finite(header.orbit?.yaw, 2) && finite(header.orbit?.pitch, 2), "its limits are missing");
  const isJoints = header.joints && typeof header.joints === "object" && !Array.isArray(header.joints);
  need(isJoints && Object.values(header.joints).every((range) => finite(range, 2)), "its limits are missing");
  const isControl = (c) => texts([c?.group, c?.name]) && finite(c?.values, E) && finite(c?.range, 2);
  need(Array.isArray(header.controls) && header.controls.every(isControl), "its controls are missing");
  const d = header.drive, P = E + 11, isPlaced = (pair) => finite(pair, 2) && Number.isInteger(pair[0]) && pair[0] >= 0 && pair[0] < P;
  const shapes = d?.blendshapes && typeof d.blendshapes === "object" ? Object.values(d.blendshapes) : [null];
  need(shapes.every((pairs) => Array.isArray(pairs) && pairs.every(isPlaced)), "what a camera moves is missing");
  need(finite(d.low, P) && finite(d.high, P), "its limits are missing");
  const c = header.camera;
  need(c && finite(c.rotation, 9) && finite(c.translation, 3), "the camera is missing");
  need(finite(["fx", "fy", "cx", "cy", "aspect"].map((k) => c[k]), 5) && c.aspect > 0.1 && c.aspect < 10, "the camera is missing");
  need(header.blur >= 0 && header.blur <= 100, "its blur is missing");
  const f = header.head_rotation;
  need(s.has_head_rotation ? finite(f?.turning, 27) && f.limit > 0 && f.limit <= 100 : f === null, "how its head is turned is missing");
  need(header.fps > 0 && header.fps <= 1000, "the frame rate is missing");
  need(header.size >= 1 && header.size <= 2 ** 16, "the size is missing");
  for (const name of [...ARRAYS, "corners", "cells", "motion", "poses"]) need(arrays.has(name), `${name} is missing`);
  for (const [name, values] of arrays)
    need(!(values instanceof Float32Array) || values.every(Number.isFinite), `${name} holds values that are not finite`);
  for (const name of ["motion", "poses"]) need(arrays.get(name) instanceof Float32Array, `${name} is not of numbers`);
  need(arrays.get("motion").length % parameters === 0, "the motion is cut short");
  need(arrays.get("poses").length / 12 === arrays.get("motion").length / parameters, "poses and motion differ in length");
}

/** An array's values as floats: integers times the scale of their column. Throws AvatarError. */
function scaled(values, { scales, by }, name) {
  if (scales === undefined) return values;
  const isWhole = Array.isArray(scales) && scales.length > 0 && values.length % scales.length === 0;
  if (!isWhole || !scales.every(Number.isFinite)) throw new AvatarError(`The avatar file is damaged: ${name} has wrong scales.`);
  const out = new Float32Array(values.length), factors = Float32Array.from(scales), columns = factors.length;
  if (columns === 1) {
    for (let i = 0; i < out.length; ++i) out[i] = values[i] * factors[0];
  } else if (by === "row") {
    const row = out.length / columns;
    for (let r = 0, i = 0; r < columns; ++r) for (const end = i + row; i < end; ++i) out[i] = values[i] * factors[r];
  } else {
    for (let i = 0; i < out.length; i += columns)
      for (let k = 0; k < columns; ++k) out[i + k] = values[i + k] * factors[k];
  }
  return out;
}

/** The head's rotation before a camera, as the network's input: avatar/gaussians/head_rotation.py. */
function headRotationInput(learned, rotation) {
  if (learned === null) return [0, 0, 0];
  const turn = (axis) => rotation.reduce((sum, value, k) => sum + learned.turning[9 * axis + k] * value, 0);
  return [0, 1, 2].map((axis) => Math.min(Math.max(turn(axis), -learned.limit), learned.limit));
}

/** The module with one avatar in it. */
export class AvatarCore {
  /** @param wasm bytes of avatar.wasm, or the compiled module  @param file an unpacked avatar file  Throws AvatarError. */
  static async load(wasm, file) {
    const { header, arrays } = parse(file);
    const imports = {
      env: { emscripten_notify_memory_growth() {} },
      wasi_snapshot_preview1: { proc_exit() { throw new AvatarError("The drawing module has stopped."); } },
    };
    const module = wasm instanceof WebAssembly.Module ? wasm : await compile(wasm);
    const { exports } = await WebAssembly.instantiate(module, imports);
    exports._initialize();
    return new AvatarCore(exports, header, arrays);
  }

  constructor(module, header, arrays) {
    this.header = header;
    this.#module = module;
    const s = header.sizes;
    if (!module.avatar_measure(...SIZES.map((name) => s[name])))
      throw new AvatarError("The avatar file is damaged: its sizes are impossible.");
    // Before memory is taken: no file can ask for more than a few times its own size.
    const need = (name, count) => {
      const found = arrays.get(name).length;
      if (found !== count) throw new AvatarError(`The avatar file is damaged: ${name} has ${found} values, not ${count}.`);
    };
    ARRAYS.forEach((name, which) => need(name, module.avatar_length(which)));
    need("corners", 3 * s.gaussians);
    need("cells", s.has_grid ? 4 * s.gaussians : 0);
    guarded(() => module.avatar_create());
    ARRAYS.forEach((name, which) => {
      const values = scaled(arrays.get(name), header.arrays[name], name);
      this.#floats(module.avatar_array(which), values.length).set(values);
    });
    const ints = (address, values) => new Int32Array(module.memory.buffer, address, values.length).set(values);
    ints(module.avatar_corners(), arrays.get("corners"));
    ints(module.avatar_cells(), arrays.get("cells"));
    ints(module.avatar_parents(), header.parents);
    module.avatar_set_blur(header.blur);
    if (!module.avatar_is_sound()) throw new AvatarError("The avatar file is damaged: an index lies outside.");
    this.motion = arrays.get("motion");
    this.poses = arrays.get("poses");
  }

  #module;

  #floats(address, length) {
    return new Float32Array(this.#module.memory.buffer, address, length);
  }

  /**
   * Pose head and Gaussians: expression coefficients, jaw, eyes, eyelids, neck, as in `header.rest`; `rotation` of the camera
   * that is to see them, row-major.
   */
  pose(parameters, rotation) {
    this.#floats(this.#module.avatar_parameters(), parameters.length).set(parameters);
    this.#floats(this.#module.avatar_head_rotation(), 3).set(headRotationInput(this.header.head_rotation, rotation));
    guarded(() => this.#module.avatar_pose());
  }

  /** RGBA bytes of the posed avatar, a view that the next call overwrites. `camera`: rotation, translation, fx ... pixels. */
  draw(camera, width, height, background = this.header.background) {
    const m = this.#module;
    this.#look(camera, width, height);
    this.#floats(m.avatar_background(), 3).set(background);
    const address = guarded(() => m.avatar_draw());
    if (!address) throw new AvatarError("This view cannot be drawn.");
    return new Uint8ClampedArray(m.memory.buffer, address, 4 * width * height);
  }

  /**
   * The posed Gaussians for a renderer on another device, farthest first, a view that the next call overwrites: mean 3,
   * opacity, colour 3, covariance 6 of each.
   */
  pack(camera, width, height) {
    this.#look(camera, width, height);
    return this.#floats(guarded(() => this.#module.avatar_pack()), PACKED * this.header.sizes.gaussians);
  }

  #look(camera, width, height) {
    const m = this.#module;
    new Float64Array(m.memory.buffer, m.avatar_camera(), 18).set([
      ...camera.rotation, ...camera.translation, camera.fx, camera.fy, camera.cx, camera.cy, width, height,
    ]);
  }
}

async function compile(wasm) {
  try {
    return await WebAssembly.compile(wasm);
  } catch {
    throw new AvatarError("This browser is too old to draw an avatar: it lacks WebAssembly with SIMD.");
  }
}

function guarded(call) {
  try {
    return call();
  } catch (error) {
    if (error instanceof AvatarError) throw error;
    throw new AvatarError("The drawing module has stopped: there is not enough memory, or the avatar is damaged.");
  }
}

function printable(text) {
  return String(text).replace(/[^\x20-\x7e]/g, "?").slice(0, 40);
}
