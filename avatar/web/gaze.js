// Eyes that follow the pointer, as far as training has shown them to look.

/** Returns a function that switches it on and off; it rests while a motion plays, a face drives, or `isHeld` says so. */
export function followPointer(view, header, isHeld) {
  const { look_left: across = [0, 0], look_down: down = [0, 0] } = header.joints;
  let isOn = false, target = null, now = [0, 0], isSet = false; // no target before the pointer moves
  const part = (share, [low, high]) => (share > 0 ? high : -low) * Math.max(-1, Math.min(share, 1));
  const move = (e) => {
    const box = view.canvas.getBoundingClientRect();
    const [x, y] = [(e.clientX - box.left) / box.width - 0.5, (e.clientY - box.top) / box.height - 0.45].map((v) => 1.6 * v);
    target = [part(y, down), part(x, across)];
  };
  const letGo = () => {
    if (isSet && !isHeld()) view.setPose({ gaze: null });
    isSet = false;
  };
  const step = () => {
    if (!isOn) return letGo();
    requestAnimationFrame(step);
    if (!target || isHeld() || !["idle", "rest"].includes(view.motion)) return letGo();
    if (!now.every((v, i) => Math.abs(v - target[i]) < 1e-4)) now = now.map((v, i) => v + 0.25 * (target[i] - v));
    view.setPose({ gaze: [...now, 0] });
    isSet = true;
  };
  addEventListener("pointermove", move);
  return (on) => {
    if (on && !isOn) requestAnimationFrame(step);
    isOn = on;
  };
}
