// Looks for a face in pictures, off the page's thread: a worker of its own around MediaPipe's face landmarker, which needs a
// worker that is no module. In: load, picture. Out: ready, face, failed.

let landmarker;

self.onmessage = async ({ data }) => {
  try {
    if (data.type === "load") {
      landmarker = await load(data.files, data.delegate);
      self.postMessage({ type: "ready" });
    } else {
      self.postMessage(look(data));
    }
  } catch (error) {
    self.postMessage({ type: "failed", reason: String(error?.message ?? error).slice(0, 200) });
  }
};

async function load(files, delegate) {
  const url = (name, type) => URL.createObjectURL(new Blob([files[name]], { type }));
  const { FaceLandmarker } = await import(url("vision_bundle.mjs", "text/javascript"));
  const module = {
    wasmLoaderPath: url("vision_wasm_internal.js", "text/javascript"),
    wasmBinaryPath: url("vision_wasm_internal.wasm", "application/wasm"),
  };
  return FaceLandmarker.createFromOptions(module, {
    baseOptions: { modelAssetBuffer: new Uint8Array(files["face_landmarker.task"]), delegate },
    runningMode: "VIDEO",
    numFaces: 1,
    outputFaceBlendshapes: true,
    outputFacialTransformationMatrixes: true,
  });
}

/** The face in a picture: scores by ARKit's names, and its pose, 4x4 by columns; both null where there is none. */
function look({ picture, taken }) {
  const begin = performance.now();
  const found = landmarker.detectForVideo(picture, taken);
  picture.close();
  const shapes = found.faceBlendshapes[0]?.categories;
  const scores = shapes ? Object.fromEntries(shapes.map(({ categoryName, score }) => [categoryName, score])) : null;
  const matrix = shapes ? (found.facialTransformationMatrixes[0]?.data ?? null) : null;
  return { type: "face", scores, matrix, taken, milliseconds: performance.now() - begin };
}
