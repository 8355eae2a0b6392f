// The page around a view: sliders, the recorded motion, pictures. Works from a file, without a network.
import { AvatarView, steer } from "./view.js";

const GROUPS = [
  ["Mouth", /mouth|lip|smile|tongue/i], ["Jaw", /jaw/i], ["Brows", /brow/i], ["Eyes", /eye|lid|blink|squint/i],
  ["Cheeks and nose", /cheek|nose|puff|sneer/i], ["Expression", /./],
];
const MOST_PIXELS = 640, LEAST_PIXELS = 160;
const FAST_ENOUGH = 24, TOO_SLOW = 16; // frames a second between which the picture's size is left alone
const find = (id) => document.getElementById(id);

async function start() {
  const decode = async (id) => (await fetchData(find(id).textContent)).buffer;
  const script = URL.createObjectURL(new Blob([JSON.parse(find("worker").textContent)], { type: "text/javascript" }));
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const options = { still, renderer: new URLSearchParams(location.search).get("renderer") ?? "auto" };
  const parts = { worker: new Worker(script), wasm: await decode("module"), file: await decode("data") };
  const view = new AvatarView(find("canvas"), parts, options);
  window.avatar = view; // for the curious, and for tests
  view.addEventListener("failed", ({ detail }) => (find("message").textContent = detail));
  const header = await view.ready;
  document.documentElement.style.setProperty("--stage", `rgb(${header.background.map((c) => 255 * c).join(" ")})`);
  steer(view, find("canvas"));
  const sliders = makeSliders(view, header);
  view.addEventListener("drawn", () => (find("message").textContent = ""), { once: true });
  connectBar(view, header, sliders);
  fitSize(view, header);
}

/** Bytes of base64 text. */
function fetchData(text) {
  const binary = atob(text.trim()), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; ++i) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

function makeSliders(view, header) {
  const all = [], form = find("controls");
  form.addEventListener("submit", (e) => e.preventDefault());
  const group = (title, isOpen) => {
    const box = document.createElement("details");
    box.open = isOpen;
    box.append(Object.assign(document.createElement("summary"), { textContent: title }));
    return box;
  };
  const slider = (box, name, low, high, rest, set) => {
    const row = Object.assign(document.createElement("label"), { className: "row" });
    const input = Object.assign(document.createElement("input"), {
      type: "range", min: low, max: high, step: (high - low) / 200, value: rest, name,
    });
    input.addEventListener("input", () => set(Number(input.value)));
    row.append(Object.assign(document.createElement("span"), { textContent: name, title: name }), input);
    box.append(row);
    all.push({ input, rest });
  };
  const boxes = new Map();
  const add = (title, ...rest) => {
    if (!boxes.has(title)) boxes.set(title, group(title, boxes.size < 1));
    slider(boxes.get(title), ...rest);
  };
  if (header.named) {
    header.expressions.forEach((name, i) => {
      const [low, high] = [header.range[0][i], header.range[1][i]];
      if (high - low < 1e-3) return;
      const title = GROUPS.find(([, pattern]) => pattern.test(name))[0];
      add(title, spoken(name), low, high, header.rest[i], (value) => view.setExpression({ [i]: value }));
    });
  } else {
    const weights = new Array(header.components.length).fill(0);
    header.components.forEach(({ values, deviation }, k) =>
      add("Expression", `Component ${k + 1}`, -2.5 * deviation, 2.5 * deviation, 0, (value) => {
        weights[k] = value;
        const sum = header.components.reduce((out, c, j) => out.map((v, i) => v + weights[j] * c.values[i]),
          header.rest.slice(0, header.sizes.expressions));
        view.setExpression(Object.fromEntries(sum.entries()));
      }));
  }
  const gaze = [0, 0], lids = [0, 0], head = [0, 0];
  if (header.moves.jaw) add("Jaw", "open", 0, 0.4, 0, (v) => view.setPose({ jaw: [v, 0, 0] }));
  if (header.moves.lids) {
    add("Eyes", "left lid", 0, 1, 0, (v) => view.setPose({ lids: ((lids[0] = v), lids) }));
    add("Eyes", "right lid", 0, 1, 0, (v) => view.setPose({ lids: ((lids[1] = v), lids) }));
  }
  if (header.moves.eyes) {
    add("Eyes", "look sideways", -0.4, 0.4, 0, (v) => view.setPose({ gaze: [gaze[0], (gaze[1] = v), 0] }));
    add("Eyes", "look up and down", -0.3, 0.3, 0, (v) => view.setPose({ gaze: [(gaze[0] = v), gaze[1], 0] }));
  }
  if (header.moves.neck) add("Head", "neck", -0.3, 0.3, 0, (v) => view.setPose({ neck: [0, v, 0] }));
  add("Head", "turn", header.yaw[0], header.yaw[1], 0, (v) => view.setPose({ head: [(head[0] = v), head[1]] }));
  add("Head", "nod", -12, 12, 0, (v) => view.setPose({ head: [head[0], (head[1] = v)] }));
  for (const box of boxes.values()) form.append(box);
  return all;
}

/** mouthSmile_L, mouth_smile_left, MouthSmileLeft -> mouth smile left */
function spoken(name) {
  return name.replace(/_L$/, " left").replace(/_R$/, " right").replace(/([a-z])([A-Z])/g, "$1 $2").replace(/_/g, " ").toLowerCase();
}

function connectBar(view, header, sliders) {
  const [play, scrub, time] = ["play", "scrub", "time"].map(find);
  const seconds = view.frameCount / header.fps;
  scrub.max = String(Math.max(seconds - 1 / header.fps, 0));
  const show = () => {
    play.textContent = view.isPlaying ? "Pause" : "Play";
    play.setAttribute("aria-pressed", String(view.isPlaying));
  };
  play.addEventListener("click", () => (view.isPlaying ? view.pause() : view.play("recorded")));
  scrub.addEventListener("input", () => view.seek(Number(scrub.value)));
  view.addEventListener("motion", show);
  view.addEventListener("drawn", () => {
    if (view.isPlaying) scrub.value = String(view.time);
    time.textContent = `${Math.floor(view.time / 60)}:${String(Math.floor(view.time % 60)).padStart(2, "0")}`;
    const { framesPerSecond, milliseconds } = view.statistics;
    const how = view.renderer === "webgl" ? "on the GPU" : "on the processor";
    find("speed").textContent = `${framesPerSecond.toFixed(0)} pictures a second, ${milliseconds.toFixed(0)} ms each, ${how}`;
  });
  find("reset").addEventListener("click", () => {
    view.release();
    for (const { input, rest } of sliders) input.value = rest;
    view.look({ yaw: 0, pitch: 0, zoom: 1, shift: [0, 0] });
    view.play(matchMedia("(prefers-reduced-motion: reduce)").matches ? "rest" : "idle");
  });
  find("shot").addEventListener("click", async () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(await view.screenshot());
    link.download = `${header.name}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  });
}

/** As many pixels as the machine draws fluently: fewer while it is too slow, more while there is time. */
function fitSize(view, header) {
  const most = Math.min(MOST_PIXELS, 2 * header.size);
  let size = Math.min(header.size, most), since = performance.now();
  view.resize(size);
  view.addEventListener("drawn", () => {
    const now = performance.now(), rate = 1000 / Math.max(view.statistics.milliseconds, 1);
    if (now - since < 1500) return;
    since = now;
    const next = rate < TOO_SLOW ? size * 0.8 : rate > 2 * FAST_ENOUGH ? size * 1.2 : size;
    const fitted = Math.round(Math.min(Math.max(next, LEAST_PIXELS), most) / 16) * 16;
    if (fitted !== size) view.resize((size = fitted));
  });
}

start().catch((error) => (find("message").textContent = error.message));
