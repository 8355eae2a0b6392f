// An avatar in memory and the WebAssembly module that draws it. Runs in a page, a worker and node; no DOM.

export const MAGIC = "AVW1";
// The arrays that the module takes, in its order (avatar/csrc/web/portrait.h).
const ARRAYS = [
  "shape", "expression_dirs", "pose_dirs", "weights", "eyelid_dirs", "joints_at_rest", "expression_joints", "barycentric",
  "of_code", "for_condition", "input_bias", "hidden_weights", "hidden_biases", "output_weights", "output_bias",
  "grid_weights", "head_matrix", "head_bias", "quats", "log_scales", "opacity_logits", "sh",
];
const SIZES = [
  "vertices", "expressions", "gaussians", "nodes", "latent", "width", "layers", "coefficients", "has_grid", "has_heads",
];
const TYPES = { f4: Float32Array, i2: Int16Array, i1: Int8Array, u4: Uint32Array, u2: Uint16Array };
const MAX_BYTES = 2 ** 29;

/** What is wrong with a file, for people. */
export class AvatarError extends Error {}

/** Unpack a gzip file's bytes. Throws AvatarError. */
export async function unpack(bytes) {
  try {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  } catch {
    throw new AvatarError("The avatar file is damaged or not one: it cannot be unpacked.");
  }
}

/** Header and arrays of an unpacked file; `arrays[name]` are typed arrays, not yet scaled. Throws AvatarError. */
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
  const start = 8 + length, arrays = {};
  for (const [name, entry] of Object.entries(header?.arrays ?? {})) {
    const type = TYPES[entry?.type];
    const { offset, length: count } = entry ?? {};
    const isWhole = [offset, count].every((n) => Number.isInteger(n) && n >= 0 && n < MAX_BYTES);
    if (!type || !isWhole || start + offset + count * type.BYTES_PER_ELEMENT > bytes.byteLength)
      throw new AvatarError(`The avatar file is damaged: ${printable(name)} lies outside of it.`);
    // Copied, so that it is aligned whatever the file's own offset is.
    const data = bytes.slice(start + offset, start + offset + count * type.BYTES_PER_ELEMENT);
    arrays[name] = new type(data.buffer);
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
  const s = header.sizes;
  need(s && SIZES.every((name) => Number.isInteger(s[name]) && s[name] >= 0), "its sizes are missing");
  const parameters = s.expressions + 26;
  need(finite(header.rest, parameters), "the neutral face is missing");
  need(Array.isArray(header.expressions) && header.expressions.length === s.expressions, "names are missing");
  need(header.range?.length === 2 && header.range.every((r) => finite(r, s.expressions)), "ranges are missing");
  need(finite(header.parents, 5) && finite(header.background, 3) && finite(header.yaw, 2), "its limits are missing");
  const c = header.camera;
  need(c && finite(c.rotation, 9) && finite(c.translation, 3), "the camera is missing");
  need(["fx", "fy", "cx", "cy", "aspect"].every((k) => Number.isFinite(c[k])) && c.aspect > 0, "the camera is missing");
  need(header.fps > 0 && header.fps <= 1000, "the frame rate is missing");
  for (const name of [...ARRAYS, "corners", "cells", "motion", "poses"]) need(arrays[name], `${name} is missing`);
  need(arrays.motion.length % parameters === 0, "the motion is cut short");
  need(arrays.poses.length / 12 === arrays.motion.length / parameters, "poses and motion differ in length");
}

/** An array's values as floats: integers times the scale of their column. */
export function scaled(values, entry) {
  if (!entry.scales) return values;
  const out = new Float32Array(values.length), scales = Float32Array.from(entry.scales), columns = scales.length;
  if (columns === 1) {
    for (let i = 0; i < out.length; ++i) out[i] = values[i] * scales[0];
  } else if (entry.by === "row") {
    const row = out.length / columns;
    for (let r = 0, i = 0; r < columns; ++r) for (const end = i + row; i < end; ++i) out[i] = values[i] * scales[r];
  } else {
    for (let i = 0; i < out.length; i += columns)
      for (let k = 0; k < columns; ++k) out[i + k] = values[i + k] * scales[k];
  }
  return out;
}

/** The module with one avatar in it. */
export class AvatarCore {
  /** @param wasm bytes of avatar.wasm  @param file an unpacked avatar file  Throws AvatarError. */
  static async load(wasm, file) {
    const { header, arrays } = parse(file);
    const imports = {
      env: { emscripten_notify_memory_growth() {} },
      wasi_snapshot_preview1: { proc_exit() { throw new AvatarError("The drawing module has stopped."); } },
    };
    const { instance } = await WebAssembly.instantiate(wasm, imports);
    instance.exports._initialize();
    return new AvatarCore(instance.exports, header, arrays);
  }

  constructor(module, header, arrays) {
    this.header = header;
    this.#module = module;
    const s = header.sizes;
    if (!guarded(() => module.avatar_create(...SIZES.map((name) => s[name]))))
      throw new AvatarError("The avatar file is damaged: its sizes are impossible.");
    ARRAYS.forEach((name, which) => {
      const values = scaled(arrays[name], header.arrays[name]);
      if (values.length !== module.avatar_length(which))
        throw new AvatarError(`The avatar file is damaged: ${name} has ${values.length} values.`);
      this.#floats(module.avatar_array(which), values.length).set(values);
    });
    const ints = (address, values) => new Int32Array(module.memory.buffer, address, values.length).set(values);
    if (arrays.corners.length !== 3 * s.gaussians || arrays.cells.length !== (s.has_grid ? 4 * s.gaussians : 0))
      throw new AvatarError("The avatar file is damaged: its Gaussians are not bound to the mesh.");
    ints(module.avatar_corners(), arrays.corners);
    ints(module.avatar_cells(), arrays.cells);
    ints(module.avatar_parents(), header.parents);
    if (!module.avatar_is_sound()) throw new AvatarError("The avatar file is damaged: an index lies outside.");
    this.motion = arrays.motion;
    this.poses = arrays.poses;
  }

  #module;

  #floats(address, length) {
    return new Float32Array(this.#module.memory.buffer, address, length);
  }

  /** Pose head and Gaussians: expression coefficients, jaw, eyes, eyelids, neck, as in `header.rest`. */
  pose(parameters) {
    this.#floats(this.#module.avatar_parameters(), parameters.length).set(parameters);
    guarded(() => this.#module.avatar_pose());
  }

  /** RGBA bytes of the posed avatar, a view that the next call overwrites. `camera`: rotation, translation, fx ... pixels. */
  draw(camera, width, height, background = this.header.background) {
    const m = this.#module;
    new Float64Array(m.memory.buffer, m.avatar_camera(), 18).set([
      ...camera.rotation, ...camera.translation, camera.fx, camera.fy, camera.cx, camera.cy, width, height,
    ]);
    this.#floats(m.avatar_background(), 3).set(background);
    const address = guarded(() => m.avatar_draw());
    if (!address) throw new AvatarError("This view cannot be drawn.");
    return new Uint8ClampedArray(m.memory.buffer, address, 4 * width * height);
  }

  /** Copies of the posed Gaussians, for a renderer on another device. */
  gaussians() {
    const m = this.#module, n = this.header.sizes.gaussians;
    return {
      means: this.#floats(m.avatar_means(), 3 * n).slice(),
      quats: this.#floats(m.avatar_quats(), 4 * n).slice(),
      scales: this.#floats(m.avatar_scales(), 3 * n).slice(),
      opacities: this.#floats(m.avatar_opacities(), n).slice(),
    };
  }

  /** Colour coefficients [n, coefficients, 3]; they never change. */
  sh() {
    const which = ARRAYS.indexOf("sh");
    return this.#floats(this.#module.avatar_array(which), this.#module.avatar_length(which)).slice();
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
