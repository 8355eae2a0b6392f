// A camera that drives a view: permission, pictures to the worker that looks for a face, its calm face, then every newest one.
import { AvatarError } from "./core.js";
import { calmFace, mirrored } from "./drive.js";
import { loadLandmarker } from "./landmarker.js";
import { hasRealGpu } from "./webgl_renderer.js";

const CALM_SECONDS = 4, FEWEST = 20; // faces that the neutral one is made of
const LOST_AFTER = 500; // milliseconds without a face that are spoken of
const SMALL = 320; // pixels of a picture where the processor plays the GPU; that costs it 59 ms a face, not 78
const LATELY = 2000; // milliseconds that latency and rate are of
const REFUSALS = {
  NotAllowedError: "The camera was not allowed. Allow it for this page, beside its address, and start again.",
  NotFoundError: "There is no camera on this machine.",
  NotReadableError: "The camera is in use by another program, or does not work.",
  OverconstrainedError: "There is no camera on this machine.",
};

/** Events: "state", when `state` or `sentence` have changed. */
export class FaceCamera extends EventTarget {
  /** @param view  an AvatarView that is ready  @param worker  of landmarker_worker.js, no module  @param video  shows the camera */
  constructor(view, worker, video = document.createElement("video")) {
    super();
    Object.assign(video, { muted: true, playsInline: true });
    this.view = view;
    this.video = video;
    this.isMirror = true; // left is right, as in a mirror; `mirror` changes it
    this.state = "off"; // starting, calibrating, following, off
    this.sentence = "";
    this.statistics = { latency: 0, framesPerSecond: 0, landmarks: 0 }; // milliseconds, of the last two seconds
    this.#worker = worker;
  }

  #worker;
  #stream;
  #release = () => {}; // of listeners
  #calm = []; // faces, until there is a neutral one
  #face;
  #neutral;
  #drawn = [];
  #seen = 0; // when there was a face last
  #last = 0; // time of the picture that was looked at last
  #hasGpu = false;
  #isBusy = false;
  #hasNewer = false;

  /** Resolves when faces are looked for; ends with AvatarError, whose sentence is also shown, where that cannot be. */
  async start(source) {
    try {
      this.#tell("starting", "Loading the landmarker …");
      checkCamera();
      const files = await loadLandmarker(source);
      if (this.state === "starting") await this.#load(files);
      if (this.state === "starting") this.#tell("starting", "Waiting for the camera …");
      const stream = this.state === "starting" ? await openCamera() : null;
      if (this.state !== "starting") return stream?.getTracks().forEach((track) => track.stop());
      await this.#watch(stream);
    } catch (error) {
      const sentence = error instanceof AvatarError ? error.message : `The camera cannot be used (${error.message}).`;
      this.stop(sentence);
      throw new AvatarError(sentence);
    }
  }

  /** The camera goes off, and the avatar comes to rest unless it moves otherwise. */
  stop(sentence = "") {
    if (this.state === "off") return;
    this.#tell("off", sentence);
    this.#release();
    this.#worker.terminate();
    this.#stream?.getTracks().forEach((track) => track.stop());
    this.video.srcObject = null;
    if (this.view.motion === "driven") this.view.play("rest");
  }

  /** Show the person as a mirror does, or as others see them. */
  mirror(isMirror) {
    this.isMirror = isMirror;
    if (this.#neutral) this.view.calibrate(this.#sided(this.#neutral));
  }

  /** Take the newest face for the neutral one. */
  calibrate() {
    if (this.state !== "following") return;
    this.#neutral = this.#face;
    this.view.calibrate(this.#sided(this.#neutral));
  }

  #sided(face) {
    return this.isMirror ? mirrored(face) : face;
  }

  #load(files) {
    const failed = (reason) => new AvatarError(`The landmarker cannot be started in this browser (${reason}).`);
    return new Promise((resolve, reject) => {
      this.#worker.onerror = (event) => reject(failed(event.message ?? "its worker is refused"));
      this.#worker.onmessage = ({ data }) => (data.type === "ready" ? resolve() : reject(failed(data.reason)));
      this.#release = () => reject(failed("it was stopped"));
      this.#hasGpu = hasRealGpu();
      this.#worker.postMessage({ type: "load", files, delegate: this.#hasGpu ? "GPU" : "CPU" }, Object.values(files));
    });
  }

  async #watch(stream) {
    const { video, view } = this;
    this.#stream = stream;
    this.#worker.onmessage = ({ data }) => this.#receive(data);
    this.#worker.onerror = () => this.stop("The landmarker has stopped.");
    for (const track of stream.getTracks()) track.onended = () => this.stop("The camera has stopped.");
    view.release();
    view.play("rest");
    const onMotion = () => view.motion === "driven" || this.stop(); // somebody plays something else
    const onDrawn = ({ detail }) => this.#count(detail.taken);
    view.addEventListener("motion", onMotion);
    view.addEventListener("drawn", onDrawn);
    this.#release = () => {
      view.removeEventListener("motion", onMotion);
      view.removeEventListener("drawn", onDrawn);
    };
    video.srcObject = stream;
    await video.play();
    this.#seen = performance.now();
    this.#tell("calibrating", CALM);
    const onFrame = (now, { captureTime }) => {
      if (this.state === "off") return;
      video.requestVideoFrameCallback(onFrame);
      this.#newest = captureTime ?? now;
      this.#hasNewer = true;
      this.#look();
    };
    video.requestVideoFrameCallback(onFrame);
  }

  #newest = 0; // when the picture that the video shows was taken

  /** Hand on the newest picture; those that come while one is looked at are passed over. */
  async #look() {
    if (this.#isBusy || !this.#hasNewer) return;
    this.#isBusy = true;
    this.#hasNewer = false;
    this.#last = Math.max(this.#newest, this.#last + 1); // the landmarker's times rise
    const { videoWidth: width, videoHeight: height } = this.video, share = SMALL / Math.max(width, height);
    const small = { resizeWidth: Math.round(share * width), resizeHeight: Math.round(share * height), resizeQuality: "low" };
    const picture = await createImageBitmap(this.video, this.#hasGpu || share > 1 ? {} : small).catch(() => null);
    if (picture && this.state !== "off") this.#worker.postMessage({ type: "picture", picture, taken: this.#last }, [picture]);
    else this.#isBusy = false;
  }

  #receive(data) {
    if (data.type === "failed") return this.stop(`The landmarker has stopped (${data.reason}).`);
    this.#isBusy = false;
    this.#look();
    const now = performance.now();
    this.statistics.landmarks = data.milliseconds;
    if (!data.scores) {
      if (now - this.#seen > LOST_AFTER) this.#tell(this.state, "There is no face in the picture.");
      return;
    }
    this.#seen = now;
    this.#face = { scores: data.scores, matrix: data.matrix };
    if (this.#neutral) this.#tell("following", "");
    else this.#learn(data.taken);
    const { scores, matrix } = this.#sided(this.#face);
    if (this.#neutral) this.view.drive(scores, matrix, data.taken);
  }

  /** The neutral face, once the person has been looked at for long enough. */
  #learn(taken) {
    this.#calm.push({ ...this.#face, taken });
    const seconds = (taken - this.#calm[0].taken) / 1000;
    if (seconds < CALM_SECONDS || this.#calm.length < FEWEST) return this.#tell("calibrating", CALM);
    this.#neutral = calmFace(this.#calm);
    this.#calm = [];
    this.view.calibrate(this.#sided(this.#neutral));
    this.#tell("following", "");
  }

  #count(taken) {
    if (taken === undefined || taken === this.#drawn.at(-1)?.taken) return;
    const now = performance.now();
    this.#drawn = [...this.#drawn.filter(({ at }) => now - at < LATELY), { at: now, taken }];
    const late = this.#drawn.map((each) => each.at - each.taken).sort((a, b) => a - b), span = now - this.#drawn[0].at;
    const framesPerSecond = span > 200 ? (1000 * (late.length - 1)) / span : 0;
    Object.assign(this.statistics, { latency: late[late.length >> 1], framesPerSecond });
  }

  #tell(state, sentence) {
    if (state === this.state && sentence === this.sentence) return;
    Object.assign(this, { state, sentence });
    this.dispatchEvent(new Event("state"));
  }
}

const CALM = "Look into the camera for a moment, calmly, lips closed.";

function checkCamera() {
  if (!navigator.mediaDevices?.getUserMedia)
    throw new AvatarError("This browser gives a page at such an address no camera: open it from a file, from this machine or with https.");
  if (!("requestVideoFrameCallback" in HTMLVideoElement.prototype))
    throw new AvatarError("This browser is too old to follow a face.");
}

async function openCamera() {
  const wanted = { video: { facingMode: "user", width: { ideal: 640 }, height: { ideal: 480 }, frameRate: { ideal: 30 } }, audio: false };
  return navigator.mediaDevices.getUserMedia(wanted).catch((error) => {
    throw new AvatarError(REFUSALS[error.name] ?? `The camera cannot be used (${error.message}).`);
  });
}
