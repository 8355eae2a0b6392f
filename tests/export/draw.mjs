// node draw.mjs WEB AVATAR FRAMES OUT: draws the frames of a JSON file with WebAssembly, RGBA bytes one after another.
import { readFileSync, writeFileSync } from "node:fs";

const [web, avatar, frames, out] = process.argv.slice(2);
const { AvatarCore, unpack } = await import(`${web}/core.js`);
const core = await AvatarCore.load(readFileSync(new URL(`${web}/avatar.wasm`)), await unpack(readFileSync(avatar)));
const pictures = JSON.parse(readFileSync(frames)).map(({ parameters, camera, width, height }) => {
  core.pose(parameters, camera.rotation);
  return Buffer.from(core.draw(camera, width, height).slice().buffer);
});
writeFileSync(out, Buffer.concat(pictures));
console.log(JSON.stringify({ frames: pictures.length, rest: core.header.rest }));
