// MediaPipe's face landmarker as one file beside a page, which `avatar export --webcam` writes: read, checked, unpacked.
import { AvatarError } from "./core.js";

export const PACK = "face-landmarker.js";
const VERSION = "0.10.21"; // of @mediapipe/tasks-vision; 1.1.0 reports its use to its maker
const SHA256 = {
  "vision_bundle.mjs": "40f4123dfcd75cfa58add046919cc6f52fde66f009ff582997c09ba54c6ba27c",
  "vision_wasm_internal.js": "4a97e2520ba506c680ecd6ba6acfb146888afa0e2746d57f205352bc6ebb82eb",
  "vision_wasm_internal.wasm": "f00ec4731faa23b3e714d00e88d4d10e2df5c0a427d3a2b4ae6e3526fdd14ef7",
  "face_landmarker.task": "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff",
};
const LARGEST = 2 ** 26; // bytes of a file of the pack
const CALL = /avatarLandmarker\((\{[^]*\})\);?\s*$/;
const GET_IT = `“avatar export --webcam” writes it, or choose it here.`;

/**
 * The landmarker's files by name, from a pack: a File that a person has chosen, or an address. Every file is the one that
 * this program was tested with, else AvatarError says which is not.
 */
export async function loadLandmarker(source = new URL(PACK, document.baseURI)) {
  const pack = source instanceof Blob ? parsed(await source.text(), source.name ?? "The file") : await fetched(new URL(source, document.baseURI));
  if (pack?.version !== VERSION)
    throw new AvatarError(`The landmarker is of version ${String(pack?.version).slice(0, 20)}, this page takes ${VERSION}: “avatar export --webcam” writes both anew.`);
  const entries = Object.entries(SHA256).map(async ([name, digest]) => [name, await unpacked(name, pack.files?.[name], digest)]);
  return Object.fromEntries(await Promise.all(entries));
}

function parsed(text, name) {
  try {
    return JSON.parse(CALL.exec(text)[1]);
  } catch {
    throw new AvatarError(`${name} is not ${PACK}, or it is damaged.`);
  }
}

/** A page from a file may not fetch what lies beside it, but may run it. */
async function fetched(url) {
  const missing = new AvatarError(`${PACK} is not beside this page: ${GET_IT}`);
  if (url.protocol !== "file:") {
    const response = await fetch(url).catch(() => null);
    if (!response?.ok) throw missing;
    return parsed(await response.text(), PACK);
  }
  const script = document.createElement("script");
  try {
    return await new Promise((resolve, reject) => {
      globalThis.avatarLandmarker = resolve;
      script.onerror = () => reject(missing);
      script.onload = () => reject(new AvatarError(`${PACK} is damaged.`)); // after it has called, this does nothing
      script.src = url;
      document.head.append(script);
    });
  } finally {
    script.remove();
    delete globalThis.avatarLandmarker;
  }
}

async function unpacked(name, base64, digest) {
  const wrong = (what) => new AvatarError(`The landmarker's ${name} ${what}: “avatar export --webcam” writes it anew.`);
  let bytes;
  try {
    const packed = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    bytes = await bounded(stream);
  } catch {
    throw wrong("is missing or damaged");
  }
  const found = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  if (Array.from(found, (byte) => byte.toString(16).padStart(2, "0")).join("") !== digest) throw wrong("is another one than this page knows");
  return bytes;
}

async function bounded(stream) {
  const parts = [];
  let size = 0;
  for (const reader = stream.getReader(); ; ) {
    const { done, value } = await reader.read();
    if (done) return new Blob(parts).arrayBuffer();
    size += value.length;
    if (size > LARGEST) throw new RangeError("too large");
    parts.push(value);
  }
}
