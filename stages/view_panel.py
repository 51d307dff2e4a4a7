"""The controls of a viewer's page, in viser's widgets, and what each of them asks of its `Visit`."""

from __future__ import annotations

import base64
import html
import io
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from chebsplat.errors import ChebsplatError, DataFailure

if TYPE_CHECKING:
    from chebsplat.stages.opened import Camera
    from chebsplat.stages.view import Visit

HOVER = Path(__file__).parent / "pages/scene/hover.js"
TITLES = {"color": "colour", "density": "Gaussian density", "error": "error against the photo"}
NONE = "-"


class Panel:
    """Controls of one page; `frames`: the folder that camera paths are written below."""

    def __init__(self, visit: Visit, name: str, frames: Path):
        self.visit, self.name, self.frames = visit, name, frames
        self.gui, self.scene, self.viewing = visit.client.gui, visit.viewing.scene, visit.viewing
        self._said, self._named = 0.0, False
        self.path: list[Camera] = []
        self.status = self.gui.add_markdown("loading")
        self._modes()
        if self.scene.labels is not None:
            self._semantics()
        self._filters()
        self._views()
        self._output()

    def say(self, text: str, often: bool = True) -> None:
        """Show a line; one that is not to be shown `often` is left out within half a second of the last."""
        now = time.monotonic()
        if often or now - self._said > 0.5:
            self.status.content, self._said = text, now

    def put_beneath(self, codes: np.ndarray | None) -> None:
        """Give the page the labels under its picture, u8 [H, W, 3] of `viewing.coded`; None: they are out of date."""
        from chebsplat.stages.pages.pictures import png

        if self.scene.labels is None or (codes is None and not self._named):
            return
        self._named = codes is not None
        buffer = io.BytesIO()
        png(np.zeros((1, 1, 3), np.uint8) if codes is None else codes, buffer)
        names = html.escape(json.dumps(self.scene.label_names))
        script = html.escape(HOVER.read_text().split("\n", 1)[1])
        self.beneath.content = (
            f'<img style="display:none" data-still="{int(codes is not None)}" data-names="{names}" '
            f'src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}" onload="{script}">'
        )

    def _modes(self) -> None:
        titles = {TITLES.get(mode, mode): mode for mode in self.viewing.modes}
        self.mode = self.gui.add_dropdown("show", list(titles), initial_value=next(iter(titles)))
        self.mode.on_update(lambda _: self.visit.change(mode=titles[self.mode.value]))

    def _semantics(self) -> None:
        from chebsplat.stages.pages.pictures import palette

        self.beneath = self.gui.add_html("")
        with self.gui.add_form("ask for words") as form:
            self.words = self.gui.add_text("words", "")
            self.against = self.gui.add_text("against", "", hint="phrases with commas; empty: the usual ones")
            ask = self.gui.add_button("ask")
        ask.on_click(lambda _: form.submit())
        form.on_submit(lambda _: self.visit.do(self._ask))
        names, labels = self.scene.label_names or [], self.scene.labels
        assert labels is not None
        present = [int(k) for k in np.unique(labels) if k >= 0]
        with self.gui.add_folder("classes", expand_by_default=False):
            every = self.gui.add_button_group("", ("all", "none"))
            boxes = {}
            for k, color in zip(present, palette(len(names))[present], strict=True):
                swatch = f'<div style="height:4px;margin:2px 12px -4px;background:#{bytes(color).hex()}"></div>'
                self.gui.add_html(swatch)
                boxes[k] = self.gui.add_checkbox(names[k], initial_value=True)

        def hide(_: Any) -> None:
            self.visit.change(hidden=frozenset(k for k, box in boxes.items() if not box.value))

        def set_all(_: Any) -> None:
            for box in boxes.values():
                box.value = every.value == "all"

        for box in boxes.values():
            box.on_update(hide)
        every.on_click(set_all)
        with self.gui.add_folder("selection"):
            self.chosen = self.gui.add_markdown("click on something")
            self.gui.add_button("select what was asked for").on_click(lambda _: self.visit.do(self._take_asked))
            self.gui.add_button("clear").on_click(lambda _: self._choose(None, ""))
            self.gui.add_button("save as .ply").on_click(lambda _: self.visit.do(self._save))
        self.visit.client.scene.on_click()(lambda event: self.visit.do(lambda: self._click(*event.screen_pos)))

    def _ask(self) -> None:
        text = self.words.value.strip()
        if not text:
            self.chosen.content = "type some words first"
            return
        query = self.scene.understood(text, [word.strip() for word in self.against.value.split(",") if word.strip()])
        assert self.scene.features is not None
        self.visit.change(query=query, mode="relevancy")
        self.mode.value = "relevancy"
        self.chosen.content = str(query.answer(self.scene.features))

    def _take_asked(self) -> None:
        from chebsplat.stages.extract import asked_for

        query = self.visit.shown.query
        if query is None:
            self.chosen.content = "ask for some words first"
            return
        try:
            mask = asked_for(self.scene.exported, query)
        except DataFailure as error:
            self._choose(None, str(error))
        else:
            self._choose(mask, f"{query.text}: {int(mask.sum()):,} Gaussians, as `extract --query` takes them")

    def _click(self, u: float, v: float) -> None:
        camera = self.visit.looked(np.inf)
        x, y = (min(int(share * size), size - 1) for share, size in ((u, camera.width), (v, camera.height)))
        taken = self.viewing.touched(camera, self.visit.shown, x, y)
        if taken is None:
            self._choose(None, "nothing is there")
        else:
            name = (self.scene.label_names or [])[taken.label]
            place = ", ".join(f"{x:.3f}" for x in taken.place)
            self._choose(taken.mask, f"{name} at {place}: {int(taken.mask.sum()):,} connected Gaussians")

    def _choose(self, mask: np.ndarray | None, text: str) -> None:
        self.chosen.content = text or "click on something"
        self.visit.change(selected=mask)

    def _save(self) -> None:
        mask = self.visit.shown.selected
        if mask is None:
            self.chosen.content = "nothing is selected: click on something first"
            return
        with TemporaryDirectory() as folder:
            content = self.scene.select(mask).to_ply(Path(folder) / "selection.ply").read_bytes()
        self.visit.client.send_file_download("selection.ply", content, save_immediately=True)

    def _filters(self) -> None:
        means = self.scene.parameters["means"].astype(np.float64)
        low, high = np.quantile(means, (0.005, 0.995), axis=0)
        with self.gui.add_folder("what is drawn", expand_by_default=False):
            opacity = self.gui.add_slider("least opacity", min=0.0, max=1.0, step=0.01, initial_value=0.0)
            top = int(self.scene.parameters["degrees"].max())
            degree = self.gui.add_slider("SH degree", min=0, max=max(top, 1), step=1, initial_value=top)
            cropped = self.gui.add_checkbox("crop", initial_value=False)
            sides = [
                self.gui.add_multi_slider(
                    axis, min=float(a), max=float(b), step=max(float(b - a) / 200, 1e-6),
                    initial_value=(float(a), float(b)),
                )
                for axis, a, b in zip("xyz", low, np.maximum(high, low + 1e-3), strict=True)
            ]  # fmt: skip

        def crop(_: Any) -> None:
            ends = np.array([side.value for side in sides])
            self.visit.change(box=(*ends[:, 0].tolist(), *ends[:, 1].tolist()) if cropped.value else None)

        opacity.on_update(lambda _: self.visit.change(min_opacity=float(opacity.value)))
        degree.on_update(lambda _: self.visit.change(sh_degree=int(degree.value)))
        for control in (cropped, *sides):
            control.on_update(crop)

    def _views(self) -> None:
        views = {camera.name: camera for camera in self.scene.cameras}
        with self.gui.add_folder("views of the capture"):
            choice = self.gui.add_dropdown("jump to", [NONE, *views])
            shown = self.gui.add_checkbox("show them", initial_value=False)
        choice.on_update(lambda _: self.visit.jump(views[choice.value]) if choice.value in views else None)
        frusta: list[Any] = []

        def show(_: Any) -> None:
            if shown.value and not frusta:
                frusta.extend(self._frustum(k, camera) for k, camera in enumerate(self.scene.cameras))
            for frustum in frusta:
                frustum.visible = shown.value

        shown.on_update(show)

    def _frustum(self, k: int, camera: Camera) -> Any:
        import viser.transforms

        frustum = self.visit.client.scene.add_camera_frustum(
            f"/views/{k}", fov=float(2 * np.arctan(camera.height / 2 / camera.K[1, 1])),
            aspect=camera.width / camera.height, scale=0.02 * self.viewing.far, color=(255, 200, 60),
            thickness=1.0, thickness_units="screen",  # scene units may be anything
            wxyz=viser.transforms.SO3.from_matrix(camera.cam_from_world[:3, :3].T).wxyz, position=camera.position,
        )  # fmt: skip
        frustum.on_click(lambda _: self.visit.jump(camera))
        return frustum

    def _output(self) -> None:
        with self.gui.add_folder("take it with you", expand_by_default=False):
            self.gui.add_button("screenshot").on_click(lambda _: self.visit.do(self._screenshot))
            self.gui.add_button("add this camera to the path").on_click(lambda _: self._keep())
            self.gui.add_button("forget the path").on_click(lambda _: self._forget())
            self.n_frames = self.gui.add_number("frames", 60, min=2, max=10_000, step=1)
            self.gui.add_button("write the frames").on_click(lambda _: self.visit.do(self._write))
            self.kept = self.gui.add_markdown(f"frames go below {self.frames}")

    def _screenshot(self) -> None:
        from chebsplat.stages.pages.pictures import png
        from chebsplat.stages.view import FULL

        buffer = io.BytesIO()
        png(self.visit.picture(self.visit.looked(FULL))[0], buffer)
        self.visit.client.send_file_download(f"{self.name}.png", buffer.getvalue(), save_immediately=True)

    def _keep(self) -> None:
        from chebsplat.stages.view import FULL

        self.path.append(self.visit.looked(FULL))
        self.kept.content = f"{len(self.path)} cameras in the path"

    def _forget(self) -> None:
        self.path = []
        self.kept.content = "the path is empty"

    def _write(self) -> None:
        from chebsplat.stages.camera_paths import between
        from chebsplat.stages.frames import KINDS, Shot, render_frames
        from chebsplat.stages.progress import Progress

        shown = self.visit.shown
        kind = shown.mode if shown.mode in KINDS else "color"
        self.kept.content = "writing"
        try:
            cameras = between(self.path, int(self.n_frames.value))
            kept = np.zeros(len(self.scene), bool)
            kept[self.viewing.kept(shown)] = True
            part = self.scene if kept.all() else self.scene.select(kept)
            taken = {path.name for path in self.frames.iterdir()} if self.frames.is_dir() else set()
            out = self.frames / next(name for k in range(1, 10**6) if (name := f"path-{k:03d}") not in taken)
            shot = Shot((kind,), str(self.scene.source), shown.query if kind == "relevancy" else None)
            render_frames(part, cameras, shot, out, Progress())
        except ChebsplatError as error:
            self.kept.content = str(error)
        else:
            self.kept.content = f"{len(cameras)} frames of {kind} in {out / kind}"
