"""view: a scene live in a browser. A viser page whose pictures are rendered here, by the renderer that is measured.

One thread renders for all pages; a page's callbacks only say what it wants.
"""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chebsplat.errors import ChebsplatError, ConfigError
from chebsplat.stages.opened import Camera, OpenedScene
from chebsplat.stages.viewing import Shown, Viewing, coded, padded

if TYPE_CHECKING:
    from chebsplat.stages.view_panel import Panel

log = logging.getLogger("chebsplat")

INSTALL = ".venv/bin/pip install -e '.[view]'"
REST = 0.3  # seconds without a movement, after which a picture is drawn whole
ARRIVAL = 0.7  # seconds in which a page's camera comes to the view that it is sent to
FULL = 1280 * 960  # pixels at most, at rest
MOVING = 640 * 480  # pixels while moving, at first
LEAST = 160 * 120
FRAME = 1 / 12  # seconds that a picture may take while moving


def library() -> Any:
    """viser. Raises ConfigError with the command that installs it."""
    try:
        import viser
    except ImportError:
        raise ConfigError(
            f"the viewer needs the extra `view`: {INSTALL}; or `chebsplat page`, which needs none"
        ) from None
    return viser


def photos_of(capture: Path) -> Callable[[str], np.ndarray | None]:
    """The photo u8 [H, W, 3] of each view of a `capture` artifact by name; None of a view that it has not."""
    from chebsplat.formats.capture import read_capture

    held = read_capture(capture)
    row = {name: k for k, name in enumerate(held.names)}
    return lambda name: np.asarray(held.images[row[name]]) if name in row else None


class Visit:
    """One page that is open: where its camera is, what its controls say, and what it has been sent."""

    def __init__(self, client: Any, viewing: Viewing, wake: Callable[[], None]):
        self.client, self.viewing, self.wake = client, viewing, wake
        self.shown = Shown()
        self.at: Camera | None = None  # the capture's view that the camera stands at
        self.jumped = self.moved = -np.inf
        self.asked, self.drawn = 1, 0  # numbers of the state: what is wanted, and what the last picture shows
        self.whole = self.named = False  # whether that picture is in full, and the labels under it were sent
        self.budget, self.pace = float(MOVING), 0.0
        self.tasks: list[Callable[[], None]] = []
        self.panel: Panel | None = None

    def change(self, **controls: Any) -> None:
        """Other controls; labels stay where they are if only what is shown of the same Gaussians changes."""
        self.shown = replace(self.shown, **controls)
        self.named = self.named and set(controls) <= {"mode", "query", "selected"}
        self.asked += 1
        self.wake()

    def move(self) -> None:
        """The page's camera is elsewhere."""
        now = time.monotonic()
        if self.at is not None and now - self.jumped > ARRIVAL and not near(self.camera(), self.at, self.viewing.far):
            self.at = None
        self.moved, self.named = now, False
        self.asked += 1
        self.wake()

    def jump(self, camera: Camera) -> None:
        """Bring the page's camera to a view of the capture."""
        page, pose = self.client.camera, camera.cam_from_world
        scale = min(page.image_width / camera.width, page.image_height / camera.height)
        self.at, self.jumped = camera, time.monotonic()
        with self.client.atomic():
            page.up_direction = -pose[1, :3]
            page.position = camera.position
            page.look_at = camera.position + 0.3 * self.viewing.far * pose[2, :3]
            page.fov = 2 * np.arctan(page.image_height / scale / 2 / camera.K[1, 1])
        self.move()

    def do(self, task: Callable[[], None]) -> None:
        """Have the drawing thread run this before the next picture."""
        self.tasks.append(task)
        self.wake()

    def camera(self) -> Camera:
        """The page's, in its own pixels."""
        import viser.transforms

        page = self.client.camera
        pose = np.eye(4)
        pose[:3, :3] = viser.transforms.SO3(page.wxyz).as_matrix().T
        pose[:3, 3] = -pose[:3, :3] @ page.position
        width, height = page.image_width, page.image_height
        f = height / 2 / np.tan(page.fov / 2)
        return Camera("page", np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]), pose, width, height)

    def looked(self, n_pixels: float) -> Camera:
        """The camera to draw from, in `n_pixels` at most: exactly the capture's where it stands at a view."""
        from chebsplat.stages.camera_paths import fitted

        camera = self.camera()
        scale = min(1.0, (n_pixels / (camera.width * camera.height)) ** 0.5)
        size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
        return camera.resized(*size) if self.at is None else fitted(self.at, size)

    def due(self, now: float) -> float | None:
        """Seconds until there is something to do; None: nothing is."""
        if self.tasks or self.asked != self.drawn:
            return 0.0
        if not self.whole or (not self.named and self.viewing.scene.labels is not None):
            return max(0.0, self.moved + REST - now)
        return None

    def work(self) -> None:
        """Do what is due first: a task, a picture, or the labels under it."""
        if self.tasks:
            task = self.tasks.pop(0)
            try:
                task()
            except ChebsplatError as error:
                self.say(str(error))
        elif self.asked != self.drawn or not self.whole:
            self.draw(moving=time.monotonic() - self.moved < REST)
        elif self.panel is not None:
            self.named = True
            self.panel.put_beneath(coded(self.viewing.beneath(self.looked(FULL), self.shown)))

    def draw(self, moving: bool) -> None:
        """Send a picture of what is wanted now."""
        wanted, start = self.asked, time.monotonic()
        camera = self.looked(self.budget if moving else FULL)
        image, note = self.picture(camera)
        taken = time.monotonic() - start
        self.client.scene.set_background_image(image, format="jpeg", jpeg_quality=75 if moving else 95)
        self.client.flush()
        if not self.named and self.panel is not None:
            self.panel.put_beneath(None)
        self.drawn, self.whole = wanted, not moving
        size = f"{image.shape[1]} × {image.shape[0]}"
        if moving:
            self.pace = taken if not self.pace else 0.7 * self.pace + 0.3 * taken
            self.budget = float(np.clip(self.budget * np.clip(FRAME / taken, 0.6, 1.2), LEAST, FULL))
            self.say(f"{size} while moving, {1 / self.pace:.0f} pictures a second{note}", often=False)
        else:
            self.say(f"{size} at rest{note}")

    def picture(self, camera: Camera) -> tuple[np.ndarray, str]:
        """The picture of the controls, and what is to be said of it."""
        at, shown = self.at, self.shown
        if shown.mode == "error" and at is not None:
            image = padded(self.viewing.picture(at, shown), camera.width / camera.height)
            return image, f"; {at.name}: {self.viewing.psnr(at, shown):.1f} dB"
        try:
            note = "" if at is None else f"; at {at.name}"
            return self.viewing.picture(camera, shown), note
        except ConfigError as error:
            return self.viewing.picture(camera, replace(shown, mode="color")), f"; in colour: {error}"

    def say(self, text: str, often: bool = True) -> None:
        """Show a line on the page."""
        if self.panel is not None:
            self.panel.say(text, often)


def near(camera: Camera, view: Camera, far: float) -> bool:
    """Whether a camera stands at a view: within a thousandth of `far` and half a degree of where it looks."""
    ahead = float(camera.cam_from_world[2, :3] @ view.cam_from_world[2, :3])
    return bool(np.linalg.norm(camera.position - view.position) < 1e-3 * far and ahead > np.cos(np.radians(0.5)))


class Viewer:
    """A server of pages, and the thread that draws for them.

    Served at once, so that a page loads while the scene does; `show` fills those that are open, and all later ones.
    """

    def __init__(self, name: str, host: str, port: int):
        viser = library()
        self.name, self.visits = name, dict[int, Visit]()
        self._woken, self._ended = threading.Event(), False
        self._thread = threading.Thread(target=self.draw, name="drawing", daemon=True)
        with redirect_stdout(io.StringIO()):  # its banner; the command prints the address alone
            self.server = viser.ViserServer(host=host, port=port, label=f"chebsplat: {name}", verbose=False)
        self.port = self.server.get_port()
        self.server.scene.configure_environment_map(None)  # light of meshes; there are none
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)

    def show(self, viewing: Viewing, frames: Path) -> None:
        """Show a scene. Args: frames: the folder that camera paths are written below."""
        self.viewing, self.frames = viewing, frames
        first = viewing.scene.cameras[0]
        camera, pose = self.server.initial_camera, first.cam_from_world
        self.server.scene.set_up_direction(tuple(upwards(viewing.scene)))
        camera.position, camera.look_at = first.position, first.position + 0.3 * viewing.far * pose[2, :3]
        camera.fov = 2 * np.arctan(first.height / 2 / first.K[1, 1])
        camera.near, camera.far = 1e-3 * viewing.far, 100 * viewing.far
        viewing.picture(first.resized(16, 12), Shown())  # what the first picture would wait for
        self.server.on_client_disconnect(lambda client: self.visits.pop(client.client_id, None) and None)
        self.server.on_client_connect(self.welcome)
        self._thread.start()

    def welcome(self, client: Any) -> None:
        """Give a page that was opened its controls."""
        from chebsplat.stages.view_panel import Panel

        visit = Visit(client, self.viewing, self._woken.set)
        visit.panel = Panel(visit, self.name, self.frames)
        client.camera.on_update(lambda _: visit.move())
        self.visits[client.client_id] = visit
        visit.move()

    def draw(self) -> None:
        """Until the end: what each page wants, page by page."""
        while True:
            self._woken.clear()  # before what is asked of it: nothing is missed
            if self._ended:
                return
            now, waits = time.monotonic(), []
            for visit in list(self.visits.values()):
                due = visit.due(now)
                if due == 0:
                    try:
                        visit.work()
                        waits.append(0.0)
                    except Exception as error:  # of one picture: said, and the others go on
                        log.exception("a picture failed")
                        visit.drawn, visit.whole, visit.named = visit.asked, True, True
                        visit.say(f"failed: {error}")
                elif due is not None:
                    waits.append(due)
            self._woken.wait(min(waits, default=None))

    def end(self) -> None:
        """Stop serving and drawing."""
        self._ended = True
        self._woken.set()
        if self._thread.is_alive():
            self._thread.join(10)
        self.server.stop()


def upwards(scene: OpenedScene) -> np.ndarray:
    """Up, unit [3]: that of the capture's views, as a page takes it."""
    from chebsplat.stages.page import up_and_extent

    up, _ = up_and_extent(scene.exported)
    return np.asarray(up / np.linalg.norm(up))
