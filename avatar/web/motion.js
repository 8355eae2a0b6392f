// What moves an avatar: head poses from angles, an orbit of the camera, and a face that lives while nobody drives it.

/** Rotation vector (radians) -> matrix, row-major. */
export function rotation([x, y, z]) {
  const angle = Math.hypot(x, y, z);
  if (angle < 1e-9) return [1, 0, 0, 0, 1, 0, 0, 0, 1];
  const [a, b, c] = [x / angle, y / angle, z / angle], s = Math.sin(angle), k = 1 - Math.cos(angle);
  return [
    1 - k * (b * b + c * c), k * a * b - s * c, k * a * c + s * b,
    k * a * b + s * c, 1 - k * (a * a + c * c), k * b * c - s * a,
    k * a * c - s * b, k * b * c + s * a, 1 - k * (a * a + b * b),
  ];
}

/** Of a rotation's first two rows: `rotation` takes it back. */
export function rotationVector(six) {
  const m = whole(six), axis = [m[7] - m[5], m[2] - m[6], m[3] - m[1]], sine = Math.hypot(...axis) / 2;
  const angle = Math.atan2(sine, (m[0] + m[4] + m[8] - 1) / 2);
  return axis.map((value) => (sine < 1e-9 ? 0 : (value * angle) / (2 * sine)));
}

export function multiply(a, b) {
  const out = new Array(9).fill(0);
  for (let i = 0; i < 3; ++i)
    for (let j = 0; j < 3; ++j) for (let k = 0; k < 3; ++k) out[3 * i + j] += a[3 * i + k] * b[3 * k + j];
  return out;
}

/** The first two rows, flattened: how parameters hold a rotation. */
export const sixD = (m) => m.slice(0, 6);

/** A rotation of its first two rows. */
export function whole([a, b, c, d, e, f]) {
  return [a, b, c, d, e, f, b * f - c * e, c * d - a * f, a * e - b * d];
}

/** How a head turns by yaw and pitch in degrees, in its own axes. */
export const headTurn = ([yaw, pitch]) =>
  multiply(rotation([(pitch * Math.PI) / 180, 0, 0]), rotation([0, (yaw * Math.PI) / 180, 0]));

/**
 * The camera after turning the head before it: `yaw` and `pitch` in degrees, `zoom` a factor; `orbited` of
 * avatar/motion/orbit.py. `base` as in the avatar's header, `size` the width in pixels.
 */
export function orbit(base, { yaw = 0, pitch = 0, zoom = 1 }, size) {
  return {
    rotation: multiply(base.rotation, headTurn([yaw, pitch])),
    translation: base.translation,
    fx: base.fx * size * zoom,
    fy: base.fy * size * zoom,
    cx: (0.5 + (base.cx - 0.5) * zoom) * size,
    cy: (0.5 / base.aspect + (base.cy - 0.5 / base.aspect) * zoom) * size,
  };
}

/** A frame of the motion that the avatar came with: its parameters and its camera. */
export function recorded(core, index) {
  const count = core.header.sizes.expressions + 26;
  const pose = core.poses.subarray(12 * index, 12 * index + 12);
  return {
    parameters: core.motion.subarray(count * index, count * (index + 1)),
    rotation: Array.from(pose.subarray(0, 9)),
    head: core.header.camera.head && Array.from(pose.subarray(0, 9)),
    translation: Array.from(pose.subarray(9, 12)),
  };
}

/** Where things are in the parameters: expression, jaw 6, eyes 12, eyelids 2, neck 6. */
export function places(expressions) {
  return { jaw: expressions, eyes: expressions + 6, eyelids: expressions + 18, neck: expressions + 20 };
}

/**
 * A face at rest that lives: it blinks, looks about, and its head sways; a pure function of the time in seconds.
 * Returns parameters and the turn of the head [yaw, pitch] in degrees.
 */
export function idle(header, seconds, still = false) {
  const at = places(header.sizes.expressions), parameters = Float32Array.from(header.rest);
  if (still) return { parameters, turn: [0, 0] };
  // A blink every 3 to 5 seconds, 0.15 s down and 0.2 s up.
  const slot = Math.floor(seconds / 4), start = 4 * slot + noise(slot) * 1.6, into = seconds - start;
  const closed = into < 0 || into > 0.35 ? 0 : into < 0.15 ? into / 0.15 : 1 - (into - 0.15) / 0.2;
  parameters[at.eyelids] += (1 - parameters[at.eyelids]) * ease(closed);
  parameters[at.eyelids + 1] += (1 - parameters[at.eyelids + 1]) * ease(closed);
  // Eyes jump to a new place every second or two and stay there.
  const glance = Math.floor(seconds / 1.7), gaze = [0.05 * (noise(glance + 0.3) - 0.5), 0.1 * (noise(glance + 0.7) - 0.5)];
  const eye = sixD(rotation([gaze[0], gaze[1], 0]));
  parameters.set(eye, at.eyes);
  parameters.set(eye, at.eyes + 6);
  const turn = [3 * Math.sin(0.7 * seconds) + 1.5 * Math.sin(1.9 * seconds), 1.2 * Math.sin(0.9 * seconds + 1)];
  keepTorso(header, parameters, headTurn(turn));
  return { parameters, turn };
}

/** Where training has seen the torso turn against the head, let it stay when the head turns. */
export function keepTorso({ joints, rest, sizes }, parameters, turn) {
  const at = places(sizes.expressions).neck;
  if (joints.turn || joints.lean) parameters.set(sixD(multiply(whole(rest.slice(at, at + 6)), turn)), at);
}

const ease = (x) => x * x * (3 - 2 * x);
const noise = (n) => {
  const x = Math.sin(n * 127.1 + 11.7) * 43758.5453;
  return x - Math.floor(x);
};

/** Between two poses with cameras. What parameters hold of rotations stays one to first order; the module makes it exact. */
export function blended(from, to, share) {
  const mix = (name) => Float32Array.from(from[name], (value, i) => value + share * (to[name][i] - value));
  const [translation, rotation, turn] = ["translation", "rotation", "turn"].map((name) => Array.from(mix(name)));
  const head = to.head && orthonormal(Array.from(mix("head")));
  return { parameters: mix("parameters"), translation, rotation: orthonormal(rotation), head, turn };
}

/** The rotation whose first rows are nearest to a matrix's. */
function orthonormal(m) {
  const unit = (v) => v.map((x) => x / Math.hypot(...v)), a = unit(m.slice(0, 3));
  const along = a.reduce((sum, x, i) => sum + x * m[3 + i], 0), b = unit(m.slice(3, 6).map((x, i) => x - along * a[i]));
  return [...a, ...b, a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
