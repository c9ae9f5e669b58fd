"""The control panel of the web viewer: choices, buttons and plots."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite import suite
from trl_suite import terrain as terrains
from trl_suite.rendering.web_server import load_viser
from trl_suite.viewing.session import PUSHES, Loaded, Session

if TYPE_CHECKING:
    from trl_suite.viewing.browser import Browser

SPEEDS = {'1/8': 0.125, '1/4': 0.25, '1/2': 0.5, '1': 1.0, '2': 2.0, '4': 4.0}
PUSH = (0.1, 5.0, 1.0)  # m/s; minimum, maximum, initial value
SLIDER_STEPS = 100
COLOURS = (  # of lines, those of matplotlib
    '#1f77b4', '#ff7f0e', '#2ca02c', '#d62728', '#9467bd', '#8c564b', '#e377c2', '#7f7f7f', '#bcbd22',
    '#17becf',
)  # fmt: skip
PLOT_HEIGHT = 180  # pixels
LEGEND = 8  # largest number of lines of a plot with a legend
NOTICE = 8.0  # s; how long a message stays


class Panel:
    """The controls of a viewer, built once; `show` adapts them to an environment."""

    def __init__(self, server: Any, viewer: Browser) -> None:
        self._server, self._viewer = server, viewer
        gui = server.gui
        gui.set_panel_label('trl_suite')
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._status = gui.add_html('')
        self._filling = False  # whether the viewer, not a user, is changing values
        self._fitted: list[Any] = []  # controls that are replaced for each environment
        tabs = gui.add_tab_group()
        with tabs.add_tab('Run'):
            self._add_run()
        with tabs.add_tab('Show'):
            self._add_show()
        self._terrain_tab = tabs.add_tab('Terrain')
        with tabs.add_tab('Plots'):
            self._rewards, self._torques = map(self._add_plot, ('rewards', 'joint torques (N m)'))

    def _add_run(self) -> None:
        gui, viewer = self._server.gui, self._viewer
        self._environment = gui.add_dropdown('Environment', suite.ALL_IDS)
        self._when_chosen(self._environment, viewer.choose_environment)
        self._policy = gui.add_dropdown('Policy', ['zero'])
        self._when_chosen(self._policy, viewer.choose_policy)
        upload = gui.add_upload_button('Policy from a file', mime_type='.npz')
        upload.on_upload(self._uploaded)
        seed = gui.add_number('Seed', initial_value=viewer.seed, min=0, max=2**32 - 1, step=1)
        gui.add_button('First episode of this seed').on_click(
            lambda _: viewer.reset(int(seed.value))
        )
        gui.add_button('Next episode').on_click(lambda _: viewer.reset())
        self._play = gui.add_button('Pause')
        self._play.on_click(lambda _: viewer.play(not viewer.playing))
        gui.add_button('One frame').on_click(lambda _: viewer.step())
        speed = gui.add_button_group('Speed', tuple(SPEEDS))
        speed.on_click(lambda event: setattr(viewer, 'speed', SPEEDS[event.target.value]))
        with gui.add_folder('Push'):
            least, most, first = PUSH
            strength = gui.add_slider('m/s', min=least, max=most, step=0.1, initial_value=first)
            pushes = gui.add_button_group('to', tuple(PUSHES))
            pushes.on_click(lambda event: viewer.push(event.target.value, strength.value))

    def _add_show(self) -> None:
        gui, viewer = self._server.gui, self._viewer
        follow = gui.add_checkbox('follow the character', initial_value=True)
        follow.on_update(lambda event: viewer.follow(event.target.value))
        for name, shown in viewer.shown.items():
            box = gui.add_checkbox(name, initial_value=shown)
            box.on_update(lambda event, name=name: viewer.show(name, event.target.value))

    def _uploaded(self, event: Any) -> None:
        file = event.target.value
        self._viewer.upload_policy(file.name, file.content)

    def _when_chosen(self, handle: Any, choose: Any) -> None:
        def chosen(event: Any) -> None:
            if not self._filling:
                choose(event.target.value)

        handle.on_update(chosen)

    def show(self, loaded: Loaded, session: Session) -> None:
        """Adapts the controls to an environment, its policies and its terrain."""
        self._filling = True
        self._environment.value = loaded.spec.id
        self._policy.options, self._policy.value = tuple(loaded.policies), loaded.policy
        self._filling = False
        for handle in self._fitted:
            handle.remove()
        self._fitted = []
        with self._terrain_tab:
            self._add_terrain(loaded.environment.task.arena.terrain)
        self._name(self._rewards, session.reward_names)
        self._name(self._torques, session.joint_axes)

    def _add_terrain(self, terrain: terrains.Terrain) -> None:
        """Adds a choice of presets, and a slider for each parameter of the terrain."""
        gui, viewer = self._server.gui, self._viewer
        presets = tuple(terrains.PRESETS3D if terrain.spatial else terrains.PRESETS)
        name = terrain.name if terrain.name in presets else ''
        choices = presets if name else ('', *presets)
        preset = gui.add_dropdown('Preset', choices, initial_value=name)
        preset.on_update(lambda event: viewer.choose_terrain(event.target.value))
        sliders = {}
        for key, value in terrain.parameters().items():
            low, high = slider_range(terrain.generator.parameters[key], value)
            step = 10.0 ** np.floor(np.log10((high - low) / SLIDER_STEPS))
            sliders[key] = gui.add_slider(key, min=low, max=high, step=step, initial_value=value)
        self._fitted += [preset, *sliders.values()]
        if not sliders:
            return
        apply = gui.add_button('Use this terrain')
        apply.on_click(
            lambda _: viewer.choose_terrain(
                {'Type': terrain.type, 'Params': [{key: s.value for key, s in sliders.items()}]}
            )
        )
        self._fitted.append(apply)

    def _add_plot(self, title: str) -> Any:
        uplot = load_viser().uplot
        return self._server.gui.add_uplot(
            (np.zeros(1), np.zeros(1)),
            (uplot.Series(), uplot.Series()),
            title=title,
            height=PLOT_HEIGHT,
            scales={'x': uplot.Scale(time=False)},
        )

    def _name(self, plot: Any, names: tuple[str, ...]) -> None:
        """Changes the lines of a plot. A new plot would receive the data sent to the old one."""
        uplot = load_viser().uplot
        lines = [
            uplot.Series(label=name, stroke=COLOURS[i % len(COLOURS)], width=1)
            for i, name in enumerate(names)
        ]
        with self._server.atomic():
            plot.series = (uplot.Series(label='time (s)'), *lines)
            plot.data = tuple(np.zeros((len(names) + 1, 1)))
            plot.legend = uplot.Legend(show=len(names) <= LEGEND)

    def plot(self, session: Session) -> None:
        """Updates the plots."""
        if not session.history:
            return
        moments = list(session.history)
        times = np.array([moment.time for moment in moments])
        rewards = np.array([moment.rewards for moment in moments])
        torques = np.array([moment.torques for moment in moments])
        self._rewards.data = (times, *rewards.T)
        self._torques.data = (times, *torques.T)

    def report(self, status: dict[str, str], playing: bool) -> None:
        """Shows the status of the episode."""
        cells = ' &middot; '.join(
            f'{name} <b>{html.escape(value)}</b>' for name, value in status.items()
        )
        self._status.content = f'<div style="padding: 0.5em 1em; font-size: 0.85em">{cells}</div>'
        self._play.label = 'Pause' if playing else 'Play'

    def tell(self, message: str, title: str = 'Error', color: str = 'red') -> None:
        """Shows a message in all browsers."""
        for client in self._server.get_clients().values():
            client.add_notification(title, message, color=color, auto_close_seconds=NOTICE)

    def notice(self, message: str) -> None:
        """Shows what the viewer waits for."""
        self.tell(message, 'Please wait', 'blue')


def slider_range(parameter: terrains.Parameter, value: float) -> tuple[float, float]:
    """Returns the range of the slider of a terrain parameter: 0 to twice its value, within limits."""
    _, low, high, _ = parameter
    reach = 2 * abs(value) or 1.0
    return float(max(low, -reach if value < 0 or low < 0 else 0.0)), float(min(high, reach))
