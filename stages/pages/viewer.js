const all = (where, what) => [...where.querySelectorAll(what)], viewer = document.querySelector(".viewer");
const modes = {{ modes|tojson }}; // [name, left, right]; a side is {caption, base, over}, the latter two naming pictures
const views = all(document, ".sheet > div").map(row => ({ row, name: row.dataset.name,
  src: Object.fromEntries(all(row, "img").map(image => [image.dataset.of, image.src])) }));
const fits = ([, ...sides]) => sides.every(s => [s.base, s.over].every(name => !name || name in view.src));
const photo = { caption: "photo", base: "truth" }, alone = ["", photo, photo]; // where nothing else is there
let view = views[0], mode = modes[0] ?? alone;
function show() {
  if (!fits(mode)) mode = modes.find(fits) ?? alone;
  for (const [where, chosen] of [["left", mode[1]], ["right", mode[2]]]) {
    const [base, over] = all(viewer, `.side.${where} img`);
    base.src = view.src[chosen.base]; base.alt = chosen.caption;
    over.hidden = !chosen.over; if (chosen.over) over.src = view.src[chosen.over];
    viewer.querySelector(`output.${where}`).textContent = chosen.caption;
  }
  viewer.querySelector(".which").textContent = `${view.name} (${views.indexOf(view) + 1} of ${views.length})`;
  buttons.forEach((button, k) => { button.setAttribute("aria-pressed", modes[k] == mode); button.disabled = !fits(modes[k]); });
}
function button(text, act) {
  const made = document.createElement("button");
  made.type = "button"; made.textContent = text; made.onclick = () => { act(); show(); };
  viewer.querySelector(".modes").append(made);
  return made;
}
const buttons = modes.map(m => button(m[0], () => mode = m));
if (views.length > 1) button("next view ›", () => view = views[(views.indexOf(view) + 1) % views.length]).className = "next";
views.forEach(v => v.row.onclick = () => { view = v; show(); viewer.scrollIntoView({ behavior: "smooth" }); });
viewer.querySelector(".stage input").oninput = event => viewer.querySelector(".stage").style.setProperty("--at", event.target.value + "%");
const strength = viewer.querySelector(".strength");
if (strength) strength.oninput = () => viewer.style.setProperty("--strength", strength.value);
viewer.hidden = false; show();
