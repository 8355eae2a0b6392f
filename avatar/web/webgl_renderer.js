// Draws posed Gaussians with WebGL2: one quad each, farthest first, blended. What it draws is packed by the module
// (avatar/csrc/web/pack.cpp). Semantics as in the program's splatter: variances are blurred, alpha below 1/255 dropped.
import { PACKED } from "./core.js";

const VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec4 place; // mean, opacity
layout(location = 1) in vec3 paint;
layout(location = 2) in vec3 upper; // xx, xy, xz of the covariance
layout(location = 3) in vec3 lower; // yy, yz, zz
uniform mat3 rotation;
uniform vec3 translation;
uniform vec4 lens; // fx, fy, cx, cy
uniform vec2 size;
uniform float blur; // pixels^2
flat out vec4 colour;
flat out vec3 conic;
out vec2 offset;
const vec2 corners[4] = vec2[4](vec2(-1, -1), vec2(1, -1), vec2(-1, 1), vec2(1, 1));
void main() {
  colour = vec4(paint, place.w);
  vec3 p = rotation * place.xyz + translation;
  gl_Position = vec4(2, 2, 2, 1);
  if (p.z < 0.01 || place.w < 1.0 / 255.0) return;
  mat3 sigma = mat3(upper, upper.y, lower.xy, upper.z, lower.yz);
  // The projection is linearised at the centre, which is kept near the picture as in the program's splatter.
  vec2 reach = 0.15 * size / lens.xy, low = -lens.zw / lens.xy - reach, high = (size - lens.zw) / lens.xy + reach;
  vec2 t = clamp(p.xy / p.z, low, high);
  mat3 J = mat3(lens.x / p.z, 0, 0, 0, lens.y / p.z, 0, -lens.x * t.x / p.z, -lens.y * t.y / p.z, 0);
  mat3 T = J * rotation;
  mat3 cov = T * sigma * transpose(T);
  float xx = cov[0][0] + blur, xy = cov[0][1], yy = cov[1][1] + blur;
  float det = xx * yy - xy * xy;
  if (det <= 0.0) return;
  conic = vec3(yy, -xy, xx) / det;
  float cut = 2.0 * log(255.0 * place.w); // where alpha falls below 1/255
  vec2 half_box = sqrt(cut * vec2(xx, yy));
  vec2 centre = p.xy / p.z * lens.xy + lens.zw;
  offset = corners[gl_VertexID] * (half_box + 1.0);
  vec2 pixel = centre + offset;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0, 1);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 colour;
flat in vec3 conic;
in vec2 offset;
out vec4 fragment;
void main() {
  float power = -0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) - conic.y * offset.x * offset.y;
  float alpha = min(0.999, colour.a * exp(power));
  if (power > 0.0 || alpha < 1.0 / 255.0) discard;
  fragment = vec4(colour.rgb * alpha, alpha);
}`;

/** Whether a real GPU draws for WebGL2 here: a processor that pretends is slower than our own module. */
export function hasRealGpu(canvas = document.createElement("canvas")) {
  const gl = canvas.getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!gl) return false;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|software|basic render/i.test(String(name));
}

export class WebglRenderer {
  /** `restored` is called when the browser gives back a context that it had taken. Throws Error where WebGL2 is missing. */
  constructor(canvas, restored = () => {}) {
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true, alpha: false });
    if (!gl) throw new Error("it is switched off or missing");
    this.gl = gl;
    this.canvas = canvas;
    this.#build();
    canvas.addEventListener("webglcontextlost", (e) => e.preventDefault()); // else it does not come back
    canvas.addEventListener("webglcontextrestored", () => {
      this.#build();
      restored();
    });
  }

  /** Browsers keep a few contexts only. */
  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  #build() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "no context");
    gl.useProgram(program);
    this.places = Object.fromEntries(
      ["rotation", "translation", "lens", "size", "blur"].map((name) => [name, gl.getUniformLocation(program, name)]),
    );
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    [[4, 0], [3, 4], [3, 7], [3, 10]].forEach(([width, first], location) => {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, width, gl.FLOAT, false, 4 * PACKED, 4 * first);
      gl.vertexAttribDivisor(location, 1);
    });
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** Draw what a worker has posed and packed. */
  draw(packed, camera, width, height, background, blur) {
    const gl = this.gl, at = this.places;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    gl.bufferData(gl.ARRAY_BUFFER, packed, gl.STREAM_DRAW);
    gl.uniformMatrix3fv(at.rotation, true, camera.rotation);
    gl.uniform3fv(at.translation, camera.translation);
    gl.uniform4f(at.lens, camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(at.size, width, height);
    gl.uniform1f(at.blur, blur);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, packed.length / PACKED);
  }
}
