// Draws off the page's thread. In: load, frame. Out: ready, picture, gaussians, failed.
import { AvatarCore, AvatarError, unpack } from "./core.js";

let core;

self.onmessage = async ({ data }) => {
  try {
    if (data.type === "load") {
      const isPacked = new Uint8Array(data.wasm)[0] === 0x1f; // gzip's first byte
      core = await AvatarCore.load(...(await Promise.all([isPacked ? unpack(data.wasm) : data.wasm, unpack(data.file)])));
      const { header, motion, poses } = core;
      self.postMessage({ type: "ready", header, motion, poses });
    } else {
      draw(data);
    }
  } catch (error) {
    const sentence = error instanceof AvatarError ? error.message : `The avatar cannot be drawn (${error.message}).`;
    self.postMessage({ type: "failed", sentence, wants: data.wants });
  }
};

function draw({ parameters, camera, head, width, height, background, wants }) {
  const begin = performance.now();
  core.pose(parameters, head);
  const values = (wants === "gaussians" ? core.pack(camera, width, height) : core.draw(camera, width, height, background)).slice();
  self.postMessage({ type: wants, values, milliseconds: performance.now() - begin }, [values.buffer]);
}
