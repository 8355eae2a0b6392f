// Draws posed Gaussians with WebGL2: one quad each, sorted by depth, blended back to front. Semantics as in the program's
// splatter: 0.3 px^2 of blur, alpha below 1/255 dropped, spherical harmonics seen from the camera.

const WIDTH = 1024; // texels a row of the data textures

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D geometry; // rows of two texels: mean and opacity; colour
uniform sampler2D shape;    // rows of two texels: the upper triangle of the covariance
uniform highp usampler2D order;
uniform mat3 rotation;
uniform vec3 translation;
uniform vec4 lens; // fx, fy, cx, cy
uniform vec2 size;
flat out vec4 colour;
flat out vec3 conic;
out vec2 offset;
const vec2 corners[4] = vec2[4](vec2(-1, -1), vec2(1, -1), vec2(-1, 1), vec2(1, 1));
vec4 texel(sampler2D data, int i) { return texelFetch(data, ivec2(i % ${WIDTH}, i / ${WIDTH}), 0); }
void main() {
  int at = int(texelFetch(order, ivec2(gl_InstanceID % ${WIDTH}, gl_InstanceID / ${WIDTH}), 0).r);
  vec4 place = texel(geometry, 2 * at), a = texel(shape, 2 * at), b = texel(shape, 2 * at + 1);
  colour = vec4(texel(geometry, 2 * at + 1).rgb, place.w);
  vec3 p = rotation * place.xyz + translation;
  gl_Position = vec4(2, 2, 2, 1);
  if (p.z < 0.01 || place.w < 1.0 / 255.0) return;
  mat3 sigma = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
  // The projection is linearised at the centre, which is kept near the picture as in the program's splatter.
  vec2 reach = 0.15 * size / lens.xy, low = -lens.zw / lens.xy - reach, high = (size - lens.zw) / lens.xy + reach;
  vec2 t = clamp(p.xy / p.z, low, high);
  mat3 J = mat3(lens.x / p.z, 0, 0, 0, lens.y / p.z, 0, -lens.x * t.x / p.z, -lens.y * t.y / p.z, 0);
  mat3 T = J * rotation;
  mat3 cov = T * sigma * transpose(T);
  float xx = cov[0][0] + 0.3, xy = cov[0][1], yy = cov[1][1] + 0.3;
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
  const gl = canvas.getContext("webgl2");
  if (!gl || !gl.getExtension("EXT_color_buffer_float")) return false;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : gl.getParameter(gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|software|basic render/i.test(String(name));
}

export class WebglRenderer {
  /** @param sh colour coefficients [n, K, 3]. Throws Error where WebGL2 is missing. */
  constructor(canvas, count, sh) {
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true, premultipliedAlpha: true });
    if (!gl || !gl.getExtension("EXT_color_buffer_float")) throw new Error("WebGL2 with float textures is not there");
    this.gl = gl;
    this.canvas = canvas;
    this.count = count;
    this.sh = sh;
    this.coefficients = sh.length / (3 * count);
    this.rows = Math.ceil((2 * count) / WIDTH);
    this.orderRows = Math.ceil(count / WIDTH);
    this.geometry = new Float32Array(4 * WIDTH * this.rows);
    this.shape = new Float32Array(4 * WIDTH * this.rows);
    this.depths = new Float32Array(count);
    this.order = new Uint32Array(WIDTH * this.orderRows);
    this.#build();
  }

  #build() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.uniform = (name) => gl.getUniformLocation(program, name);
    const texture = (unit, name, format, rows) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, WIDTH, rows);
      gl.uniform1i(this.uniform(name), unit);
    };
    texture(0, "geometry", gl.RGBA32F, this.rows);
    texture(1, "shape", gl.RGBA32F, this.rows);
    texture(2, "order", gl.R32UI, this.orderRows);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** Draw what a worker has posed. */
  draw({ means, quats, scales, opacities }, camera, width, height, background) {
    const gl = this.gl;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.#fill(means, quats, scales, opacities, camera);
    const upload = (unit, rows, format, type, data) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, format, type, data);
    };
    upload(0, this.rows, gl.RGBA, gl.FLOAT, this.geometry);
    upload(1, this.rows, gl.RGBA, gl.FLOAT, this.shape);
    upload(2, this.orderRows, gl.RED_INTEGER, gl.UNSIGNED_INT, this.order);
    gl.uniformMatrix3fv(this.uniform("rotation"), true, camera.rotation);
    gl.uniform3fv(this.uniform("translation"), camera.translation);
    gl.uniform4f(this.uniform("lens"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(this.uniform("size"), width, height);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
  }

  #fill(means, quats, scales, opacities, camera) {
    const R = camera.rotation, t = camera.translation;
    // The camera's place in the world, -R^T t.
    const eye = [0, 1, 2].map((i) => -(R[i] * t[0] + R[3 + i] * t[1] + R[6 + i] * t[2]));
    const { geometry, shape, depths } = this;
    for (let i = 0; i < this.count; ++i) {
      const x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
      depths[i] = R[6] * x + R[7] * y + R[8] * z + t[2];
      geometry.set([x, y, z, opacities[i], ...this.#colour(i, x - eye[0], y - eye[1], z - eye[2])], 8 * i);
      shape.set(covariance(quats, scales, i), 8 * i);
    }
    this.order.set(farthestFirst(depths));
  }

  #colour(i, x, y, z) {
    const norm = Math.hypot(x, y, z) || 1;
    const basis = harmonics(x / norm, y / norm, z / norm, this.coefficients), at = 3 * this.coefficients * i;
    const out = [0.5, 0.5, 0.5];
    for (let k = 0; k < basis.length; ++k) for (let c = 0; c < 3; ++c) out[c] += basis[k] * this.sh[at + 3 * k + c];
    return out.map((v) => Math.max(v, 0));
  }
}

/** Upper triangle (xx, xy, xz, yy, yz, zz) of R S S^T R^T. */
function covariance(quats, scales, i) {
  let [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4);
  const n = Math.hypot(w, x, y, z) || 1;
  [w, x, y, z] = [w / n, x / n, y / n, z / n];
  const R = [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
  const s = [0, 1, 2].map((k) => scales[3 * i + k] ** 2);
  const entry = (a, b) => s[0] * R[3 * a] * R[3 * b] + s[1] * R[3 * a + 1] * R[3 * b + 1] + s[2] * R[3 * a + 2] * R[3 * b + 2];
  return [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2), 0, 0];
}

/** Indices by falling depth: a counting sort over 65,536 steps between the nearest and the farthest. */
function farthestFirst(depths) {
  const STEPS = 65536, count = depths.length;
  let near = Infinity, far = -Infinity;
  for (const d of depths) (near = Math.min(near, d)), (far = Math.max(far, d));
  const scale = (STEPS - 1) / (far - near || 1), keys = new Uint16Array(count), begin = new Uint32Array(STEPS + 1);
  for (let i = 0; i < count; ++i) ++begin[(keys[i] = STEPS - 1 - Math.floor((depths[i] - near) * scale)) + 1];
  for (let k = 0; k < STEPS; ++k) begin[k + 1] += begin[k];
  const order = new Uint32Array(count);
  for (let i = 0; i < count; ++i) order[begin[keys[i]]++] = i;
  return order;
}

/** Real spherical harmonics in the order and with the signs of 3D Gaussian splatting, up to degree 3. */
function harmonics(x, y, z, coefficients) {
  const out = [0.28209479177387814];
  if (coefficients > 1) out.push(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x);
  const xx = x * x, yy = y * y, zz = z * z;
  if (coefficients > 4)
    out.push(
      1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
      -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
    );
  if (coefficients > 9)
    out.push(
      -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4 * zz - xx - yy),
      0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570457994644658 * x * (4 * zz - xx - yy),
      1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy),
    );
  return out;
}

