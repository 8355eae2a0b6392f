// Draws off the page's thread. In: load, frame. Out: ready, picture, gaussians, failed. One frame at a time: a newer
// request replaces one that waits.
import { AvatarCore, AvatarError, unpack } from "./core.js";

let core, waiting, busy = false;

self.onmessage = async ({ data }) => {
  try {
    if (data.type === "load") {
      core = await AvatarCore.load(data.wasm, await unpack(data.file));
      const { header, motion, poses } = core;
      self.postMessage({ type: "ready", header, motion, poses, sh: data.wantsColours ? core.sh() : null });
    } else if (data.type === "frame") {
      waiting = data;
      if (!busy) work();
    }
  } catch (error) {
    fail(error);
  }
};

function work() {
  busy = true;
  // A turn of the event loop, in which a newer request may come in.
  setTimeout(() => {
    const frame = waiting;
    waiting = undefined;
    try {
      if (frame && core) draw(frame);
    } catch (error) {
      fail(error);
    }
    busy = false;
    if (waiting) work();
  }, 0);
}

function draw({ id, parameters, camera, width, height, background, wants }) {
  const begin = performance.now();
  core.pose(parameters);
  if (wants === "gaussians") {
    const found = core.gaussians();
    const moved = Object.values(found).map((values) => values.buffer);
    self.postMessage({ type: "gaussians", id, ...found, milliseconds: performance.now() - begin }, moved);
    return;
  }
  const pixels = core.draw(camera, width, height, background).slice();
  self.postMessage({ type: "picture", id, width, height, pixels, milliseconds: performance.now() - begin }, [pixels.buffer]);
}

function fail(error) {
  const sentence = error instanceof AvatarError ? error.message : `The avatar cannot be drawn (${error.message}).`;
  self.postMessage({ type: "failed", sentence });
}
