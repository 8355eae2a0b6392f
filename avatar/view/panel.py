"""The viewer's panel: viser's controls, what they do, and which values a page may give them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from avatar.files.names import as_text
from avatar.view.messages import Value, one_of, pressed, switched, within
from avatar.view.view_renderer import Setting

if TYPE_CHECKING:
    from avatar.view.viewer import Viewer

CURVE_POINTS = 100  # means of as many parts of a training
PLOT_HEIGHT = 120  # pixels
LINEAR, LOG = 1, 3  # "distr" of uPlot
LINE = "#228be6"
LABELS = {
    "jaw": "jaw open",
    "look_left": "look to its left",
    "turn": "torso: turn to its right",
    "lean": "torso: lean back",
}


class Panel:
    """A page can set what `_input` and `_button` have made, and to nothing but what their checks return."""

    def __init__(self, viewer: Viewer, gui: Any, live_name: str | None, calibrate: Callable[[], None] | None) -> None:
        self._viewer, self._gui = viewer, gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()  # beside the picture, which it would cover
        self._status = gui.add_markdown("")
        # A field shows plain text, whatever a stranger has sent; Markdown would be read for HTML and for files to show.
        self._live = (
            None if live_name is None else gui.add_text(live_name.capitalize(), "", multiline=True, disabled=True)
        )
        self._plots: list[Any] = []
        self._add_motion(calibrate)
        self._add_picture()
        self._add_face()

    def show_status(self, lines: list[str], live: str) -> None:
        """What the panel says: `lines` are Markdown of this program's own, `live` is of anybody."""
        self._status.content = "\n\n".join(lines)
        if self._live is not None:
            self._live.value = as_text(live)
        player = self._viewer.player
        self._play.label = "Pause" if player.is_playing else "Play"
        if player.is_playing:
            self._show_time()

    def _show_time(self) -> None:
        self._scrub.value = round(self._viewer.player.seconds, 2)

    def draw_curves(self, curves: Float64[np.ndarray, "N 6"], is_open: bool) -> None:
        """Loss and PSNR of the training, of `read_curves`; `is_open` unfolds them where they are new."""
        if len(curves) == 0:
            return
        means = np.array([part.mean(axis=0) for part in np.array_split(curves, min(len(curves), CURVE_POINTS))])
        steps, psnr, loss = np.ascontiguousarray(means.T[:3])
        if not self._plots:
            with self._gui.add_folder("Training", order=self._status.order + 0.5, expand_by_default=is_open):
                self._plots = [self._plot("Loss", LOG), self._plot("PSNR, dB", LINEAR)]
        for plot, column in zip(self._plots, (loss, psnr), strict=True):
            plot.data = (steps, column)

    def _plot(self, title: str, scale: int) -> Any:
        return self._gui.add_uplot(
            (np.zeros(1), np.ones(1)),
            ({"label": "step"}, {"label": title, "stroke": LINE, "width": 1.5}),
            title=title,
            scales={"x": {"time": False}, "y": {"distr": scale}},
            axes=({"size": 28}, {"size": 50}),
            padding=(12, 24, 0, 0),
            legend={"show": False},
            height=PLOT_HEIGHT,
        )

    def _safe(self, act: Callable[[Any], object]) -> Callable[[Any], None]:
        """An error belongs to who pressed the control."""

        def safely(event: Any) -> None:
            try:
                act(event)
            except Exception as error:
                self._viewer.complaints.add(f"a control failed ({type(error).__name__})")

        return safely

    def _input(self, handle: Any, check: Callable[[Value], Value], act: Callable[[Any], object]) -> Any:
        self._viewer.messages.allow(handle, check)
        handle.on_update(self._safe(act))
        return handle

    def _button(self, label: str, act: Callable[[Any], object]) -> Any:
        button = self._gui.add_button(label)
        self._viewer.messages.allow(button, pressed)
        button.on_click(self._safe(act))
        return button

    def _add_motion(self, calibrate: Callable[[], None] | None) -> None:
        gui, viewer, player = self._gui, self._viewer, self._viewer.player

        def choose(_: Any) -> None:
            with viewer.lock:
                player.choose(motion.value)
            limit()
            viewer.touch()

        def limit() -> None:
            self._scrub.value, self._scrub.visible = 0.0, player.clip is not None
            self._scrub.max = max(round(player.duration, 2), 0.01)
            viewer.messages.allow(self._scrub, within(0.0, self._scrub.max))

        def toggle(event: Any) -> None:
            if player.clip is None:
                event.client.add_notification("Nothing plays", "Choose a motion first.")
                return
            with viewer.lock:
                (player.pause if player.is_playing else player.play)()
                self._show_time()
            viewer.touch()

        def seek(event: Any) -> None:
            if event.client is not None:  # a person, not the player
                with viewer.lock:
                    player.seek(self._scrub.value)
                viewer.touch()

        with gui.add_folder("Motion"):
            motion = gui.add_dropdown("Motion", player.names, initial_value=player.name)
            self._input(motion, one_of(player.names), choose)
            self._play = self._button("Play", toggle)
            scrub = gui.add_slider("Time, s", min=0.0, max=0.01, step=0.01, initial_value=0.0)
            self._scrub = self._input(scrub, within(0.0, 0.0), seek)
            limit()
            if calibrate is not None:
                self._button("Take this face as neutral", lambda _: calibrate())

    def _add_picture(self) -> None:
        gui, viewer, renderer = self._gui, self._viewer, self._viewer.renderer
        with gui.add_folder("Picture"):
            if renderer.truth is not None:
                beside = gui.add_checkbox("Truth beside", initial_value=False)
                self._input(beside, switched, lambda _: viewer.change(with_truth=beside.value))
            overlay = gui.add_dropdown("Overlay", renderer.overlays, initial_value="none")
            self._input(overlay, one_of(renderer.overlays), lambda _: viewer.change(overlay=overlay.value))
            self._button("Save picture", viewer.save_picture)
            self._button("Save video", viewer.save_video)

    def _add_face(self) -> None:
        renderer, sliders = self._viewer.renderer, []
        moving = {n: control for n, control in enumerate(renderer.controls) if control.low < control.high}
        parts = list(dict.fromkeys(control.part for control in moving.values()))
        for part in parts:
            with self._gui.add_folder(part, expand_by_default=part == parts[0]):
                for number, control in moving.items():
                    if control.part == part:
                        sliders.append(self._slider(control.name, (control.low, control.high), "expressions", number))
        if renderer.joints:
            with self._gui.add_folder("Joints"):
                for name, limits in renderer.joints.items():
                    sliders.append(self._slider(LABELS.get(name, name.replace("_", " ")), limits, "joints", name))

        def reset(_: Any) -> None:
            for slider in sliders:
                slider.value = 0.0
            self._viewer.change(expressions={}, joints={})

        self._button("Reset face", reset)

    def _slider(self, label: str, limits: tuple[float, float], part: str, key: int | str) -> Any:
        """In percent of the farthest that training shows."""
        farthest = max(-limits[0], limits[1])
        low, high = (float(round(100 * limit / farthest)) for limit in limits)
        slider = self._gui.add_slider(label, min=low, max=high, step=1.0, initial_value=0.0)

        def moved(_: Any) -> None:
            with self._viewer.lock:
                values = getattr(self._viewer.setting, part)
                self._viewer.change(**{part: {**values, key: float(slider.value) / 100 * farthest}})

        return self._input(slider, within(low, high), moved)


def notes(setting: Setting, has_truth: bool, is_recorded: bool) -> list[str]:
    """Why the picture is without what was asked for."""
    if not (setting.with_truth or setting.overlay == "error") or not has_truth or is_recorded:
        return []
    return ["**No truth to show: choose a motion of the training video.**"]
