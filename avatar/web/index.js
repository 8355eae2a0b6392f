// <avatar-view src="anna.avatar">: an avatar in any page. See README.md for the whole interface.
import { AvatarView, steer } from "./view.js";

export { AvatarError } from "./core.js";
export { AvatarView, steer };

const BASE = new URL(".", import.meta.url);

/** Bytes of a URL. Throws Error with what the server said. */
async function fetchBytes(url) {
  const response = await fetch(url);
  if (!response.ok) throw new Error(`${url} answers ${response.status}`);
  return response.arrayBuffer();
}

export class AvatarViewElement extends HTMLElement {
  static observedAttributes = ["src"];
  #view;
  #letGo;

  /** The AvatarView behind the element; undefined until `src` is loaded. */
  get view() {
    return this.#view;
  }

  connectedCallback() {
    if (!this.shadowRoot) {
      const root = this.attachShadow({ mode: "open" });
      root.innerHTML = `<style>:host{display:inline-block;width:256px;max-width:100%}
        canvas{width:100%;display:block;touch-action:none;cursor:grab}p{font:14px system-ui}</style>
        <canvas tabindex="0" role="img" part="canvas"></canvas><p role="alert" hidden part="message"></p>`;
    }
    if (this.getAttribute("src") && !this.#view) this.load(this.getAttribute("src"));
  }

  disconnectedCallback() {
    this.#letGo?.();
    this.#view?.close();
    this.#view = undefined;
  }

  attributeChangedCallback(_, before, after) {
    if (this.isConnected && before !== after && after) this.load(after);
  }

  /** Load an avatar from a URL or bytes. Fires `load` or `error`; resolves with its header. */
  async load(source) {
    this.disconnectedCallback();
    const canvas = this.shadowRoot.querySelector("canvas").cloneNode();
    this.shadowRoot.querySelector("canvas").replaceWith(canvas);
    try {
      const [file, wasm] = await Promise.all([
        source instanceof ArrayBuffer ? source : fetchBytes(source),
        fetchBytes(new URL("avatar.wasm", BASE)),
      ]);
      const worker = new Worker(new URL("worker.js", BASE), { type: "module" });
      const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.#view = new AvatarView(canvas, { worker, wasm, file }, { renderer: this.getAttribute("renderer") ?? "auto", still });
      const header = await this.#view.ready;
      canvas.setAttribute("aria-label", `Avatar of ${header.name}. Arrow keys turn it.`);
      this.#letGo = steer(this.#view, canvas);
      this.#view.addEventListener("drawn", () => this.dispatchEvent(new Event("drawn")));
      this.dispatchEvent(new Event("load"));
      return header;
    } catch (error) {
      const message = this.shadowRoot.querySelector("p");
      message.hidden = false;
      message.textContent = error.message;
      this.dispatchEvent(new CustomEvent("error", { detail: error.message }));
      throw error;
    }
  }

  setExpression(values) {
    return this.#view.setExpression(values);
  }

  setPose(pose) {
    this.#view.setPose(pose);
  }

  play(kind, options) {
    this.#view.play(kind, options);
  }

  pause() {
    this.#view.pause();
  }
}

if (!customElements.get("avatar-view")) customElements.define("avatar-view", AvatarViewElement);
