// The page's card for driving the avatar with a camera.
import { FaceCamera } from "./camera.js";
import { PACK } from "./landmarker.js";

const UPDATE = 500; // milliseconds between figures

/** @param makeWorker  makes the worker of landmarker_worker.js; `putBack` puts the sliders back. */
export function connectCamera(view, makeWorker, putBack) {
  const find = (id) => document.getElementById(id);
  const [button, neutral, mirror, small, video, said, figures, chooser, file] = [
    "camera", "neutral", "mirror", "small", "video", "camera-said", "camera-figures", "chooser", "pack",
  ].map(find), card = find("camera-card"), choices = find("camera-choices");
  const { drive, sizes } = view.header, isNamed = Object.values(drive.blendshapes).flat().some(([place]) => place < sizes.expressions);
  const follows = `The avatar follows you.${isNamed ? "" : " Its head model names no expressions: jaw, lids, gaze and head do."}`;
  let camera = null;

  const show = () => {
    const isOn = camera.state !== "off", isFollowing = camera.state === "following";
    button.textContent = isOn ? "Stop the camera" : "Drive with your camera";
    button.classList.toggle("main", !isOn);
    Object.assign(said, { textContent: camera.sentence || (isFollowing ? follows : ""), hidden: !isOn && !camera.sentence });
    choices.hidden = !isOn;
    neutral.disabled = !isFollowing;
    video.hidden = !isOn || !small.checked || !video.srcObject;
    video.classList.toggle("mirror", mirror.checked);
    if (isFollowing) chooser.hidden = true;
    else if (!isOn && /landmarker/i.test(camera.sentence)) chooser.hidden = false;
    if (!isOn) figures.textContent = "";
  };
  const start = (source) => {
    camera?.stop();
    putBack();
    camera = new FaceCamera(view, makeWorker(), video);
    camera.isMirror = mirror.checked;
    camera.addEventListener("state", show);
    camera.start(source).catch(() => {}); // its sentence is shown
  };

  card.hidden = false;
  button.addEventListener("click", () => (camera && camera.state !== "off" ? camera.stop() : start()));
  neutral.addEventListener("click", () => camera?.calibrate());
  mirror.addEventListener("change", () => camera && (camera.mirror(mirror.checked), show()));
  small.addEventListener("change", () => camera && show());
  file.addEventListener("change", () => {
    if (file.files[0]) start(file.files[0]);
    file.value = "";
  });
  card.addEventListener("dragover", (e) => e.preventDefault());
  card.addEventListener("drop", (e) => {
    e.preventDefault();
    if (e.dataTransfer.files[0]) start(e.dataTransfer.files[0]);
  });
  file.accept = ".js,text/javascript";
  chooser.querySelector("span").textContent = `Choose ${PACK}`;
  setInterval(() => {
    if (camera?.state !== "following") return;
    const { latency, framesPerSecond, landmarks } = camera.statistics;
    figures.textContent = framesPerSecond
      ? `${latency.toFixed(0)} ms from your face to the picture, ${framesPerSecond.toFixed(0)} a second; landmarks ${landmarks.toFixed(0)} ms`
      : "";
  }, UPDATE);
}
