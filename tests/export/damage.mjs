// node damage.mjs WEB AVATAR CASES: damages an unpacked file in CASES ways; prints what each came to, counted.
import { readFileSync } from "node:fs";

const [web, avatar, cases] = process.argv.slice(2);
const { AvatarCore, AvatarError, unpack } = await import(`${web}/core.js`);
const wasm = await WebAssembly.compile(readFileSync(new URL(`${web}/avatar.wasm`)));
const packed = readFileSync(avatar), whole = await unpack(packed);
let state = 12345;
const random = (n) => {
  state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
  return Math.floor((state / 2 ** 32) * n);
};
const length = new DataView(whole.buffer).getUint32(4, true);
const header = JSON.parse(new TextDecoder().decode(whole.subarray(8, 8 + length)));
const EVIL = [null, -1, 0, 1e9, 2 ** 31, NaN, 1.5, "x", [], {}, [[]], true, "__proto__", 1e308, [null], [NaN]];

function hostileHeader() {
  const copy = structuredClone(header), path = [];
  let at = copy;
  while (at && typeof at === "object" && Object.keys(at).length > 0 && (path.length === 0 || random(3) > 0)) {
    const key = Object.keys(at)[random(Object.keys(at).length)];
    path.push([at, key]);
    at = at[key];
  }
  const [parent, key] = path.at(-1);
  if (random(4) === 0) delete parent[key];
  else parent[key] = EVIL[random(EVIL.length)];
  const text = new TextEncoder().encode(JSON.stringify(copy)), bytes = new Uint8Array(8 + text.length + whole.length - 8 - length);
  bytes.set(whole.subarray(0, 8));
  bytes[3] = 0x31 + random(2); // of this format or of the one before
  new DataView(bytes.buffer).setUint32(4, text.length, true);
  bytes.set(text, 8);
  bytes.set(whole.subarray(8 + length), 8 + text.length);
  return bytes;
}

function damaged(kind) {
  if (kind === 0) return whole.slice(0, random(whole.length)); // cut short
  if (kind === 1) return hostileHeader();
  const bytes = whole.slice(), where = kind === 2 ? 8 + length : whole.length;
  for (let i = 0; i < 1 + random(8); ++i) bytes[random(where)] = random(256);
  return bytes;
}

const found = { drawn: 0, refused: 0 }, wrong = [];
for (let i = 0; i < Number(cases); ++i) {
  try {
    if (i % 5 === 4) {
      const bytes = Uint8Array.from(packed);
      for (let k = 0; k < 3; ++k) bytes[random(bytes.length)] = random(256);
      await unpack(bytes);
      ++found.drawn;
      continue;
    }
    const core = await AvatarCore.load(wasm, damaged(i % 5));
    core.pose(core.header.rest, core.header.camera.rotation);
    core.draw({ rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], translation: [0, 0, 1], fx: 32, fy: 32, cx: 8, cy: 8 }, 16, 16);
    ++found.drawn;
  } catch (error) {
    if (error instanceof AvatarError && error.message.endsWith(".")) ++found.refused;
    else wrong.push(`case ${i}: ${error.stack}`);
  }
}
console.log(JSON.stringify({ ...found, wrong: wrong.slice(0, 5) }));
