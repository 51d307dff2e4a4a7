"""What a real browser makes of a page: errors, requests, width, what is cut off or scrolls
sideways, and what its slider shows in every mode.
"""

import json
import shutil
import subprocess

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
WATCH = """<script>
const problems = []; onerror = (...all) => problems.push(String(all));
addEventListener("load", () => {
  const seen = image => getComputedStyle(image).display != "none";
  const stage = () => [...document.querySelectorAll(".stage img")].filter(seen);
  const modes = [...document.querySelectorAll(".modes button:not(.next)")].reverse();
  const layers = Object.fromEntries(
    modes.map(button => (button.click(), [button.textContent, stage().length])));
  document.querySelectorAll(".modes button").forEach(button => button.click());
  document.querySelectorAll("details").forEach(part => part.open = true);
  const called = part =>
    `${part.tagName}.${part.className}: ${part.textContent.trim().slice(0, 60)}`;
  const cut = [...document.querySelectorAll("main, main *:not(svg *)")].filter(part => {
    const box = part.getBoundingClientRect();
    const scrolls = getComputedStyle(part).overflowX != "visible"
      && part.scrollWidth > part.clientWidth + 1;
    return box.width && (scrolls || box.right > innerWidth + 1 || box.left < -1);
  }).map(called);
  parent.postMessage({ wide: document.documentElement.scrollWidth, problems, layers, cut,
    shown: stage().map(image => image.naturalWidth) }, "*");
});</script>"""
FRAME = """<body><pre></pre><script>
addEventListener("message", event =>
  document.querySelector("pre").textContent = JSON.stringify(event.data));
</script><iframe src="page.html" style="border: 0; width: WIDEpx; height: 900px"></iframe></body>"""


def browsed(folder, text, wide):
    """What a browser makes of a page in a frame `wide` pixels across: (its report, console lines,
    its requests).
    """
    (folder / "page.html").write_text(text.replace("<head>", "<head>" + WATCH))
    (folder / "frame.html").write_text(FRAME.replace("WIDE", str(wide)))
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        "--dump-dom",
    ]
    command += [
        f"--user-data-dir={folder}/profile",
        f"--log-net-log={folder}/net.json",
        "--window-size=1500,1000",
    ]
    command += ["--virtual-time-budget=5000", "--host-resolver-rules=MAP * ~NOTFOUND"]
    done = subprocess.run(
        [*command, (folder / "frame.html").as_uri()], capture_output=True, text=True, timeout=120
    )
    seen = json.loads(done.stdout.split("<pre>")[1].split("</pre>")[0])
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    # the browser's own requests have another site
    log = (folder / "net.json").read_text().splitlines()
    return seen, console, [line for line in log if "site=file://" in line and '"url":"http' in line]
