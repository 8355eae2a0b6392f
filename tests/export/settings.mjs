// node settings.mjs WEB: prints the parameters of a moving face after some of it is set, by case.
const { Settings } = await import(`${process.argv[2]}/settings.js`);
const { places, rotation, rotationVector, sixD } = await import(`${process.argv[2]}/motion.js`);
const neutral = [1, 0, 0, 0, 1, 0], at = places(3);
const rest = [0.5, -1, 2, ...neutral, ...neutral, ...neutral, 0.1, 0.1, ...neutral];
const controls = [
  { group: "Mouth", name: "wide", values: [0.6, 0.8, 0] },
  { group: "Brows", name: "up", values: [-0.8, 0.6, 0] },
];
const header = { controls, expressions: ["a", "b", "c"], sizes: { expressions: 3 }, rest };
const vectors = { jaw: [0.2, 0, 0], left: [0.1, -0.3, 0.02], right: [0.1, -0.2, 0.02], neck: [0.05, 0.3, 0] };
const moving = Float32Array.from(rest);
moving.set([1, 0, 1.5]);
Object.entries({ jaw: at.jaw, left: at.eyes, right: at.eyes + 6, neck: at.neck }).forEach(([name, start]) => moving.set(sixD(rotation(vectors[name])), start));
moving.set([0.8, 0.3], at.eyelids);

const after = (...calls) => {
  const settings = new Settings(header), parameters = moving.slice();
  for (const call of calls) call(settings);
  settings.apply(parameters);
  const turns = { jaw: at.jaw, left: at.eyes, right: at.eyes + 6, neck: at.neck };
  const vector = ([name, start]) => [name, rotationVector(parameters.subarray(start, start + 6))];
  const [expression, lids] = [[0, 3], [at.eyelids, at.eyelids + 2]].map(([from, to]) => Array.from(parameters.slice(from, to)));
  return { ...Object.fromEntries(Object.entries(turns).map(vector)), expression, lids };
};
const refused = (pose) => {
  try {
    new Settings(header).setPose(pose);
  } catch (error) {
    return error.message;
  }
};
const gaze = (s) => s.setPose({ gaze: [null, 0.2, 0] });
console.log(JSON.stringify({
  nothing: after(),
  wide: after((s) => s.setExpression({ "Mouth: wide": 0 })),
  both: after((s) => s.setExpression({ "Mouth: wide": 2, "Brows: up": -1 })),
  controlLast: after((s) => s.setParameters(rest), (s) => s.setExpression({ "Mouth: wide": 2 })),
  coefficientLast: after((s) => s.setExpression({ "Mouth: wide": 2, c: 7 }), (s) => s.setExpression({ a: 4 })),
  gaze: after(gaze),
  lid: after((s) => s.setPose({ lids: [0.5, null] })),
  released: after(gaze, (s) => s.setPose({ gaze: null })),
  refused: [refused({ jaw: [NaN, 0, 0] }), refused({ lids: [1] }), refused({ jaw: null, head: [1, 2] }) ?? "fine"],
}));
