// node drive.mjs WEB AVATAR FACES: poses of faces of a JSON file { neutral, faces: [{ scores, matrix }], widely }, as JSON.
// Each face is two seconds after the one before, so that nothing is smoothed; `widely` lets every place go anywhere; `head` is
// how the head is turned before the reference camera of several.
import { readFileSync } from "node:fs";

const [web, avatar, given] = process.argv.slice(2);
const { parse, unpack } = await import(`${web}/core.js`);
const { FaceDriver, Smoother, calmFace, mirrored } = await import(`${web}/drive.js`);
const { header } = parse(await unpack(readFileSync(avatar)));
const { neutral, faces, widely, values, head } = JSON.parse(readFileSync(given));
const limits = structuredClone(header.drive);
if (widely) for (const [side, far] of [["low", -100], ["high", 100]]) header.drive[side].fill(far);
if (widely) header.orbit = { yaw: [-170, 170], pitch: [-170, 170] };
if (head) header.camera.head = head;
const driver = new FaceDriver(header);
if (neutral) driver.calibrate(neutral);
const poses = faces.map((face, i) => driver.next(face, 2 * i));
const smoother = new Smoother(8);
console.log(JSON.stringify({
  poses: poses.map((pose) => ({ ...pose, parameters: Array.from(pose.parameters) })),
  limits,
  orbit: header.orbit,
  rest: header.rest,
  camera: header.camera,
  calm: faces.length ? calmFace(faces) : null,
  mirrored: faces.map(mirrored),
  back: faces.map(mirrored).map(mirrored),
  smooth: (values ?? []).map((value, i) => smoother.next([value], i / 25)[0]),
}));
