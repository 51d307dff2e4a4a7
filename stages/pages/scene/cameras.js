// Vectors and cameras; cameras as links and as the file that `chebsplat render --path` reads, points as the one that
// `chebsplat teach --points` does.
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
const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
const apart = (a, b) => Math.hypot(...plus(a, b, -1));

/** A camera as another, but at an eye and looking at a point, upright where they are not one above the other. */
function facing(camera, eye, target, up) {
  const pivot = apart(target, eye), ahead = plus(target, eye, -1).map(x => x / pivot), across = cross(ahead, up);
  const right = Math.hypot(...across) > 1e-3 ? across : camera.turn.slice(0, 3);
  return { ...camera, eye, pivot, turn: unrounded([...right, ...cross(ahead, right), ...ahead]) };
}
/** The camera a share t of the way from one to another: straight on, and about one axis; halfway round, about `up`. */
function between(from, to, t, up) {
  const m = product([0, 3, 6, 1, 4, 7, 2, 5, 8].map(i => from.turn[i]), to.turn);
  const axis = [m[7] - m[5], m[2] - m[6], m[3] - m[1]], sine = Math.hypot(...axis);
  const angle = Math.atan2(sine, m[0] + m[4] + m[8] - 1), by = about_axis(sine > 1e-6 ? axis.map(x => x / sine) : up, t * angle);
  return { ...to, eye: plus(from.eye, plus(to.eye, from.eye, -1), t), turn: unrounded(product(from.turn, by)) };
}
/** The middle and the radius of the densest crowd of points, which are within `reach` of one of them. */
function crowd(points, reach) {
  const crowds = points.map(p => points.filter(q => apart(p, q) < reach));
  const densest = crowds.reduce((best, some) => some.length > best.length ? some : best);
  const middle = [0, 1, 2].map(i => densest.reduce((sum, p) => sum + p[i], 0) / densest.length);
  return { middle, radius: Math.max(...densest.map(p => apart(p, middle))) };
}

/** Labelled points { at, word } as CSV, in the scene's frame. */
function csv_of(points, about) {
  const rows = points.map(({ at, word }) => [...plus(at, about.center), `"${word.replaceAll('"', '""')}"`].join());
  return `${["x,y,z,word", ...rows].join("\n")}\n`;
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
