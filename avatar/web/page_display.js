// What surrounds the picture in the page: background, full screen, eyes that follow, a line to embed it, and keys.
import { followPointer } from "./gaze.js";

const escaped = (text) => text.replace(/[&<>"]/g, (letter) => `&#${letter.charCodeAt(0)};`); // for an attribute
const STAGE = { light: "#f7f7f9", dark: "#322f2e" };

/** `play` is what the space key does. Returns a function that puts the background back. */
export function connectPageDisplay(view, header, isGazeHeld, play) {
  const find = (id) => document.getElementById(id), asked = new URLSearchParams(location.search);
  const [background, gaze, full] = ["background", "gaze", "full"].map(find), isDark = matchMedia("(prefers-color-scheme: dark)");
  let isChosen = /^#[0-9a-f]{6}$/i.test(asked.get("background") ?? "");
  const paint = () => {
    view.background = [1, 3, 5].map((at) => parseInt(background.value.slice(at, at + 2), 16) / 255);
    document.documentElement.style.setProperty("--stage", background.value);
    describe();
  };
  const putBack = () => {
    if (!isChosen) background.value = isDark.matches ? STAGE.dark : STAGE.light;
    paint();
  };
  const describe = () => {
    const place = location.protocol === "file:" ? location.pathname.split("/").pop() : location.origin + location.pathname;
    const colour = isChosen ? `&background=${encodeURIComponent(background.value)}` : "";
    find("embed").value = `<iframe src="${escaped(place)}?noui&autoplay${colour}" title="${escaped(header.name)}, a synthetic head" width="480" height="480" style="border:0"></iframe>`;
  };
  if (isChosen) background.value = asked.get("background");
  putBack();
  isDark.addEventListener("change", putBack);
  background.addEventListener("input", () => {
    isChosen = true;
    paint();
  });

  const follow = followPointer(view, header, isGazeHeld);
  gaze.checked = matchMedia("(hover: hover) and (prefers-reduced-motion: no-preference)").matches;
  const setGaze = () => follow(gaze.checked);
  gaze.addEventListener("change", setGaze);
  setGaze();

  const goFull = () => (document.fullscreenElement ? document.exitFullscreen() : find("stage").requestFullscreen());
  full.hidden = !document.fullscreenEnabled;
  full.addEventListener("click", goFull);
  document.addEventListener("fullscreenchange", () => (full.textContent = document.fullscreenElement ? "Leave full screen" : "Full screen"));
  find("copy").addEventListener("click", async () => {
    find("embed").select();
    const copied = navigator.clipboard?.writeText(find("embed").value) ?? Promise.reject();
    find("copy").textContent = await copied.then(() => "Copied", () => "Selected"); // which the reader copies
  });
  const keys = { e: () => gaze.click(), f: () => full.hidden || goFull(), " ": play };
  document.addEventListener("keydown", (e) => {
    const isElsewhere = e.target.closest("input, button, summary"), act = keys[e.key.toLowerCase()];
    if (!act || isElsewhere || e.ctrlKey || e.metaKey || e.altKey) return;
    e.preventDefault();
    act();
  });
  return () => {
    isChosen = false;
    putBack();
  };
}
