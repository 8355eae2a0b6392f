// A face in front of a camera as the avatar's: ARKit's blendshape scores and a head's pose become parameters and a camera.
import { keepTorso, multiply, places, rotation, sixD, whole } from "./motion.js";

const LIDS = ["eyeBlinkLeft", "eyeBlinkRight"];
const CALM_SHARE = 0.25;
const BEYOND = 10; // degrees by which the head may turn beyond what the training video shows
const INSIDE = 0.25; // the head's middle stays so far from the picture's edges, as a share of its width and height
const FAR = [0.7, 1.5]; // of the distance at rest
// Of the one-euro filter (Casiez, Roussel and Vogel, CHI 2012), Hz: at rest; more for each unit a second; of the speed.
const STILL = 2, QUICK = { scores: 8, pose: 8 }, SPEED = 1;

/** One-euro filter of arrays of numbers whose times are given in seconds. */
export class Smoother {
  #quick;
  #before;

  constructor(quick) {
    this.#quick = quick;
  }

  next(values, seconds) {
    const before = this.#before, passed = before ? seconds - before.seconds : 0;
    if (!(passed > 0 && passed < 1)) {
      this.#before = { values, seconds, speeds: values.map(() => 0) };
      return values;
    }
    const towards = (old, value, hertz) => old + (value - old) / (1 + 1 / (2 * Math.PI * hertz * passed));
    const speeds = values.map((v, i) => towards(before.speeds[i], (v - before.values[i]) / passed, SPEED));
    const smooth = values.map((v, i) => towards(before.values[i], v, STILL + this.#quick * Math.abs(speeds[i])));
    this.#before = { values: smooth, seconds, speeds };
    return smooth;
  }
}

/** A face as a mirror shows it: left is right. */
export function mirrored({ scores, matrix }) {
  const other = (name) => name.replace(/(Left|Right)$/, (side) => (side === "Left" ? "Right" : "Left"));
  return {
    scores: Object.fromEntries(Object.entries(scores).map(([name, score]) => [other(name), score])),
    matrix: matrix && Array.from(matrix, (value, i) => ((i % 4 === 0) !== (i < 4) ? -value : value)),
  };
}

/**
 * The calm face of several, some of which may speak or blink: the median of each score over the CALM_SHARE of them that does
 * least, and the pose of the one that is nearest to that.
 */
export function calmFace(faces) {
  const names = Object.keys(faces[0].scores), of = (face, name) => face.scores[name] ?? 0;
  const away = (face, from) => names.reduce((sum, name) => sum + (of(face, name) - (from[name] ?? 0)) ** 2, 0);
  const ranked = faces.map((face) => ({ face, does: away(face, {}) })).sort((a, b) => a.does - b.does);
  const calm = ranked.slice(0, Math.ceil(CALM_SHARE * faces.length)).map(({ face }) => face);
  const median = (name) => calm.map((face) => of(face, name)).sort((a, b) => a - b)[calm.length >> 1];
  const scores = Object.fromEntries(names.map((name) => [name, median(name)]));
  const nearest = calm.reduce((best, face) => (away(face, scores) < away(best, scores) ? face : best));
  return { scores, matrix: nearest.matrix };
}

/** Turns faces { scores, matrix } into poses of the avatar of a header; `matrix` may be null. */
export class FaceDriver {
  #header;
  #rows; // of header.drive.blendshapes: [name, [[place, weight], ...]]
  #neutral = { scores: {}, matrix: null };
  #newest = null;
  #scores;
  #pose;

  constructor(header) {
    this.#header = header;
    this.#rows = Object.entries(header.drive.blendshapes);
    this.#forget();
  }

  #forget() {
    this.#scores = new Smoother(QUICK.scores);
    this.#pose = new Smoother(QUICK.pose);
  }

  /** Measure from this face; by default from the newest. */
  calibrate(face = this.#newest) {
    if (face) this.#neutral = { scores: face.scores, matrix: face.matrix ?? null };
    this.#forget();
  }

  /** { parameters, rotation, translation, head } of the face at a time in seconds. */
  next(face, seconds) {
    this.#newest = face;
    const scores = this.#scores.next(this.#rows.map(([name]) => face.scores[name] ?? 0), seconds);
    const { rotation: R, translation: t } = this.#header.camera;
    if (!face.matrix) return { parameters: this.#parameters(scores), rotation: R, translation: t };
    this.#neutral.matrix ??= face.matrix; // the first place is the neutral one
    const head = this.#pose.next(headPose(R, this.#neutral.matrix, face.matrix), seconds);
    const parameters = this.#parameters(scores), { turn, ...camera } = placed(this.#header, head);
    keepTorso(this.#header, parameters, turn);
    return { parameters, ...camera };
  }

  /** `retargeted` of avatar/motion/transfer.py, no farther than training has shown. */
  #parameters(scores) {
    const { drive, rest, sizes } = this.#header, E = sizes.expressions, at = places(E);
    const moved = new Float64Array(drive.low.length);
    this.#rows.forEach(([name, weights], i) => {
      const calm = this.#neutral.scores[name] ?? 0;
      // Lids that the calm face leaves a little down still close.
      const by = LIDS.includes(name) ? Math.max(scores[i] - calm, 0) / Math.max(1 - calm, 0.2) : scores[i] - calm;
      for (const [place, weight] of weights) moved[place] += weight * by;
    });
    moved.forEach((value, i) => (moved[i] = clamp(value, [drive.low[i], drive.high[i]])));
    const turned = (start) => rotation(moved.subarray(start, start + 3));
    const parameters = Float32Array.from(rest);
    for (let i = 0; i < E; ++i) parameters[i] += moved[i];
    parameters.set(sixD(multiply(whole(rest.slice(at.jaw, at.jaw + 6)), turned(E))), at.jaw);
    for (const side of [0, 1]) {
      parameters.set(sixD(turned(E + 3 + 3 * side)), at.eyes + 6 * side);
      parameters[at.eyelids + side] = moved[E + 9 + side];
    }
    return parameters;
  }
}

/**
 * How a head has moved since it was at `neutral`: roll, pitch and yaw in radians about its own axes, the shift to the right and
 * down in metres, and its distance as a share of that at first, because the landmarker assumes a lens and so a distance, but
 * knows how large heads are. `R` is the avatar's head to its camera at rest; the matrices are 4x4, by columns, in OpenGL's axes
 * and centimetres, as the landmarker gives them.
 */
function headPose(R, neutral, matrix) {
  const turned = (a, b) => { // b after a^-1, in OpenCV's axes
    const [p, q] = [a, b].map((m) => [m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
    return multiply(q, transposed(p)).map((value, i) => ((i < 3) !== (i % 3 === 0) ? -value : value));
  };
  const T = multiply(transposed(R), multiply(turned(neutral, matrix), R)); // in the head's own axes
  const angles = [Math.atan2(-T[1], T[4]), Math.asin(clamp(T[7], [-1, 1])), Math.atan2(-T[6], T[8])];
  const shift = [matrix[12] - neutral[12], neutral[13] - matrix[13]].map((centimetres) => centimetres / 100);
  return [...angles, ...shift, matrix[14] / (neutral[14] || 1)];
}

/** The avatar's camera with its head turned, and that turn, no farther than training has shown, and moved, inside of the picture. */
function placed({ camera, orbit }, [roll, pitch, yaw, x, y, far]) {
  const degrees = Math.PI / 180, within = ([low, high]) => [(low - BEYOND) * degrees, (high + BEYOND) * degrees];
  const turn = multiply(
    rotation([0, 0, roll]),
    multiply(rotation([clamp(pitch, within(orbit.pitch)), 0, 0]), rotation([0, clamp(yaw, within(orbit.yaw)), 0])),
  );
  const [tx, ty, tz] = camera.translation, depth = tz * clamp(far, FAR);
  const inside = (t, shift, f, c, length) => {
    const place = (f * (t + shift)) / depth + c, own = (f * t) / tz + c;
    return ((clamp(place, [Math.min(INSIDE * length, own), Math.max((1 - INSIDE) * length, own)]) - c) * depth) / f;
  };
  const { fx, fy, cx, cy, aspect } = camera;
  return {
    turn,
    rotation: multiply(camera.rotation, turn),
    head: camera.head && multiply(camera.head, turn), // of an avatar of several cameras, for its network
    translation: [inside(tx, x, fx, cx, 1), inside(ty, y, fy, cy, 1 / aspect), depth],
  };
}

const clamp = (value, [low, high]) => Math.min(Math.max(value, low), high);
const transposed = (m) => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
