const get = id => document.getElementById(id), canvas = get("scene"), tip = get("tip");
const about = JSON.parse(get("about").textContent), semantic = !!about.labels;
const TEMPERATURE = 0.1, DIMMED = 0.06, FRAME = 1000 / 24, SMALLEST = 0.25; // of cosines; of what is not brought out; ms; of the pixels a side
let splats, drawing, sorter, order = new Uint32Array(0), strength, features, views, lists; // lists: Gaussians by label
let camera, moving = 0, scale = 1, dirty = true, frames = 0, asked = null, mode = "color", picked = -1;
let path = []; // cameras that are kept for a file
let flight = null, points = [], placing = false; // { from, to, began, eye }; labelled points { at, word }; whether clicks add some
const hidden = new Set(), held = new Set(), pointers = new Map();

// -- cameras of the page, of the capture's lenses
function lens(view, width, height) { // the capture's picture in the middle, as high as the page: no black above it
  const [fx, fy, cx, cy] = views.subarray(16 * view + 12, 16 * view + 16), by = height / about.height;
  return [fx * by, fy * by, width / 2 + (cx - about.width / 2) * by, height / 2 + (cy - about.height / 2) * by];
}
function seen({ turn, eye, view }, width = canvas.width, height = canvas.height) {
  return { turn, eye, shift: times(turn, eye).map(x => -x), lens: lens(view, width, height), size: [width, height] };
}
function sortable({ turn, shift, lens: [fx, fy, cx, cy], size: [width, height] }) {
  return { turn, shift, slopes: [Math.max(cx, width - cx) / fx, Math.max(cy, height - cy) / fy] };
}
const shown = (of = camera) => seen(of, canvas.clientWidth, canvas.clientHeight); // pointers count in the page's own pixels
function at_view(view) {
  const pose = views.subarray(16 * view, 16 * view + 12), turn = [0, 1, 2, 4, 5, 6, 8, 9, 10].map(i => pose[i]);
  return { turn, eye: back(turn, [3, 7, 11].map(i => -pose[i])), view, pivot: about.extent / 3 };
}

// -- what the Gaussians show
const channel = hex => [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16) / 255);
function retint() {
  const { n, colors } = splats, tints = new Float32Array(4 * n), palette = semantic ? about.labels.map(label => channel(label.color)) : [];
  const of = semantic ? splats.labels : null, warm = about.warm ?? [[0, 0, 0]];
  const force = palette.map((_, label) => hidden.has(label) ? 0 : picked >= 0 && picked != label ? DIMMED : 1);
  for (let k = 0; k < n; k++) {
    const label = of ? of[k] - 1 : -1, grey = (colors[3 * k] + colors[3 * k + 1] + colors[3 * k + 2]) / 3;
    const heat = mode == "relevancy" && asked ? Math.min(Math.max(2 * asked.scores[k] - 1, 0), 1) : 0;
    const over = heat > 0 ? 0.5 + 0.4 * heat : 0, hot = warm[Math.round(heat * (warm.length - 1))];
    for (let c = 0; c < 3; c++) tints[4 * k + c] = mode == "color" ? colors[3 * k + c]
      : mode == "labels" ? (label < 0 ? 0.25 : 0.8 * palette[label][c]) + 0.2 * grey
      : (1 - over) * 0.8 * grey + over * (0.7 + 0.3 * grey) * hot[c];
    strength[k] = tints[4 * k + 3] = force[label] ?? (picked >= 0 ? DIMMED : 1);
  }
  drawing.tint(tints); dirty = true;
  if (semantic) get("nothing").hidden = strength.some(value => value > 0);
}
function unhide() { hidden.clear(); picked = -1; legend(); retint(); }
function show(next) {
  if (next == "relevancy" && !asked) { get("word").focus(); get("answer").textContent = "Type a word first."; return; }
  mode = next;
  for (const button of document.querySelectorAll("[data-mode]")) button.setAttribute("aria-pressed", button.dataset.mode == mode);
  get("scale").hidden = mode != "relevancy"; retint();
}
function pick(label) {
  picked = label == picked ? -1 : label; if (picked >= 0) hidden.delete(picked);
  legend(); retint();
}
function legend() {
  for (const item of get("legend").children) {
    const label = +item.dataset.label;
    item.querySelector("button").setAttribute("aria-pressed", label == picked); item.querySelector("input").checked = !hidden.has(label);
  }
}

// -- words: probabilities, as chebsplat/labels/calibration.py computes them, LERF's relevancy, as chebsplat/labels/calibration.py
// does, for words without a calibration, and labels, as chebsplat/labels/decode.py
function unit_features(arrays) {
  const { n } = splats, C = about.ranges.features.step.length, rows = new Float32Array(n * C), lengths = new Float32Array(n);
  const { features: dictionary, meanings } = arrays, R = dictionary.length / C; // each Gaussian says which row it means
  for (let k = 0; k < n; k++) for (let c = 0; c < C; c++) rows[k * C + c] = dictionary[c * R + meanings[k]] * about.ranges.features.step[c];
  for (let k = 0; k < n; k++) {
    let sum = 0; for (let i = k * C; i < (k + 1) * C; i++) sum += rows[i] * rows[i];
    lengths[k] = Math.sqrt(sum); for (let i = k * C; i < (k + 1) * C; i++) rows[i] /= Math.max(lengths[k], 1e-6);
  }
  return { C, rows, lengths };
}
function dots(rows, C, vector) {
  const found = new Float32Array(rows.length / C);
  for (let k = 0, i = 0; k < found.length; k++) { let sum = 0; for (let c = 0; c < C; c++) sum += rows[i++] * vector[c]; found[k] = sum; }
  return found;
}
const embedding = word => Float32Array.from({ length: features.C }, (_, c) => lists.words[word * features.C + c] * about.word_step[c]);
/** Of unit rows [n, C]: the largest inner product with one of the vectors, the second largest, and whose the largest is. */
function strongest(rows, vectors) {
  const { C } = features, n = rows.length / C, best = new Float32Array(n).fill(-Infinity), second = best.slice(), whose = new Int32Array(n);
  for (let phrase = 0; phrase * C < vectors.length; phrase++) {
    const found = dots(rows, C, vectors.subarray(phrase * C, (phrase + 1) * C));
    for (let k = 0; k < n; k++) if (found[k] > best[k]) { second[k] = best[k]; best[k] = found[k]; whose[k] = phrase; }
      else if (found[k] > second[k]) second[k] = found[k];
  }
  return { best, second, whose };
}
/** What unit rows are weighed against: phrases and, where there is a calibration, rivals. */
const weighed = rows => ({ against: strongest(rows, lists.against), rivals: about.calibration && strongest(rows, lists.rivals) });
/** Margin of a word over the strongest phrase (where words are labels: over the strongest other one), in [0, 1]. */
function relevancy(rows, lengths, word, { best, second, whose }) {
  const apart = !about.against;
  return dots(rows, features.C, embedding(word)).map((value, k) => {
    const phrase = apart && whose[k] == word ? second[k] : best[k];
    return lengths[k] > 0 ? 1 / (1 + Math.exp((phrase - value) / TEMPERATURE)) : 0;
  });
}
const calibrated = word => !!about.calibration && !about.uncalibrated.includes(word);
const logistic = odds => 1 / (1 + Math.exp(-odds));
/** How likely each of unit rows is what a word means: by how far it is behind the best rival, and its cosine. */
function probability(rows, lengths, word, { best }) {
  const { margin, cosine, bias } = about.calibration;
  return dots(rows, features.C, embedding(word)).map((value, k) =>
    lengths[k] > 0 ? logistic(margin * (value - best[k]) + cosine * value + bias) : 0);
}
/** How likely the scene has what was asked for: by the likeliest thousandth of its Gaussians, five at least. */
function presence(scores) {
  const count = Math.min(Math.max(Math.floor(scores.length / 1000), 5), scores.length), sure = p => Math.min(Math.max(p, 1e-6), 1 - 1e-6);
  const odds = scores.slice().sort().slice(-count).reduce((sum, p) => sum + Math.log(sure(p) / (1 - sure(p))), 0) / count;
  return logistic(about.calibration.strength * odds + about.calibration.offset);
}
/** Scores of unit rows for a word: probabilities, or relevancy where no calibration speaks for it. */
const scored = (rows, lengths, word, of) => calibrated(word) ? probability(rows, lengths, word, of.rivals) : relevancy(rows, lengths, word, of.against);
function ask(text) {
  const folded = text.toLowerCase().replace(/[_-]/g, " ").trim().split(/\s+/).join(" "), word = about.words.findIndex(known => known.toLowerCase() == folded);
  if (word < 0) {
    const near = about.words.filter(known => folded.length > 1 && (known.includes(folded) || folded.includes(known))).slice(0, 5);
    get("answer").textContent = `This page has no "${text}"${near.length ? `; near: ${near.join(", ")}` : ""}.`;
    asked = null; if (mode == "relevancy") show("color"); return null; // no heat of the word before
  }
  const began = performance.now(), scores = scored(features.rows, features.lengths, word, features), most = scores.reduce((a, b) => Math.max(a, b), 0);
  const chosen = [...scores.keys()].filter(k => scores[k] > 0.5);
  asked = { text, word, scores }; tip.hidden = true; show("relevancy");
  if (chosen.filter(k => strength[k] < 1).length > chosen.length / 2) unhide();
  const there = calibrated(word) ? presence(scores) : null, above = chosen.length, ms = performance.now() - began;
  const many = `${above.toLocaleString("en")} Gaussian${above == 1 ? "" : "s"}`, name = about.words[word];
  get("answer").textContent = there === null ? `${name}: ${many} above 0.5, the highest ${most.toFixed(2)}; not calibrated (${Math.round(ms)} ms)`
    : there > 0.5 ? `${name}: ${many} likelier than not (${Math.round(ms)} ms)` : `${name}: probably not here (${Math.round(100 * there)} %); ${many} likelier than not`;
  if (above && (there === null || there > 0.5)) show_where(chosen);
  return { above, ms, presence: there };
}

// -- where an answer is: the camera flies there, unless it sees it already
const SAMPLES = 200, TRIED = 12, FLIGHT = 700; // Gaussians that stand for an answer; views that are tried; ms
/** share: of points, those in the middle of what a camera sees; free: of some of these, those that nothing hides. */
function sees(of, points) {
  const what = shown(of), { turn, shift, lens: [fx, fy, cx, cy], size: [width, height] } = what;
  const inside = points.map(p => plus(times(turn, p), shift)).map(([x, y, z]) => [fx * x / z + cx, fy * y / z + cy, z])
    .filter(([x, y, z]) => z > NEAR && Math.abs(x / width - 0.5) < 0.35 && Math.abs(y / height - 0.5) < 0.35);
  const order = sorted(splats.means, splats.reach, sortable(what)), some = inside.filter((_, k) => k % Math.ceil(inside.length / 9) == 0);
  const free = some.filter(([x, y, z]) => {
    const { covered, depth } = under(splats, order, what, x, y, strength);
    return covered < 0.5 || depth > 0.8 * z;
  });
  return { share: inside.length / points.length, free: free.length / Math.max(some.length, 1) };
}
/** Fly to where a view of the capture saw these Gaussians, nearer to them: the densest crowd of them in the middle. */
function show_where(chosen) {
  const every = Math.ceil(chosen.length / SAMPLES);
  const some = chosen.filter((_, k) => k % every == 0).map(k => [...splats.means.subarray(3 * k, 3 * k + 3)]);
  const now = sees(camera, some);
  if (now.share > 0.1 && now.free > 0.3) return;
  const { middle, radius } = crowd(some, about.extent / 5), near = Math.max(3 * radius, about.extent / 20);
  const rank = ({ turn, eye }) => times(turn, plus(middle, eye, -1))[2] / apart(middle, eye) - apart(middle, eye) / about.extent;
  const at = about.views.map((_, view) => at_view(view)).sort((a, b) => rank(b) - rank(a)).slice(0, TRIED);
  const from = at.find(view => sees(facing(view, view.eye, middle, about.up), [middle]).free > 0) ?? at[0];
  const eye = plus(middle, plus(from.eye, middle, -1), Math.min(near / apart(from.eye, middle), 1));
  flight = { from: { ...camera }, to: facing(from, eye, middle, about.up), began: performance.now(), eye: camera.eye };
  get("view").value = from.view; dirty = true;
}
/** The camera's place in its flight, which ends when someone else moves it. */
function fly_on(now) {
  if (!flight || camera.eye !== flight.eye) { flight = null; return; }
  const t = matchMedia("(prefers-reduced-motion: reduce)").matches ? 1 : Math.min(Math.max(now - flight.began, 0) / FLIGHT, 1);
  const { from, to } = flight;
  camera = t < 1 ? between(from, to, t * t * (3 - 2 * t), about.up) : { ...to };
  flight = t < 1 ? { ...flight, eye: camera.eye } : null; moved();
}

// -- labelled points
function place(x, y) { // a point on the surface that a pixel shows
  const word = get("name").value.trim(), hit = under(splats, order, shown(), x, y, strength);
  if (!word) get("name").focus();
  if (!word || hit.covered < 0.5) { get("placed").textContent = word ? "There is no surface." : "Type a word first."; return; }
  label_points([...points, { at: ahead(x, y, surface(splats, hit, shown(), x, y)), word }]);
}
function label_points(next) {
  points = next; dirty = true;
  get("placed").textContent = `${points.length} point${points.length == 1 ? "" : "s"}`;
  for (const id of ["undo", "csv"]) get(id).disabled = !points.length;
  get("points").replaceChildren(...points.map(({ word }) => Object.assign(document.createElement("li"), { textContent: word })));
  get("marks").replaceChildren(...points.map(() => document.createElement("i")));
}
function move_marks() {
  const { turn, shift, lens: [fx, fy, cx, cy] } = shown();
  [...get("marks").children].forEach((mark, k) => {
    const [x, y, z] = plus(times(turn, points[k].at), shift);
    mark.hidden = !(z > NEAR); mark.style.translate = `${fx * x / z + cx}px ${fy * y / z + cy}px`;
  });
}
/** Label, its share and, where a word was asked, relevancy, of the features that a pixel shows; null where nothing is. */
function meaning(x, y) {
  const hit = under(splats, order, shown(), x, y, strength);
  if (!semantic || hit.covered < 0.5) return { hit };
  const { C, rows, lengths } = features, mean = new Float32Array(C);
  for (const [k, weight] of hit.found) for (let c = 0; c < C; c++) mean[c] += weight * lengths[k] * rows[k * C + c];
  const length = Math.hypot(...mean), direction = mean.map(value => value / Math.max(length, 1e-6));
  const cosines = dots(lists.label_embeddings, C, direction), label = cosines.indexOf(cosines.reduce((a, b) => Math.max(a, b)));
  const share = 1 / cosines.reduce((sum, value) => sum + Math.exp((value - cosines[label]) / TEMPERATURE), 0);
  return { hit, label, share, relevant: mode == "relevancy" ? scored(direction, [length], asked.word, weighed(direction))[0] : null };
}

// -- the loop: pictures are drawn when something changed, smaller while that is slow, whole again at rest
let last = 0, slow = FRAME, drawn = false, wanted = "", second = [0, 0, ""]; // of the count: when it began, frames then, what it said
function frame(now) {
  requestAnimationFrame(frame);
  const passed = now - last; last = now;
  fly(Math.min(passed, 100) / 1000); fly_on(now);
  const busy = now - moving < 250;
  if (busy && drawn) { // of a frame that drew, not of the first after rest
    slow += 0.3 * (Math.min(passed, 10 * FRAME) - slow);
    if (slow > 1.2 * FRAME) { scale = Math.max(scale * Math.max(Math.sqrt(FRAME / slow), 0.6), SMALLEST); slow = FRAME; }
    else if (slow < 0.6 * FRAME) { scale = Math.min(scale * 1.1, 1); slow = FRAME; }
  }
  drawn = busy;
  const by = (busy ? scale : 1) * Math.min(devicePixelRatio, 2), width = Math.max(Math.round(canvas.clientWidth * by), 1);
  const height = Math.max(Math.round(canvas.clientHeight * by), 1);
  if (canvas.width != width || canvas.height != height) { canvas.width = width; canvas.height = height; dirty = true; }
  if (dirty) {
    const what = seen(camera), text = JSON.stringify([what.turn, what.shift, canvas.clientWidth, canvas.clientHeight]);
    if (text != wanted) { wanted = text; sorter.ask(sortable(what)); }
    drawing.draw(what, mode == "color" && !!splats.sh1);
    if (semantic) move_marks();
    dirty = false; frames++;
  }
  if (now - second[0] > 1000) second = [now, frames, `${Math.round(1000 * (frames - second[1]) / (now - second[0]))} frames/s`];
  get("status").textContent = !busy ? "" : scale < 0.99 ? `${second[2]}, ${Math.round(100 * scale)} % of the pixels a side while moving` : second[2];
}
function moved() { dirty = true; moving = performance.now(); tip.hidden = true; }
function fly(seconds) {
  const key = name => held.has(name) ? 1 : 0, by = seconds * about.extent * (key("shift") ? 0.6 : 0.2);
  const step = [key("d") - key("a"), key("q") - key("e"), key("w") - key("s")];
  const yaw = key("arrowright") - key("arrowleft"), pitch = key("arrowup") - key("arrowdown");
  if (!step.some(Boolean) && !yaw && !pitch) return;
  camera.eye = plus(camera.eye, back(camera.turn, step), by);
  turned(seconds * yaw, seconds * pitch, camera.eye); moved();
}
/** Turn about a point: yaw about the capture's up, pitch about the picture's x axis. */
function turned(yaw, pitch, pivot) {
  const from = times(camera.turn, plus(camera.eye, pivot, -1));
  camera.turn = unrounded(product(about_axis([1, 0, 0], -pitch), product(camera.turn, about_axis(about.up, yaw))));
  camera.eye = plus(back(camera.turn, from), pivot);
}
function ahead(x, y, depth) { // the point at a depth behind a pixel
  const { lens: [fx, fy, cx, cy] } = shown();
  return plus(back(camera.turn, [(x - cx) / fx * depth, (y - cy) / fy * depth, depth]), camera.eye);
}
const pixel = event => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
function jump(view) {
  const n = about.views.length; view = (view + n) % n;
  camera = at_view(view); get("view").value = view; moved();
}

// -- pointers: one orbits, two shift and zoom
let grip = null, travelled = 0;
function grasp() {
  const all = [...pointers.values()], middle = [0, 1].map(i => all.reduce((sum, p) => sum + p[i], 0) / all.length);
  const spread = all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0;
  return { middle, spread };
}
function drag(now, shifting) {
  const [dx, dy] = [0, 1].map(i => now.middle[i] - grip.middle[i]);
  if (shifting) {
    const { lens: [fx, fy] } = shown(), d = camera.pivot;
    camera.eye = plus(camera.eye, back(camera.turn, [-dx * d / fx, -dy * d / fy, 0]));
  } else turned(dx * Math.PI / canvas.clientWidth, -dy * Math.PI / canvas.clientWidth, grip.pivot);
  if (now.spread && grip.spread) closer(now.spread / grip.spread, ...now.middle);
  Object.assign(grip, now); moved();
}
function closer(by, x, y) { // come as much closer to what lies behind a pixel
  const target = ahead(x, y, camera.pivot), keep = 1 / by;
  camera.eye = plus(plus(camera.eye, target, -1).map(value => value * keep), target); camera.pivot = Math.max(camera.pivot * keep, about.extent / 500); moved();
}
function aim(x, y) { // orbit and zoom about what lies under a pixel
  const { covered, depth } = under(splats, order, shown(), x, y, strength);
  if (covered > 0.5) camera.pivot = depth;
  return ahead(x, y, camera.pivot);
}
function listen() {
  canvas.onpointerdown = event => {
    canvas.setPointerCapture(event.pointerId); pointers.set(event.pointerId, pixel(event)); canvas.focus({ preventScroll: true });
    grip = grasp(); grip.pivot = aim(...grip.middle); travelled = 0; tip.hidden = true;
  };
  canvas.onpointermove = event => {
    if (!pointers.has(event.pointerId)) { if (event.pointerType == "mouse") hover(event); return; }
    const before = pointers.get(event.pointerId), at = pixel(event);
    travelled += Math.hypot(at[0] - before[0], at[1] - before[1]);
    pointers.set(event.pointerId, at); drag(grasp(), pointers.size > 1 || event.shiftKey || event.buttons & 6);
  };
  canvas.onpointerup = canvas.onpointercancel = event => {
    if (!pointers.delete(event.pointerId)) return;
    if (pointers.size) { grip = grasp(); grip.pivot = aim(...grip.middle); return; }
    if (travelled > 4 || event.type == "pointercancel") return;
    if (placing) { place(...pixel(event)); return; }
    hover(event); if (semantic && event.pointerType == "mouse" && event.button == 0) { const { label } = meaning(...pixel(event)); if (label !== undefined) pick(label); }
  };
  canvas.onpointerleave = () => { tip.hidden = true; };
  canvas.oncontextmenu = event => event.preventDefault();
  canvas.addEventListener("wheel", event => {
    event.preventDefault(); const at = pixel(event); aim(...at); closer(Math.exp(-Math.max(-200, Math.min(200, event.deltaY * (event.deltaMode ? 30 : 1))) / 500), ...at);
  }, { passive: false });
  addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input:not([type=checkbox]), select")) return;
    const key = event.key.toLowerCase();
    if (["w", "a", "s", "d", "q", "e", "shift"].includes(key) || key.startsWith("arrow")) { held.add(key); if (key.startsWith("arrow")) event.preventDefault(); }
    else if (key == "n") jump(camera.view + 1); else if (key == "p") jump(camera.view - 1); else if (key == "escape" && picked >= 0) pick(picked);
  });
  addEventListener("keyup", event => held.delete(event.key.toLowerCase())); addEventListener("blur", () => held.clear());
  addEventListener("resize", () => { dirty = true; });
  get("before").onclick = () => jump(camera.view - 1); get("after").onclick = () => jump(camera.view + 1);
  get("view").onchange = event => jump(+event.target.value);
  get("save").onclick = () => {
    drawing.draw(seen(camera), mode == "color" && !!splats.sh1);
    canvas.toBlob(blob => offer(blob, `${about.name}.png`));
  };
  get("link").onclick = () => {
    location.hash = link_of(camera, about);
    get("kept").textContent = "The address of this page now leads here.";
  };
  get("keep").onclick = () => keep([...path, { ...camera }]); get("forget").onclick = () => keep([]);
  get("write").onclick = () => {
    const text = JSON.stringify(file_of(path, about, views), null, 1);
    offer(new Blob([text], { type: "application/json" }), `${about.name}.cameras.json`);
  };
  addEventListener("hashchange", restore);
  canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); trouble("The graphics context was lost; load the page again."); });
  if (!semantic) return;
  for (const button of document.querySelectorAll("[data-mode]")) button.onclick = () => show(button.dataset.mode);
  get("ask").onsubmit = event => { event.preventDefault(); if (get("word").value.trim()) ask(get("word").value); };
  get("word").oninput = event => { if (event.inputType == "insertReplacementText" || !event.inputType) ask(event.target.value); };
  for (const button of [get("all"), get("nothing").querySelector("button")]) button.onclick = unhide;
  get("place").onclick = () => { placing = !placing; get("place").setAttribute("aria-pressed", placing); };
  get("undo").onclick = () => label_points(points.slice(0, -1));
  get("csv").onclick = () => offer(new Blob([csv_of(points, about)], { type: "text/csv" }), `${about.name}.points.csv`);
}
let hovering = 0;
function hover(event) { // once a frame at most
  const at = pixel(event), { clientX, clientY } = event; cancelAnimationFrame(hovering);
  hovering = requestAnimationFrame(() => {
    const { label, share, relevant } = meaning(...at); tip.hidden = label === undefined; if (tip.hidden) return;
    const swatch = document.createElement("i"); swatch.style.background = about.labels[label].color;
    tip.replaceChildren(swatch, `${about.labels[label].name} ${Math.round(100 * share)} %${relevant === null ? "" : `, ${about.words[asked.word]} ${calibrated(asked.word) ? `${Math.round(100 * relevant)} %` : relevant.toFixed(2)}`}`);
    tip.style.left = `${Math.min(clientX, innerWidth - tip.offsetWidth - 20)}px`; tip.style.top = `${Math.min(clientY, innerHeight - tip.offsetHeight - 20)}px`;
  });
}
// -- a path of cameras, a link to one, files
function restore() { // the camera of the page's address, where that has one
  if (!location.hash.startsWith("#camera=")) return;
  const found = camera_of(location.hash, about);
  if (!found) { get("kept").textContent = "The address leads to no camera of this scene."; return; }
  camera = found; get("view").value = found.view; moved();
}
function keep(next) {
  path = next;
  for (const id of ["forget", "write"]) get(id).disabled = !path.length;
  get("kept").textContent = path.length == 1 ? "1 camera kept" : `${path.length} cameras kept`;
}
function offer(blob, name) { // for download
  const link = document.createElement("a"); link.href = URL.createObjectURL(blob); link.download = name;
  link.click(); URL.revokeObjectURL(link.href);
}
function trouble(text) { get("trouble").textContent = text; get("trouble").hidden = false; }

function furnish() { // what the panel lists
  if (innerWidth < 700) get("panel").open = false;
  get("view").append(...about.views.map((name, k) => new Option(name, k)));
  if (!semantic) return;
  get("words").append(...about.words.map(word => new Option(word)));
  get("scale").querySelector("i").style.background = `linear-gradient(90deg, ${about.warm.map(color => `rgb(${color.map(v => Math.round(255 * v))})`)})`;
  const counts = about.labels.map(() => 0); for (const label of splats.labels) if (label) counts[label - 1]++;
  const labels = counts.map((count, label) => ({ count, label })).filter(({ count }) => count).sort((a, b) => b.count - a.count);
  get("legend").append(...labels.map(({ count, label }) => {
    const { name, color } = about.labels[label], item = document.createElement("li"), box = document.createElement("input"), button = document.createElement("button");
    item.dataset.label = label; box.type = "checkbox"; box.checked = true; box.ariaLabel = `show ${name}`;
    box.onchange = () => { if (box.checked) hidden.delete(label); else hidden.add(label); if (picked == label) picked = -1; legend(); retint(); };
    button.type = "button"; button.setAttribute("aria-pressed", false); button.title = `bring out ${name}`; button.onclick = () => pick(label);
    for (const [tag, text] of [["i", ""], ["span", name], ["small", count.toLocaleString("en")]]) {
      const part = document.createElement(tag); part.textContent = text; if (tag == "i") part.style.background = color; button.append(part);
    }
    item.append(box, button); return item;
  }));
}
async function open() {
  const arrays = await unpacked(get("data").textContent, about.places); get("data").textContent = "";
  splats = decoded(arrays, about.ranges, about.center); views = arrays.views; lists = arrays; strength = new Float32Array(splats.n).fill(1);
  if (semantic) { splats.labels = arrays.labels; features = unit_features(arrays); Object.assign(features, weighed(features.rows)); }
  drawing = new Drawing(canvas, splats); camera = at_view(0);
  sorter = new Sorter(splats, found => { order = found; drawing.order(order); dirty = true; });
  order = sorted(splats.means, splats.reach, sortable(seen(camera))); drawing.order(order);
  furnish(); listen(); retint(); restore(); requestAnimationFrame(now => { last = now; frame(now); });
}
/** For scripts and tests: `await scene.ready`, then the capture's views as pictures, words, and what a pixel means. */
const scene = {
  ready: open().catch(error => { trouble(`This page cannot show its scene: ${error.message}`); throw error; }),
  get frames() { return frames; },
  look: view => jump(view),
  ask, show, meaning,
  /** RGBA bytes of a view in the capture's own pixels. */
  picture(view) {
    const what = seen(at_view(view), canvas.width = about.width, canvas.height = about.height);
    drawing.order(sorted(splats.means, splats.reach, sortable(what))); drawing.draw(what, mode == "color" && !!splats.sh1);
    const pixels = drawing.pixels(); drawing.order(order); dirty = true;
    return pixels;
  },
};
