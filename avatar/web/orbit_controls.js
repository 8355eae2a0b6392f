// Pointer, wheel, touch and keys on a view: they turn it and zoom.

const RESET = { yaw: 0, pitch: 0, zoom: 1 };

/** Let an element's pointers and keys turn and zoom `view`. Returns a function that lets go. */
export function orbitControls(view, element) {
  const held = new Map(); // pointers that are down
  const spread = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  const move = (e) => {
    const before = held.get(e.pointerId), now = { x: e.clientX, y: e.clientY }, width = element.clientWidth || 1;
    if (!before) return;
    const old = held.size === 2 ? spread() : 0;
    held.set(e.pointerId, now);
    if (held.size === 2) view.look({ zoom: (view.view.zoom * spread()) / (old || 1) });
    else
      view.look({
        yaw: view.view.yaw + (70 * (now.x - before.x)) / width,
        pitch: view.view.pitch + (50 * (now.y - before.y)) / width,
      });
  };
  const keys = (e) => {
    const step = e.shiftKey ? 8 : 3, { yaw, pitch, zoom } = view.view;
    const moves = {
      ArrowLeft: { yaw: yaw - step }, ArrowRight: { yaw: yaw + step }, ArrowUp: { pitch: pitch - step },
      ArrowDown: { pitch: pitch + step }, "+": { zoom: zoom * 1.1 }, "=": { zoom: zoom * 1.1 }, "-": { zoom: zoom / 1.1 },
      Home: RESET,
    };
    if (!Object.hasOwn(moves, e.key) || e.ctrlKey || e.metaKey || e.altKey) return;
    e.preventDefault();
    view.look(moves[e.key]);
  };
  const handlers = [
    ["pointerdown", (e) => {
      element.setPointerCapture(e.pointerId);
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
    }],
    ["pointermove", move],
    ...["pointerup", "pointercancel", "lostpointercapture"].map((type) => [type, (e) => held.delete(e.pointerId)]),
    ["wheel", (e) => {
      e.preventDefault();
      view.look({ zoom: view.view.zoom * Math.exp(-0.0015 * e.deltaY) });
    }],
    ["dblclick", () => view.look(RESET)],
    ["keydown", keys],
  ];
  for (const [type, handler] of handlers) element.addEventListener(type, handler, { passive: false });
  return () => handlers.forEach(([type, handler]) => element.removeEventListener(type, handler));
}
