// The sliders of the page: the avatar's own controls, its joints and the camera, each as far as training has shown it. The
// first few move both sides of the face at once; presets move several.
import { places } from "./motion.js";

const JOINTS = [ // name in the header, group, label
  ["jaw", "Jaw", "open"], ["left_lid", "Eyes", "left lid"], ["right_lid", "Eyes", "right lid"],
  ["look_left", "Eyes", "look to its left"], ["look_down", "Eyes", "look down"],
  ["turn", "Torso", "turn right"], ["lean", "Torso", "lean back"],
];
const GROUPS = ["Mouth", "Jaw", "Eyes", "Brows"]; // in this order, then the others
const FIRST = { // label -> sliders that one of the first moves
  Smile: /: (mouth )?smile/, "Open mouth": /^Jaw: open$/, Pucker: /: (mouth )?pucker/, "Raise brows": /^Brows: (brow )?(inner |outer )?up/,
  "Close eyes": /: (left|right) lid$/, "Look to its left": /: look to its left$/, "Look down": /: look down$/,
};
const wave = (t, hertz, phase = 0) => 0.5 + 0.5 * Math.sin(2 * Math.PI * hertz * t + phase);
const PRESETS = { // name -> sliders and shares of their range, which may depend on the seconds
  Smile: [[FIRST.Smile, 0.95], [/cheek up/, 0.7]],
  Surprise: [[FIRST["Open mouth"], 0.75], [FIRST["Raise brows"], 0.95]],
  Wink: [[/: left lid$/, 1], [/: (mouth )?smile( left)?$/, 0.7], [/cheek up left/, 0.8]],
  Talk: [[FIRST["Open mouth"], (t) => 0.75 * wave(t, 2.6) * wave(t, 0.9, 2)], [/funnel/, (t) => 0.5 * wave(t, 1.7, 4)], [FIRST.Pucker, (t) => 0.35 * wave(t, 1.1, 1) * wave(t, 0.7)]],
};
const PAUSE = 80; // milliseconds after which sliders follow a motion: they cost time that the picture could have
const EASE = 0.25; // seconds that a preset takes to come and to go
const NOTABLE = 0.2; // of a slider's range above its rest: with less, training has not shown what the name says

/** Fill the page with sliders and presets. `putBack` puts them all back; `isGazeHeld` tells whether a slider has set the eyes. */
export function makeControls(view, header, { presets, first, more }) {
  const sliders = [...faceSliders(view, header), ...cameraSliders(view)], followers = new Map([[first, []], [more, []]]);
  const stop = makePresets(view, sliders, presets);
  const add = (list, box, label, members) => {
    const made = row(view, label, members, () => stop(members));
    followers.get(list).push(made.follow);
    box.append(made.label);
  };
  for (const [label, pattern] of Object.entries(FIRST)) {
    const members = matching(sliders, pattern);
    if (members.length > 0) add(first, first, label, members);
  }
  const names = new Set([...GROUPS, ...sliders.map(({ group }) => group)]);
  for (const group of names) {
    const members = sliders.filter((slider) => slider.group === group);
    if (members.length === 0) continue;
    const box = document.createElement("fieldset");
    box.append(Object.assign(document.createElement("legend"), { textContent: group }));
    for (const slider of members) add(more, box, slider.name, [slider]);
    more.append(box);
  }
  const details = more.closest("details");
  const follow = () => [first, ...(details.open ? [more] : [])].forEach((list) => followers.get(list).forEach((one) => one()));
  let due;
  for (const type of ["drawn", "view"]) view.addEventListener(type, () => (due ??= setTimeout(() => follow((due = undefined)), PAUSE)));
  details.addEventListener("toggle", follow);
  const held = sliders.find((slider) => slider.held)?.held ?? new Map();
  const putBack = () => {
    stop();
    held.clear();
    view.release();
  };
  return { putBack, isGazeHeld: () => held.has("look_left") || held.has("look_down") };
}

const rises = ({ range: [low, high], rest }) => high - rest > NOTABLE * (high - low);

/** Sliders of a pattern: of all sides of the face, or the first where the names tell no sides. */
function matching(sliders, pattern) {
  const found = sliders.filter(({ group, name }) => pattern.test(`${group}: ${name}`));
  const sided = found.filter(({ name }) => /\b(left|right)\b/.test(name));
  return sided.length > 0 ? sided : found.slice(0, 1);
}

/** { group, name, range, rest, set, read, held }: `read` gives the value that a view's parameters have. */
function faceSliders(view, header) {
  const at = places(header.sizes.expressions), held = new Map(), rest = Float32Array.from(header.rest);
  const about = (start) => ({ x: (p) => Math.atan2(-p[start + 5], p[start + 4]), y: (p) => Math.atan2(p[start + 2], p[start]) });
  const [jaw, eyes, neck] = [at.jaw, at.eyes, at.neck].map(about);
  const reads = {
    jaw: jaw.x, left_lid: (p) => p[at.eyelids], right_lid: (p) => p[at.eyelids + 1],
    look_left: eyes.y, look_down: eyes.x, turn: neck.y, lean: neck.x,
  };
  const pose = (name, value) => {
    if (value === null) held.delete(name);
    else held.set(name, value);
    const of = (...names) => (names.some((n) => held.has(n)) ? names.map((n) => held.get(n) ?? null) : null);
    if (name === "jaw") view.setPose({ jaw: value === null ? null : [value, 0, 0] });
    else if (name.endsWith("lid")) view.setPose({ lids: of("left_lid", "right_lid") });
    else if (name.startsWith("look")) view.setPose({ gaze: of("look_down", "look_left")?.concat(0) ?? null });
    else view.setPose({ neck: of("lean", "turn")?.concat(0) ?? null });
  };
  const made = header.controls.filter(({ range: [low, high] }) => high > low).map(({ group, name, range, values }) => ({
    group, name, range, rest: 0,
    set: (value) => view.setExpression({ [`${group}: ${name}`]: value }),
    read: (p) => values.reduce((sum, share, i) => (share === 0 ? sum : sum + share * (p[i] - rest[i])), 0),
  }));
  for (const [joint, group, name] of JOINTS) {
    const range = header.joints[joint], read = reads[joint];
    if (range) made.push({ group, name, range, rest: read(rest), set: (value) => pose(joint, value), read, held });
  }
  return made;
}

function cameraSliders(view) {
  return [["around", "yaw"], ["above", "pitch"]].map(([name, axis]) => ({
    group: "Camera", name, range: view.limits[axis], rest: 0,
    set: (value) => view.look({ [axis]: value ?? 0 }), read: () => view.view[axis],
  }));
}

/** A slider that moves one or several, with a mark at the neutral face, to which a double click returns. `begin` is called
 * before it moves them. */
function row(view, text, members, begin) {
  const low = Math.min(...members.map(({ range }) => range[0])), high = Math.max(...members.map(({ range }) => range[1]));
  const { group, rest } = members[0], name = members.length > 1 || FIRST[text] ? text : `${group}: ${text}`;
  const label = Object.assign(document.createElement("label"), { className: "row" });
  const input = Object.assign(document.createElement("input"), { type: "range", min: low, max: high, step: "any", value: rest, name });
  const share = (value) => Math.min(Math.max((value - low) / (high - low), 0), 1);
  const fill = () => input.style.setProperty("--at", share(input.value));
  input.style.setProperty("--rest", share(rest));
  input.setAttribute("aria-label", name);
  const set = () => {
    begin();
    for (const { set, range } of members) set(Math.min(Math.max(Number(input.value), range[0]), range[1]));
    fill();
  };
  input.addEventListener("input", set);
  input.addEventListener("dblclick", () => {
    input.value = rest;
    begin();
    for (const { set } of members) set(null);
    fill();
  });
  label.append(Object.assign(document.createElement("span"), { textContent: text }), input);
  fill();
  const follow = () => {
    const isMine = document.activeElement === input && !view.isPlaying;
    if (isMine || !view.parameters) return;
    const value = members.reduce((sum, { read }) => sum + read(view.parameters), 0) / members.length;
    if (Math.abs(value - input.value) < 0.004 * (high - low) && value !== rest) return;
    input.value = value;
    fill();
  };
  return { label, follow };
}

/** Buttons that move several sliders until they are pressed again. Returns a function that stops one, of certain sliders only
 * where it is given those. */
function makePresets(view, sliders, box) {
  let running = null; // { button, moves, since, left }
  const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const stop = (members) => {
    if (members && !running?.moves.some(({ slider }) => members.includes(slider))) return;
    running?.button.setAttribute("aria-pressed", "false");
    for (const { slider } of running?.moves ?? []) slider.set(null);
    running = null;
  };
  const step = (now) => {
    if (!running) return;
    const { moves, since, left } = running, seconds = (now - since) / 1000;
    const come = isCalm ? 1 : Math.min(Math.max(seconds, 0) / EASE, 1), gone = left === undefined ? 0 : isCalm ? 1 : (now - left) / 1000 / EASE;
    if (gone >= 1) return stop();
    for (const { slider, share } of moves) {
      const most = slider.range[1] - slider.rest;
      slider.set(slider.rest + come * (1 - gone) * (typeof share === "function" ? share(seconds) : share) * most);
    }
    requestAnimationFrame(step);
  };
  const able = sliders.filter(rises);
  for (const [name, parts] of Object.entries(PRESETS)) {
    if (matching(able, parts[0][0]).length === 0) continue; // what it is about
    const moves = parts.flatMap(([pattern, share]) => matching(able, pattern).map((slider) => ({ slider, share })));
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: name });
    button.setAttribute("aria-pressed", "false");
    button.addEventListener("click", () => {
      if (running?.button === button) return (running.left ??= performance.now());
      stop();
      if (view.motion === "recorded") view.play(isCalm ? "rest" : "idle");
      running = { button, moves, since: performance.now() };
      button.setAttribute("aria-pressed", "true");
      requestAnimationFrame(step);
    });
    box.append(button);
  }
  box.hidden = box.children.length === 0;
  return stop;
}
