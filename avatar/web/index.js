// <avatar-view src="anna.avatar">: an avatar in any page. README.md and index.d.ts describe the whole interface.
import { FaceCamera } from "./camera.js";
import { AvatarError } from "./core.js";
import { orbitControls } from "./orbit_controls.js";
import { AvatarView } from "./view.js";

export { AvatarError, AvatarView, FaceCamera, orbitControls };

const BASE = new URL(".", import.meta.url);
const INSIDE = `<style>:host{display:inline-block;width:256px;max-width:100%}
  canvas{width:100%;display:block;touch-action:none;cursor:grab}p{font:14px system-ui}</style>
  <canvas tabindex="0" role="img" part="canvas"></canvas><p role="alert" hidden part="message"></p>`;

/** Bytes of a URL. Throws AvatarError with what the server said. */
async function fetchBytes(url) {
  const response = await fetch(url).catch(() => null);
  if (!response?.ok) throw new AvatarError(`${url} cannot be fetched (${response ? response.status : "no answer"}).`);
  return response.arrayBuffer();
}

export class AvatarViewElement extends HTMLElement {
  static observedAttributes = ["src"];
  #view;
  #letGo;
  #camera;
  #loads = 0; // so that the last of several wins
  #isHere = false;

  constructor() {
    super();
    this.attachShadow({ mode: "open" }).innerHTML = INSIDE;
  }

  /** The AvatarView behind the element; undefined until `src` is loaded. */
  get view() {
    return this.#view;
  }

  connectedCallback() {
    this.#isHere = true;
    this.#loadSource();
  }

  disconnectedCallback() {
    this.#isHere = false;
    ++this.#loads;
    this.#close();
  }

  attributeChangedCallback(_, before, after) {
    if (before !== after) this.#loadSource();
  }

  #loadSource() {
    const source = this.getAttribute("src");
    if (this.#isHere && source) this.load(source).catch(() => {}); // it is shown, and an "error" event says it
  }

  #close() {
    this.#camera?.stop();
    this.#letGo?.();
    this.#view?.close();
    this.#view = this.#letGo = undefined;
  }

  /** Load an avatar from a URL or bytes. Fires `load` or `error`; resolves with its header. */
  async load(source) {
    const mine = ++this.#loads, message = this.shadowRoot.querySelector("p");
    this.#close();
    message.hidden = true;
    try {
      const [file, wasm] = await Promise.all([
        typeof source === "string" ? fetchBytes(new URL(source, document.baseURI)) : source,
        fetchBytes(new URL("avatar.wasm", BASE)),
      ]);
      if (mine !== this.#loads) throw new AvatarError("Another avatar was loaded meanwhile.");
      const old = this.shadowRoot.querySelector("canvas"), canvas = old.cloneNode(); // a context cannot change its kind
      old.replaceWith(canvas);
      const worker = new Worker(new URL("worker.js", BASE), { type: "module" });
      const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
      const view = new AvatarView(canvas, { worker, wasm, file }, { renderer: this.getAttribute("renderer") ?? "auto", still });
      this.#view = view;
      const header = await view.ready;
      view.resize(header.size, canvas.clientWidth * devicePixelRatio);
      canvas.setAttribute("aria-label", `Avatar of ${header.name}. Arrow keys turn it.`);
      this.#letGo = orbitControls(view, canvas);
      view.addEventListener("drawn", () => {
        message.hidden = true;
        this.dispatchEvent(new Event("drawn"));
      });
      view.addEventListener("failed", ({ detail }) => this.#say(detail));
      this.dispatchEvent(new Event("load"));
      return header;
    } catch (error) {
      if (mine === this.#loads) {
        this.#close();
        this.#say(error.message);
      }
      throw error;
    }
  }

  #say(sentence) {
    Object.assign(this.shadowRoot.querySelector("p"), { hidden: false, textContent: sentence });
    this.dispatchEvent(new CustomEvent("error", { detail: sentence }));
  }

  setExpression(values) {
    return this.#loaded.setExpression(values);
  }

  setPose(pose) {
    this.#loaded.setPose(pose);
  }

  play(kind, options) {
    this.#loaded.play(kind, options);
  }

  pause() {
    this.#loaded.pause();
  }

  drive(scores, matrix, taken) {
    this.#loaded.drive(scores, matrix, taken);
  }

  /**
   * Drive with the reader's camera, whose permission the browser asks for: call it on a click. `source` is the landmarker's
   * file or its address, by default face-landmarker.js beside the page. Resolves with the FaceCamera, else ends with a sentence.
   */
  async startCamera(source) {
    this.#loaded; // throws
    this.#camera?.stop();
    const camera = (this.#camera = new FaceCamera(this.#view, new Worker(new URL("landmarker_worker.js", BASE))));
    await camera.start(source);
    return camera;
  }

  stopCamera() {
    this.#camera?.stop();
  }

  get #loaded() {
    if (!this.#view?.header) throw new AvatarError("The avatar is not loaded yet: wait for the load event.");
    return this.#view;
  }
}

if (!customElements.get("avatar-view")) customElements.define("avatar-view", AvatarViewElement);
