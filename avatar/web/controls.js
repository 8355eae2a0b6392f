// The sliders of the page: the avatar's own controls, its joints and the camera, each as far as training has shown it.

const JOINTS = [ // name in the header, group, label
  ["jaw", "Jaw", "open"], ["left_lid", "Eyes", "left lid"], ["right_lid", "Eyes", "right lid"],
  ["look_left", "Eyes", "look to its left"], ["look_down", "Eyes", "look down"],
  ["turn", "Torso", "turn right"], ["lean", "Torso", "lean back"],
];
const FIRST = ["Mouth", "Jaw", "Eyes", "Brows"]; // groups in this order, then the others

/** Fill a form with sliders. Returns a function that puts them all back. */
export function makeSliders(view, header, form) {
  const joints = Object.fromEntries(JOINTS.map(([name]) => [name, 0])), sliders = [];
  const pose = (name, value) => {
    joints[name] = value;
    if (name === "jaw") view.setPose({ jaw: [value, 0, 0] });
    else if (name.endsWith("lid")) view.setPose({ lids: [joints.left_lid, joints.right_lid] });
    else if (name.startsWith("look")) view.setPose({ gaze: [joints.look_down, joints.look_left, 0] });
    else view.setPose({ neck: [joints.lean, joints.turn, 0] });
  };
  for (const { group, name, range } of header.controls)
    sliders.push({ group, name, range, set: (value) => view.setExpression({ [`${group}: ${name}`]: value }) });
  for (const [joint, group, name] of JOINTS)
    if (header.joints[joint]) sliders.push({ group, name, range: header.joints[joint], set: (value) => pose(joint, value) });
  const { yaw, pitch } = view.limits;
  sliders.push({ group: "Camera", name: "around", range: yaw, set: (value) => view.look({ yaw: value }), axis: "yaw" });
  sliders.push({ group: "Camera", name: "above", range: pitch, set: (value) => view.look({ pitch: value }), axis: "pitch" });

  const groups = new Map([...FIRST, ...sliders.map((s) => s.group)].map((group) => [group, []]));
  for (const slider of sliders) groups.get(slider.group).push(slider);
  for (const [group, members] of groups) {
    if (members.length === 0) continue;
    const box = Object.assign(document.createElement("details"), { open: form.children.length === 0 });
    box.append(Object.assign(document.createElement("summary"), { textContent: group }));
    for (const slider of members) box.append(row(slider));
    form.append(box);
  }
  form.addEventListener("submit", (e) => e.preventDefault());
  view.addEventListener("view", () => {
    for (const { axis, input } of sliders) if (axis) input.value = view.view[axis];
  });
  return () => {
    for (const name of Object.keys(joints)) joints[name] = 0;
    for (const { input } of sliders) input.value = 0;
  };
}

function row(slider) {
  const [low, high] = slider.range, label = Object.assign(document.createElement("label"), { className: "row" });
  slider.input = Object.assign(document.createElement("input"), {
    type: "range", min: low, max: high, step: "any", value: 0, name: `${slider.group}: ${slider.name}`,
  });
  slider.input.setAttribute("aria-label", `${slider.group}: ${slider.name}`);
  slider.input.addEventListener("input", () => slider.set(Number(slider.input.value)));
  label.append(Object.assign(document.createElement("span"), { textContent: slider.name, title: slider.name }), slider.input);
  return label;
}
