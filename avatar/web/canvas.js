// Pictures on canvases.

/** Put RGBA bytes on a canvas, which takes their size. */
export function paint(canvas, context, values, width, height) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  context.putImageData(new ImageData(values, width, height), 0, 0);
}

/** A canvas as a PNG. */
export function png(canvas) {
  return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
}
