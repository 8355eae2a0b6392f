// node idle.mjs WEB: prints, for some seconds, the turn of an idle head [yaw, pitch] and the neck's six parameters.
const { idle, places } = await import(`${process.argv[2]}/motion.js`);
const neutral = [1, 0, 0, 0, 1, 0];
const header = (joints) => ({ sizes: { expressions: 1 }, joints, rest: [0, ...neutral, ...neutral, ...neutral, 0, 0, ...neutral] });
const at = places(1).neck;
const frames = (joints) =>
  [0.5, 2, 7].map((seconds) => {
    const { parameters, turn } = idle(header(joints), seconds);
    return { turn, neck: Array.from(parameters.slice(at, at + 6)) };
  });
console.log(JSON.stringify({ torso: frames({ turn: [-0.1, 0.1] }), none: frames({}) }));
