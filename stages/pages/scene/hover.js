// The label under the pointer, from the picture whose load runs this: label + 1 in red and green, probability in blue.
(image => {
  const names = JSON.parse(image.dataset.names), still = image.dataset.still === "1";
  let held = window.chebsplatHover;
  if (!held) {
    const tip = document.createElement("div");
    tip.id = "chebsplat-tip";
    tip.style.cssText = "position:fixed;z-index:9;pointer-events:none;padding:2px 7px;border-radius:4px;" +
      "font:13px system-ui,sans-serif;background:#111d;color:#fff;display:none";
    document.body.append(tip);
    held = window.chebsplatHover = { tip, codes: null, at: null };
    held.show = () => {
      const { codes, at } = held, target = at && document.elementFromPoint(at.x, at.y);
      tip.style.display = "none";
      tip.textContent = "";
      if (!codes || !target || target.tagName !== "CANVAS") return;
      const box = target.getBoundingClientRect();
      const x = Math.floor((at.x - box.left) / box.width * codes.width);
      const y = Math.floor((at.y - box.top) / box.height * codes.height);
      const [low, high, share] = codes.data.subarray(4 * (y * codes.width + x));
      const label = low + 256 * high - 1;
      if (label < 0) return;
      tip.textContent = `${held.names[label]} ${Math.round(share / 2.55)} %`;
      tip.style.left = `${at.x + 14}px`;
      tip.style.top = `${at.y + 14}px`;
      tip.style.display = "block";
    };
    // window's: what a handler in an attribute calls is otherwise the image's own
    window.addEventListener("pointermove", event => {
      held.at = { x: event.clientX, y: event.clientY };
      held.show();
    }, true);
  }
  held.names = names;
  held.codes = null;
  if (still) {
    const canvas = document.createElement("canvas");
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
    const drawing = canvas.getContext("2d", { willReadFrequently: true });
    drawing.drawImage(image, 0, 0);
    held.codes = drawing.getImageData(0, 0, canvas.width, canvas.height);
  }
  held.show();
})(this)
