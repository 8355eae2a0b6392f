// What a caller has set on a face: it stays until it is released, whatever else moves the face.
import { AvatarError } from "./core.js";
import { places, rotation, rotationVector, sixD } from "./motion.js";

const COUNTS = { jaw: 3, gaze: 3, neck: 3, lids: 2, head: 2 }; // numbers of each part of a pose

export class Settings {
  #header;
  #expression = new Map(); // coefficient's index or control -> value; the last one wins
  #pinned = new Map(); // index of another parameter -> value
  #turns = new Map(); // first index of a rotation -> its vector
  turned = [0, 0]; // of the head: yaw and pitch in degrees

  constructor(header) {
    this.#header = header;
  }

  /** Coefficients by name or number, or controls as "Group: name"; null lets go. Returns the names that are unknown. */
  setExpression(values) {
    const { controls, expressions, sizes } = this.#header, unknown = [];
    const put = (key, value) => {
      this.#expression.delete(key);
      if (value !== null) this.#expression.set(key, value);
    };
    for (const [key, value] of Object.entries(values)) {
      const control = controls.find((c) => `${c.group}: ${c.name}` === key);
      const index = /^\d+$/.test(key) ? Number(key) : expressions.indexOf(key);
      if (value !== null && !Number.isFinite(value)) unknown.push(key);
      else if (control) put(control, value);
      else if (index >= 0 && index < sizes.expressions) put(index, value);
      else unknown.push(key);
    }
    return unknown;
  }

  /** What is null is let go of, also one of several numbers. Throws AvatarError for another number of them, and for others. */
  setPose(pose = {}) {
    const at = places(this.#header.sizes.expressions), { jaw, gaze, neck, lids, head } = pose;
    for (const [name, count] of Object.entries(COUNTS)) {
      const given = Array.from(pose[name] ?? Array(count).fill(null));
      if (given.length !== count || !given.every((value) => value === null || Number.isFinite(value)))
        throw new AvatarError(`${name} of a pose is ${count} numbers.`);
    }
    const pin = (start, values) => values.forEach((v, i) => (v === null ? this.#pinned.delete(start + i) : this.#pinned.set(start + i, v)));
    const turn = (start, vector) => {
      pin(start, Array(6).fill(null));
      if (vector) this.#turns.set(start, Array.from(vector));
      else this.#turns.delete(start);
    };
    if (jaw !== undefined) turn(at.jaw, jaw);
    if (neck !== undefined) turn(at.neck, neck);
    if (gaze !== undefined) [at.eyes, at.eyes + 6].forEach((start) => turn(start, gaze));
    if (lids !== undefined) pin(at.eyelids, lids ?? [null, null]);
    if (head !== undefined) this.turned = head ?? [0, 0];
  }

  /** Throws AvatarError for another number of parameters. */
  setParameters(values) {
    const count = this.#header.rest.length, E = this.#header.sizes.expressions;
    if (values && (values.length !== count || !Array.from(values).every(Number.isFinite)))
      throw new AvatarError(`This avatar takes ${count} parameters, all of them numbers.`);
    this.release();
    if (values) Array.from(values, (value, i) => (i < E ? this.#expression : this.#pinned).set(i, value));
  }

  release() {
    for (const set of [this.#expression, this.#pinned, this.#turns]) set.clear();
    this.turned = [0, 0];
  }

  /** Change parameters in place to what is set. */
  apply(parameters) {
    const { rest } = this.#header;
    const far = (values) => values.reduce((sum, value, i) => sum + value * (parameters[i] - rest[i]), 0);
    for (const [key, value] of this.#expression) {
      const { values } = key, more = values && value - far(values);
      if (values) values.forEach((share, i) => (parameters[i] += more * share));
      else parameters[key] = value;
    }
    for (const [start, vector] of this.#turns) {
      const own = vector.includes(null) ? rotationVector(parameters.subarray(start, start + 6)) : vector;
      parameters.set(sixD(rotation(vector.map((value, i) => value ?? own[i]))), start);
    }
    for (const [index, value] of this.#pinned) parameters[index] = value;
  }
}
