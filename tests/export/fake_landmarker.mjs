// Stands for MediaPipe's vision_bundle.mjs: the brighter the picture, the wider the mouth and the farther the turn to the
// left; no face in the dark. Its calls are those of the real one.
export class FaceLandmarker {
  static async createFromOptions(module, options) {
    const loader = await (await fetch(module.wasmLoaderPath)).text(), binary = await (await fetch(module.wasmBinaryPath)).text();
    const model = new TextDecoder().decode(options.baseOptions.modelAssetBuffer);
    if (`${loader} ${binary} ${model}` !== "loader binary model") throw new Error(`got ${loader} ${binary} ${model}`);
    if (options.runningMode !== "VIDEO" || !options.outputFaceBlendshapes || !options.outputFacialTransformationMatrixes)
      throw new Error("wrong options");
    return new FaceLandmarker();
  }

  #last = -1;
  #context = new OffscreenCanvas(8, 8).getContext("2d", { willReadFrequently: true });

  detectForVideo(picture, milliseconds) {
    if (!(milliseconds > this.#last)) throw new Error("times must rise");
    this.#last = milliseconds;
    const longest = Math.max(picture.width, picture.height);
    if (longest !== 320) throw new Error(`${longest} pixels in software, not 320`);
    this.#context.drawImage(picture, 0, 0, 8, 8);
    const pixels = this.#context.getImageData(0, 0, 8, 8).data, light = pixels[4 * 36 + 1] / 255;
    if (light < 0.15) return { faceBlendshapes: [], facialTransformationMatrixes: [], faceLandmarks: [] };
    const [c, s] = [Math.cos(0.2 * light), Math.sin(0.2 * light)];
    const data = [c, 0, -s, 0, 0, 1, 0, 0, s, 0, c, 0, 0, 0, -50, 1];
    const categories = [["_neutral", 0], ["jawOpen", light], ["eyeBlinkLeft", 0]].map(([categoryName, score]) => ({ categoryName, score }));
    return { faceBlendshapes: [{ categories }], facialTransformationMatrixes: [{ rows: 4, columns: 4, data }], faceLandmarks: [[]] };
  }
}
