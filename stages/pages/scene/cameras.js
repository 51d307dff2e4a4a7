// Vectors and cameras, and cameras as links and as the file that `chebsplat render --path` reads.
// A camera is { turn: rows of the rotation from world to camera, eye, view: whose lens it has,
// pivot: how far ahead lies what it turns about }, in the page's frame, which is the scene's moved by `center`.
const times = (m, v) => [0, 3, 6].map(r => m[r] * v[0] + m[r + 1] * v[1] + m[r + 2] * v[2]);
const back = (m, v) => [0, 1, 2].map(c => m[c] * v[0] + m[c + 3] * v[1] + m[c + 6] * v[2]);
const product = (a, b) => [0, 3, 6].flatMap(r => [0, 1, 2].map(c => a[r] * b[c] + a[r + 1] * b[c + 3] + a[r + 2] * b[c + 6]));
const plus = (a, b, by = 1) => a.map((value, i) => value + by * b[i]);
function about_axis([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), t = 1 - c;
  return [t * x * x + c, t * x * y - s * z, t * x * z + s * y, t * x * y + s * z, t * y * y + c, t * y * z - s * x,
    t * x * z - s * y, t * y * z + s * x, t * z * z + c];
}
function unrounded(m) { // rows unit and square again after many turns
  const unit = v => v.map(x => x / Math.hypot(...v)), z = unit(m.slice(6)), along = m[0] * z[0] + m[1] * z[1] + m[2] * z[2];
  const x = unit([m[0] - along * z[0], m[1] - along * z[1], m[2] - along * z[2]]);
  return [...x, z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0], ...z];
}

/** A camera as the end of a link, in the scene's frame: view, pivot, eye, turn. */
function link_of({ view, pivot, eye, turn }, about) {
  const numbers = [pivot, ...plus(eye, about.center), ...turn].map(x => +x.toPrecision(7));
  return `#camera=${[view, ...numbers].join()}`;
}
/** The camera of such an end; null where it tells none of this page's. */
function camera_of(hash, about) {
  const [view, pivot, ...rest] = hash.replace("#camera=", "").split(",").map(Number);
  const eye = plus(rest.slice(0, 3), about.center, -1), turn = unrounded(rest.slice(3));
  const told = about.views[view] !== undefined && pivot > 0 && rest.length == 12;
  return told && [pivot, ...eye, ...turn].every(Number.isFinite) ? { view, pivot, eye, turn } : null;
}
/** Cameras as 3DGS' cameras.json, in the frame of the scene's source and the capture's pixels. views: f32 [V, 16]. */
function file_of(path, about, views) {
  return path.map(({ turn, eye, view }, id) => {
    const [fx, fy, cx, cy] = views.subarray(16 * view + 12, 16 * view + 16);
    const rotation = [0, 1, 2].map(c => [0, 3, 6].map(r => turn[r + c]));
    const size = { width: about.width, height: about.height }, position = plus(about.origin, plus(eye, about.center), about.scale);
    return { id, img_name: `key_${id + 1}`, ...size, position, rotation, fy, fx, cx, cy };
  });
}
