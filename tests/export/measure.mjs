// node measure.mjs WEB SIZES: what the core says of sizes, a JSON list of lists in the order of avatar_measure.
import { readFileSync } from "node:fs";

const [web, sizes] = process.argv.slice(2);
const imports = { env: { emscripten_notify_memory_growth() {} }, wasi_snapshot_preview1: { proc_exit() {} } };
const { instance } = await WebAssembly.instantiate(readFileSync(new URL(`${web}/avatar.wasm`)), imports);
instance.exports._initialize();
console.log(JSON.stringify(JSON.parse(sizes).map((own) => instance.exports.avatar_measure(...own))));
