// Gaussians as formats/packed.py wrote them: unpacked, sorted in a worker, drawn by WebGL2 and looked up on the CPU, all
// by the equations of chebsplat/rasterize (EWA with 0.3 pixels² of low-pass; fainter than 1/255 is skipped; 0.99 at most).
// Frame: the scene's, moved by `center`; cameras are OpenCV's (x right, y down, z ahead), pixels from the upper left.
"use strict";
const NEAR = 0.01, LOW_PASS = 0.3, FAINTEST = 1 / 255, MOST = 0.99, EXTENT = 3.33, LATE = [0.7, 0.9];

/** The arrays of a page: base64 of gzip, their places as `to_bytes` gives them. */
async function unpacked(base64, places) {
  const bytes = Uint8Array.from(atob(base64.trim()), letter => letter.charCodeAt(0));
  const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(plain).arrayBuffer();
  const kinds = { uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, float32: Float32Array };
  return Object.fromEntries(Object.entries(places).map(([name, { dtype, shape, offset }]) =>
    [name, new kinds[dtype](buffer, offset, shape.reduce((a, b) => a * b, 1))]));
}

/** Activated parameters of n Gaussians: means 3n, covariances 6n (xx xy xz yy yz zz), reach n (largest scale), ... */
function decoded(arrays, ranges, center) {
  const n = arrays.opacities.length, half = Math.SQRT1_2;
  const means = new Float32Array(3 * n), covariances = new Float32Array(6 * n), reach = new Float32Array(n);
  const colors = new Float32Array(3 * n), opacities = Float32Array.from(arrays.opacities, byte => byte / 255);
  const at = (name, axis, integer) => integer * ranges[name].step[axis] + ranges[name].low[axis];
  const { means: m, log_scales: s, quats: w, colors: c } = arrays, scale = [0, 0, 0], q = [0, 0, 0, 0];
  for (let k = 0; k < n; k++) {
    for (let axis = 0; axis < 3; axis++) {
      const from = 3 * axis * n + k;
      means[3 * k + axis] = at("means", axis, m[from] | m[from + n] << 8 | m[from + 2 * n] << 16) - center[axis];
      scale[axis] = Math.exp(at("log_scales", axis, s[axis * n + k]));
      colors[3 * k + axis] = at("colors", axis, c[axis * n + k]);
    }
    const word = (w[k] | w[n + k] << 8 | w[2 * n + k] << 16 | w[3 * n + k] << 24) >>> 0, largest = word >>> 30;
    let rest = 1;
    for (let j = 0, shift = 20; j < 4; j++) if (j != largest) {
      q[j] = ((word >>> shift & 1023) / 1023 - 0.5) / half; rest -= q[j] * q[j]; shift -= 10;
    }
    q[largest] = Math.sqrt(Math.max(rest, 0));
    const [a, x, y, z] = q, rows = [
      1 - 2 * (y * y + z * z), 2 * (x * y - a * z), 2 * (x * z + a * y), 2 * (x * y + a * z), 1 - 2 * (x * x + z * z),
      2 * (y * z - a * x), 2 * (x * z - a * y), 2 * (y * z + a * x), 1 - 2 * (x * x + y * y)];
    for (let i = 0, to = 6 * k; i < 3; i++) for (let j = i; j < 3; j++, to++)
      for (let axis = 0; axis < 3; axis++) covariances[to] += rows[3 * i + axis] * rows[3 * j + axis] * scale[axis] ** 2;
    reach[k] = Math.max(...scale);
  }
  const sh1 = arrays.sh1 && Float32Array.from(arrays.sh1, (value, i) => value * ranges.sh1.step[Math.floor(i / n)]);
  return { n, means, covariances, reach, opacities, colors, sh1 };
}

/** The Gaussians that a camera { turn, shift, slopes } may see, back to front: sorted by 24 bits of depth, in two passes of
 * 12, since Gaussians of a wall seen face on differ only in low bits. Floats compare as integers. slopes: the picture's half
 * sides at depth 1; a margin allows for a camera that turns on. */
function sorted(means, reach, { turn: R, shift, slopes: [wide, tall] }) {
  const n = reach.length, depths = new Float32Array(n), bits = new Uint32Array(depths.buffer);
  let low = 0xffffffff, high = 0, count = 0, order = new Uint32Array(n);
  for (let k = n; k--;) { // of equal depth the first is in front, as in ours
    const a = means[3 * k], b = means[3 * k + 1], c = means[3 * k + 2], z = R[6] * a + R[7] * b + R[8] * c + shift[2];
    const x = Math.abs(R[0] * a + R[1] * b + R[2] * c + shift[0]), y = Math.abs(R[3] * a + R[4] * b + R[5] * c + shift[1]);
    const about = 3.4 * reach[k] + 0.01;
    if (z > 0.01 && x < 1.2 * wide * z + about * (1 + wide) && y < 1.2 * tall * z + about * (1 + tall)) {
      depths[k] = z; order[count++] = k; if (bits[k] < low) low = bits[k]; if (bits[k] > high) high = bits[k];
    }
  }
  order = order.subarray(0, count);
  const scale = Math.min(0xffffff / Math.max(high - low, 1), 1);
  for (let i = 0; i < count; i++) bits[order[i]] = (high - bits[order[i]]) * scale;
  for (const lowest of [0, 12]) {
    const starts = new Uint32Array(4097), from = order;
    for (let i = 0; i < count; i++) starts[(bits[from[i]] >> lowest & 4095) + 1]++;
    for (let key = 1; key < 4096; key++) starts[key] += starts[key - 1];
    order = new Uint32Array(count);
    for (let i = 0; i < count; i++) order[starts[bits[from[i]] >> lowest & 4095]++] = from[i];
  }
  return order;
}

/** Sorts beside the page; one request at a time, the newest wins. */
class Sorter {
  constructor({ means, reach }, done) {
    const program = `${sorted}; let means, reach; onmessage = ({ data }) => {
      if (data.means) { ({ means, reach } = data); return; }
      const order = sorted(means, reach, data); postMessage(order, [order.buffer]); }`;
    this.worker = new Worker(URL.createObjectURL(new Blob([program], { type: "text/javascript" })));
    this.worker.postMessage({ means, reach });
    this.worker.onmessage = ({ data }) => {
      const next = this.next; this.busy = !!next; this.next = null;
      if (next) this.worker.postMessage(next);
      done(data);
    };
  }
  ask(camera) {
    if (this.busy) this.next = camera; else { this.busy = true; this.worker.postMessage(camera); }
  }
}

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform sampler2D shapes, tints, bands; uniform usampler2D order;
uniform mat3 turn; uniform vec3 shift, eye; uniform vec4 lens; uniform vec2 size; uniform bool view_dependent;
flat out vec4 color; out vec2 offset;
void main() {
  int place = gl_VertexID >> 2, corner = gl_VertexID & 3;
  uint splat = texelFetch(order, ivec2(place & 1023, place >> 10), 0).r;
  int column = int(splat & 1023u), row = int(splat >> 10u);
  vec4 a = texelFetch(shapes, ivec2(3 * column, row), 0), tint = texelFetch(tints, ivec2(column, row), 0);
  vec3 p = turn * a.xyz + shift;
  float opacity = a.w * tint.a;
  gl_Position = vec4(0, 0, 2, 1); color = vec4(0); offset = vec2(0);
  if (!(p.z > ${NEAR}) || opacity < ${FAINTEST}) return;
  vec4 b = texelFetch(shapes, ivec2(3 * column + 1, row), 0), c = texelFetch(shapes, ivec2(3 * column + 2, row), 0);
  vec2 slope = p.xy / p.z, middle = lens.xy * slope + lens.zw, slack = 0.15 * size / lens.xy;
  vec2 held = clamp(slope, -lens.zw / lens.xy - slack, (size - lens.zw) / lens.xy + slack);
  vec3 u = (vec3(1, 0, -held.x) * turn) * (lens.x / p.z), v = (vec3(0, 1, -held.y) * turn) * (lens.y / p.z);
  mat3 S = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  float xx = dot(u, S * u) + ${LOW_PASS}, xy = dot(u, S * v), yy = dot(v, S * v) + ${LOW_PASS};
  float half_sum = 0.5 * (xx + yy), away = length(vec2(0.5 * (xx - yy), xy));
  float longest = half_sum + away, shortest = max(half_sum - away, ${LOW_PASS});
  vec2 axis = xx >= yy ? vec2(longest - yy, xy) : vec2(xy, longest - xx);
  axis = away > 1e-9 * half_sum && dot(axis, axis) > 0.0 ? normalize(axis) : vec2(1, 0);
  offset = (vec2(corner & 1, corner >> 1) * 2.0 - 1.0) * sqrt(2.0 * log(255.0 * opacity));
  vec2 pixel = middle + offset.x * sqrt(longest) * axis + offset.y * sqrt(shortest) * vec2(-axis.y, axis.x);
  gl_Position = vec4((2.0 * pixel / size - 1.0) * vec2(1, -1), 0, 1);
  vec3 shade = tint.rgb;
  if (view_dependent) {
    vec3 d = 0.4886025119029199 * normalize(a.xyz - eye);
    shade += d.z * texelFetch(bands, ivec2(3 * column + 1, row), 0).rgb
      - d.y * texelFetch(bands, ivec2(3 * column, row), 0).rgb - d.x * texelFetch(bands, ivec2(3 * column + 2, row), 0).rgb;
  }
  color = vec4(max(shade, 0.0), opacity);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 color; in vec2 offset; out vec4 shown;
void main() {
  float alpha = min(color.a * exp(-0.5 * dot(offset, offset)), ${MOST});
  if (alpha < ${FAINTEST}) discard;
  shown = vec4(color.rgb * alpha, alpha);
}`;

/** Draws back to front into a canvas; the tints [n] of colour and strength are the page's to set. */
class Drawing {
  constructor(canvas, splats) {
    const gl = this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("this browser has no WebGL2");
    Object.assign(this, { canvas, splats, count: 0 });
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(this.program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(this.program); gl.useProgram(this.program);
    this.at = Object.fromEntries(["turn", "shift", "eye", "lens", "size", "view_dependent"].map(name =>
      [name, gl.getUniformLocation(this.program, name)]));
    ["shapes", "tints", "bands", "order"].forEach((name, unit) => gl.uniform1i(gl.getUniformLocation(this.program, name), unit));
    gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA); gl.clearColor(0, 0, 0, 1);
    const { n, means, covariances: s, opacities, sh1 } = splats, shapes = new Float32Array(12 * n);
    for (let k = 0; k < n; k++)
      shapes.set([means[3 * k], means[3 * k + 1], means[3 * k + 2], opacities[k], ...s.subarray(6 * k, 6 * k + 6)], 12 * k);
    const corners = new Uint32Array(6 * n); // of a quad each: software that draws instances one by one is slow
    for (let k = 0; k < n; k++) [0, 1, 2, 2, 1, 3].forEach((corner, i) => { corners[6 * k + i] = 4 * k + corner; });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer()); gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.texture(0, 3, shapes);
    this.texture(2, 3, sh1 ? Float32Array.from({ length: 12 * n }, (_, i) =>
      i % 4 == 3 ? 0 : sh1[(3 * Math.floor(i % 12 / 4) + i % 4) * n + Math.floor(i / 12)]) : new Float32Array(0));
  }
  /** A texture of rows of 1024 Gaussians: floats, `wide` texels each, or whole numbers. */
  texture(unit, wide, values) {
    const gl = this.gl, floats = values instanceof Float32Array, of = floats ? 4096 * wide : 1024;
    const rows = Math.max(Math.ceil(values.length / of), 1), whole = new values.constructor(rows * of); whole.set(values);
    const form = floats ? [gl.RGBA32F, gl.RGBA, gl.FLOAT] : [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT];
    gl.activeTexture(gl.TEXTURE0 + unit);
    this.textures ??= {}; gl.bindTexture(gl.TEXTURE_2D, this.textures[unit] ??= gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, form[0], 1024 * wide, rows, 0, form[1], form[2], whole);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, gl.NEAREST);
  }
  tint(values) { this.texture(1, 1, values); }
  order(order) { this.texture(3, 1, order); this.count = order.length; }
  /** Draw what a camera sees: { turn, shift, eye, lens } of a picture as large as the canvas. */
  draw(camera, view_dependent) {
    const { gl, at, canvas } = this;
    gl.viewport(0, 0, canvas.width, canvas.height); gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(at.turn, true, camera.turn); gl.uniform3fv(at.shift, camera.shift); gl.uniform3fv(at.eye, camera.eye);
    gl.uniform4fv(at.lens, camera.lens); gl.uniform2f(at.size, canvas.width, canvas.height);
    gl.uniform1i(at.view_dependent, view_dependent ? 1 : 0);
    gl.drawElements(gl.TRIANGLES, 6 * this.count, gl.UNSIGNED_INT, 0);
  }
  /** The picture as bytes, rows from the top: read it in the task that drew it. */
  pixels() {
    const { gl, canvas: { width, height } } = this, bytes = new Uint8Array(4 * width * height), flipped = new Uint8Array(bytes.length);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    for (let y = 0; y < height; y++) flipped.set(bytes.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
    return flipped;
  }
}

/** What lies under a pixel, front to back: [[Gaussian, its weight α T], ...], how far it is covered, and the mean depth. */
function under(splats, order, { turn: R, shift, lens: [fx, fy, cx, cy], size: [width, height] }, x, y, strength) {
  const { means, covariances: s, reach, opacities } = splats, found = [];
  const left = -cx / fx - 0.15 * width / fx, right = (width - cx) / fx + 0.15 * width / fx;
  const top = -cy / fy - 0.15 * height / fy, bottom = (height - cy) / fy + 0.15 * height / fy;
  let through = 1, depth = 0;
  for (let i = order.length - 1; i >= 0 && through > 1e-4; i--) {
    const k = order[i], a = means[3 * k], b = means[3 * k + 1], c = means[3 * k + 2];
    const pz = R[6] * a + R[7] * b + R[8] * c + shift[2];
    if (!(pz > NEAR)) continue;
    const sx = (R[0] * a + R[1] * b + R[2] * c + shift[0]) / pz, sy = (R[3] * a + R[4] * b + R[5] * c + shift[1]) / pz;
    const dx = x - fx * sx - cx, dy = y - fy * sy - cy;
    const hx = Math.min(Math.max(sx, left), right), hy = Math.min(Math.max(sy, top), bottom);
    const far = EXTENT * (Math.max(fx, fy) * reach[k] / pz * Math.sqrt(1 + hx * hx + hy * hy) + 0.55);
    if (dx * dx + dy * dy > far * far) continue;
    const f = fx / pz, g = fy / pz, u = [0, 1, 2].map(j => f * (R[j] - hx * R[6 + j])), v = [0, 1, 2].map(j => g * (R[3 + j] - hy * R[6 + j]));
    const of = (p, q) => p[0] * (s[6 * k] * q[0] + s[6 * k + 1] * q[1] + s[6 * k + 2] * q[2])
      + p[1] * (s[6 * k + 1] * q[0] + s[6 * k + 3] * q[1] + s[6 * k + 4] * q[2])
      + p[2] * (s[6 * k + 2] * q[0] + s[6 * k + 4] * q[1] + s[6 * k + 5] * q[2]);
    const xx = of(u, u) + LOW_PASS, xy = of(u, v), yy = of(v, v) + LOW_PASS;
    const power = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy);
    const alpha = Math.min(opacities[k] * strength[k] * Math.exp(-0.5 * power), MOST);
    if (alpha < FAINTEST) continue;
    found.push([k, alpha * through]); depth += alpha * through * pz; through *= 1 - alpha;
  }
  return { found, covered: 1 - through, depth: depth / Math.max(1 - through, 1e-9) };
}

/** Depth of the surface that a pixel shows, by what `under` finds there: a Gaussian's where the ray passes it best, and of
 * these the part late in what the pixel is made of (chebsplat/rasterize/depths.py says why); nan where there is none. */
function surface({ means, covariances }, { found, covered }, { turn, eye, lens: [fx, fy, cx, cy] }, x, y) {
  const ray = back(turn, [(x - cx) / fx, (y - cy) / fy, 1]);
  let passed = 0, part = 0, inverse = 0;
  for (const [k, weight] of found) {
    const within = Math.min(passed + weight, LATE[1] * covered) - Math.max(passed, LATE[0] * covered);
    passed += weight;
    if (within <= 0) continue;
    const [a, b, c, d, e, f] = covariances.subarray(6 * k, 6 * k + 6), xy = c * e - b * f, xz = b * e - c * d, yz = b * c - a * e;
    const across = times([d * f - e * e, xy, xz, xy, a * f - c * c, yz, xz, yz, a * d - b * b], ray);
    const along = v => across[0] * v[0] + across[1] * v[1] + across[2] * v[2];
    const depth = along([0, 1, 2].map(i => means[3 * k + i] - eye[i])) / along(ray);
    if (depth > NEAR) { part += within; inverse += within / depth; }
  }
  return part / inverse;
}
