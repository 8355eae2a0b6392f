// The page around a view: sliders, the recorded motion, pictures. Works from a file, without a network. The address may ask for
// ?noui (the picture alone), ?autoplay, ?background=%23rrggbb, ?renderer=wasm or webgl, and ?width= in pixels.
import { makeControls } from "./controls.js";
import { connectCamera } from "./camera_panel.js";
import { connectPageDisplay } from "./page_display.js";
import { orbitControls } from "./orbit_controls.js";
import { AvatarView } from "./view.js";

const MOST_PIXELS = 640, LEAST_PIXELS = 160; // of a picture that moves
const SHARPEST = 2048; // pixels of one that does not
const SAVED = 1024; // pixels of the shorter side of a picture that is saved, or more
const TOO_SLOW = 45, FAST = 20; // milliseconds of a picture between which its size is left alone
const find = (id) => document.getElementById(id);
const wantsStillness = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

async function start() {
  const asked = new URLSearchParams(location.search), options = { still: wantsStillness(), renderer: asked.get("renderer") ?? "auto" };
  document.body.classList.toggle("noui", asked.has("noui"));
  const parts = { worker: makeWorker("worker"), wasm: decoded("module"), file: decoded("data") };
  const view = new AvatarView(find("canvas"), parts, options);
  window.avatar = view; // for the curious, and for tests
  let isWaiting = true; // for a picture, with a sentence that tells so
  view.addEventListener("failed", ({ detail }) => {
    isWaiting = true;
    say(detail);
  });
  const header = await view.ready;
  orbitControls(view, find("canvas"));
  const [presets, first, more] = ["presets", "first", "more"].map(find);
  const { putBack, isGazeHeld } = makeControls(view, header, { presets, first, more });
  const putStageBack = connectPageDisplay(view, header, isGazeHeld, () => find("play").click());
  view.addEventListener("drawn", () => {
    if (isWaiting) say("");
    isWaiting = false;
  });
  view.addEventListener("view", () => (find("guess").hidden = view.isSupported));
  connectBar(view, header, putBack, putStageBack);
  if (asked.has("autoplay") && !options.still) view.play("recorded");
  if ("webcam" in document.body.dataset) connectCamera(view, () => makeWorker("watcher"), putBack);
  const width = Number(asked.get("width"));
  if (width > 0) view.resize(width);
  else fitSize(view, header);
}

/** A worker of the script that an element holds. */
function makeWorker(id) {
  const script = new Blob([JSON.parse(find(id).textContent)], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(script));
}

/** Bytes of an element's base64 text, which is let go of. */
function decoded(id) {
  const element = find(id), text = atob(element.textContent.trim()), bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; ++i) bytes[i] = text.charCodeAt(i);
  element.remove();
  return bytes.buffer;
}

function say(sentence) {
  Object.assign(find("message"), { textContent: sentence, hidden: sentence === "" });
}

const clock = (seconds) => `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;

function connectBar(view, header, putBack, putStageBack) {
  const [play, scrub, time] = ["play", "scrub", "time"].map(find);
  const seconds = view.frameCount / header.fps;
  scrub.max = String(Math.max(seconds - 1 / header.fps, 0));
  scrub.disabled = play.disabled = view.frameCount === 0;
  play.addEventListener("click", () => {
    if (view.isPlaying) return view.pause();
    putBack();
    view.play("recorded");
  });
  scrub.addEventListener("input", () => view.seek(Number(scrub.value)));
  view.addEventListener("motion", () => (play.textContent = view.isPlaying ? "Pause" : "Play"));
  view.addEventListener("drawn", () => {
    if (view.isPlaying || document.activeElement !== scrub) scrub.value = String(view.time);
    scrub.style.setProperty("--at", scrub.value / (Number(scrub.max) || 1));
    time.textContent = `${clock(view.time)} / ${clock(seconds)}`;
    scrub.setAttribute("aria-valuetext", `${view.time.toFixed(1)} seconds of ${seconds.toFixed(1)}`);
    const { milliseconds } = view.statistics, where = view.renderer === "webgl" ? "GPU" : "processor";
    find("speed").textContent = `${view.canvas.width} × ${view.canvas.height} pixels, ${milliseconds.toFixed(0)} ms a picture, ${where}`;
  });
  find("reset").addEventListener("click", () => {
    putBack();
    putStageBack();
    view.look({ yaw: 0, pitch: 0, zoom: 1 });
    scrub.value = "0";
    view.play(wantsStillness() ? "rest" : "idle");
  });
  find("shot").addEventListener("click", async () => {
    const link = document.createElement("a"), least = SAVED * Math.max(1, header.camera.aspect);
    try {
      link.href = URL.createObjectURL(await view.screenshot(Math.max(least, shownWidth(header))));
    } catch (error) {
      return say(error.message);
    }
    link.download = `${header.name}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  });
}

/** How many of the screen's own pixels the picture is wide. */
function shownWidth(header) {
  const { clientWidth: width, clientHeight: height } = find("canvas"), { aspect } = header.camera;
  // A height that nothing limits follows the picture's own, which is rounded: the width must not follow it in turn.
  const isLimited = height < width / aspect - 2;
  return (isLimited ? height * aspect : width) * devicePixelRatio;
}

/**
 * As many pixels as the machine draws fluently: fewer while it is too slow, more while there is time. A picture that is still
 * gets those of the screen.
 */
function fitSize(view, header) {
  const fit = () => view.resize(size, Math.min(shownWidth(header), SHARPEST, SHARPEST * header.camera.aspect));
  const most = Math.min(MOST_PIXELS, 2 * header.size);
  let size = Math.min(header.size, most), since = performance.now(), times = [];
  fit();
  new ResizeObserver(fit).observe(view.canvas);
  view.addEventListener("drawn", () => {
    if (view.canvas.width !== size) return; // a still one
    const now = performance.now();
    times.push(view.statistics.milliseconds);
    if (now - since < 1500) return;
    const typical = times.sort((a, b) => a - b)[times.length >> 1];
    [since, times] = [now, []];
    const wanted = typical > TOO_SLOW ? size * 0.8 : typical < FAST ? size * 1.2 : size;
    const fitted = Math.round(Math.min(Math.max(wanted, LEAST_PIXELS), most) / 16) * 16;
    if (fitted === size) return;
    size = fitted;
    fit();
  });
}

start().catch((error) => say(error.message));
