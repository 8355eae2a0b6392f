// What a caller has set on a face: it stays until it is released, whatever else moves the face.
import { AvatarError } from "./core.js";
import { places, rotation, sixD } from "./motion.js";

export class Settings {
  #header;
  #pinned = new Map(); // parameter index -> value
  #controls = new Map(); // control -> value
  turned = [0, 0]; // of the head: yaw and pitch in degrees

  constructor(header) {
    this.#header = header;
  }

  /** Coefficients by name or number, or controls as "Group: name"; null lets go. Returns the names that are unknown. */
  setExpression(values) {
    const { controls, expressions, sizes } = this.#header, unknown = [];
    const put = (map, key, value) => (value === null ? map.delete(key) : map.set(key, value));
    for (const [key, value] of Object.entries(values)) {
      const control = controls.find((c) => `${c.group}: ${c.name}` === key);
      const index = /^\d+$/.test(key) ? Number(key) : expressions.indexOf(key);
      if (value !== null && !Number.isFinite(value)) unknown.push(key);
      else if (control) put(this.#controls, control, value);
      else if (index >= 0 && index < sizes.expressions) put(this.#pinned, index, value);
      else unknown.push(key);
    }
    return unknown;
  }

  /** What is null is let go of. */
  setPose({ jaw, gaze, neck, lids, head } = {}) {
    const at = places(this.#header.sizes.expressions);
    const pin = (start, values) => values.forEach((v, i) => (v === null ? this.#pinned.delete(start + i) : this.#pinned.set(start + i, v)));
    const turn = (start, vector) => pin(start, vector ? sixD(rotation(vector)) : Array(6).fill(null));
    if (jaw !== undefined) turn(at.jaw, jaw);
    if (neck !== undefined) turn(at.neck, neck);
    if (gaze !== undefined) [at.eyes, at.eyes + 6].forEach((start) => turn(start, gaze));
    if (lids !== undefined) pin(at.eyelids, lids ?? [null, null]);
    if (head !== undefined) this.turned = head ?? [0, 0];
  }

  /** Throws AvatarError for another number of parameters. */
  setParameters(values) {
    const count = this.#header.rest.length;
    if (values && (values.length !== count || !Array.from(values).every(Number.isFinite)))
      throw new AvatarError(`This avatar takes ${count} parameters, all of them numbers.`);
    this.release();
    if (values) values.forEach((value, i) => this.#pinned.set(i, value));
  }

  release() {
    this.#pinned.clear();
    this.#controls.clear();
    this.turned = [0, 0];
  }

  /** Change parameters in place to what is set. */
  apply(parameters) {
    const { rest, sizes } = this.#header;
    if (this.#controls.size > 0) {
      parameters.set(rest.slice(0, sizes.expressions));
      for (const [{ values }, share] of this.#controls) values.forEach((value, i) => (parameters[i] += share * value));
    }
    for (const [index, value] of this.#pinned) parameters[index] = value;
  }
}
