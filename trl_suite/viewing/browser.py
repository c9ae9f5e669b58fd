"""A viewer in the web browser, on any environment: `trl-suite view ID --browser`.

    from trl_suite.viewing import browser

    viewer = browser.Browser('PD_Dog2D_Gaps_Terrain-v0').start()
    viewer  # displayed by a notebook; elsewhere, open viewer.url
    viewer.stop()

Several browsers can connect to one viewer at the same time. By default it accepts connections only
from this machine; over SSH, forward its port: `ssh -L 8080:127.0.0.1:8080 HOST`. Its address ends with a
token, without which it answers nobody: neither other users of the machine nor other web pages.
"""

from __future__ import annotations

import functools
import pathlib
import queue
import secrets
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import mujoco

from trl_suite import policies, suite
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.environments import named_policies
from trl_suite.environments.arguments import check_seed
from trl_suite.environments.environment import Environment
from trl_suite.registry.catalogue import spec_of
from trl_suite.registry.spec import EnvSpec
from trl_suite.rendering import Policy, overlays, web_scene, web_server
from trl_suite.util import notices, program
from trl_suite.viewing import panel
from trl_suite.viewing.session import Loaded, Session

HOST, PORT = '127.0.0.1', 8080
EVERY = '0.0.0.0'  # all addresses of this machine
IDLE = 0.01  # s; longest wait before requests are handled
LEAST_SPEED = 1e-3  # of the simulation, relative to real time
PLOT_INTERVAL = 0.25  # s
PLAN, CLIP, SAMPLES = 'plan and goal', 'reference clip', 'observed terrain'
DECORATION = {  # visual elements drawn by MuJoCo
    'contacts': mujoco.mjtVisFlag.mjVIS_CONTACTPOINT,
    'contact forces': mujoco.mjtVisFlag.mjVIS_CONTACTFORCE,
    'joint axes': mujoco.mjtVisFlag.mjVIS_JOINT,
    'centres of mass': mujoco.mjtVisFlag.mjVIS_COM,
}


def _request(method: Callable[..., None]) -> Callable[..., None]:
    """Makes a method run in the thread that runs the simulation, between two frames."""

    @functools.wraps(method)
    def ask(self: Browser, *arguments: Any, **options: Any) -> None:
        self._requests.put(functools.partial(method, self, *arguments, **options))

    return ask


class Browser:
    """A viewer for web browsers. Its methods may be called from any thread.

    Attributes:
      url: address of the page, on this machine.
      other_url: its address on other machines, if they can connect; else ''.
      session: the environment and the current policy.
      playing: whether the simulation runs, or is paused.
      speed: simulated time per time; 1 is real time.
      shown: whether each overlay is shown, by name.
    """

    session: Session

    def __init__(
        self,
        spec: str | EnvSpec,
        policy: str = 'best',
        seed: int = 0,
        host: str = HOST,
        port: int = PORT,
        task_kwargs: Mapping[str, Any] | None = None,
        opened: Callable[[Browser], object] = lambda viewer: None,
    ) -> None:
        """Opens the viewer; the simulation runs in `run` or after `start`.

        The page can be opened while the environment is loaded and compiled, and says so.

        Args:
          spec: an id, an alias, or a result of `suite.combine`.
          policy: 'best', one of `named_policies.POLICIES`, or an .npz file.
          seed: seed of the environment, and of random actions.
          host: address to listen on; '0.0.0.0' accepts connections from every machine of the
            network.
          port: the first port to try, then the following ones.
          task_kwargs: options of the task, also of environments that are chosen later.
          opened: called when the addresses are known, before the environment is loaded.

        Raises:
          TypeError: the seed is no integer.
          ValueError: an unknown id, policy, option or port, a seed out of range, or a policy that does
            not fit.
          FileNotFoundError: there is no such file.
          ImportError: the extra 'viewer' is not installed.
          OSError: this machine cannot listen on the address.
        """
        check_seed('seed', seed)
        if 'random' in (task_kwargs or {}):
            raise ValueError("task_kwargs has 'random'; use the argument `seed` instead")
        web_server.load_viser()
        self.playing, self.speed, self.seed = True, 1.0, seed
        self._task_kwargs = {**(task_kwargs or {}), 'random': seed}
        self.shown = {PLAN: True, CLIP: False, SAMPLES: False, **dict.fromkeys(DECORATION, False)}
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._files: dict[str, policies.Policy] = {}  # what .npz files held, by name
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        self._begun = False
        spec = spec_of(spec)
        if policy.endswith('.npz'):
            self._files[policy] = policies.load(policy)
        elif policy != 'best':
            named_policies.check(policy)
        token = secrets.token_hex(16)
        self._server = web_server.start_server(host, port, token, self._tell)
        place = f'{self._server.get_port()}/{token}'
        self.url = f'http://{HOST if host == EVERY else host}:{place}'
        self.other_url = f'http://{socket.gethostname()}:{place}' if host == EVERY else ''
        notices.listeners.append(self._loading)
        try:
            self._panel = panel.Panel(self._server, self)
            self._loading(spec.id)
            opened(self)
            self._show(self._load(spec, policy))
        except BaseException:  # an interrupt, too; else the server would run on
            web_server.stop_server(self._server)
            raise
        finally:
            notices.listeners.remove(self._loading)

    def run(self) -> None:
        """Runs the simulation until `stop` or an interrupt, which is raised; closes the viewer."""
        due, plotted, self._begun = 0.0, 0.0, True
        notices.listeners.append(self._panel.notice)
        try:
            while not self._stopped.is_set():
                self._serve()
                now = time.perf_counter()
                if not self.playing or now < due:
                    time.sleep(IDLE if not self.playing else min(due - now, IDLE))
                    continue
                try:
                    passed = self.session.advance() or CONTROL_TIMESTEP
                    self._draw()
                except Exception as error:  # such as an uploaded policy whose numbers overflow
                    self.playing = False
                    self._panel.tell(program.in_one_line(error))
                    self._panel.report(self.session.status(), self.playing)
                    continue
                # If frames take longer to compute than they last, playback slows down; no frame is
                # skipped.
                due = max(now, due) + passed / max(self.speed, LEAST_SPEED)
                if now - plotted > PLOT_INTERVAL:
                    plotted = now
                    self._panel.plot(self.session)
        finally:
            notices.listeners.remove(self._panel.notice)
            web_server.stop_server(self._server)

    def start(self) -> Browser:
        """Runs the simulation in a separate thread, if it does not run yet, and returns the viewer."""
        if self._thread is not None:
            return self
        self._thread = threading.Thread(target=self.run, daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Ends `run`, or the thread that `start` has started."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
        elif not self._begun:
            web_server.stop_server(self._server)

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="600" style="border: none"></iframe>'

    @_request
    def play(self, playing: bool) -> None:
        """Runs or pauses the simulation."""
        self.playing = playing
        self._panel.report(self.session.status(), playing)

    @_request
    def step(self) -> None:
        """Pauses the simulation, and advances it by one frame."""
        self.playing = False
        self.session.advance()
        self._redraw()

    @_request
    def reset(self, seed: int | None = None) -> None:
        """Starts the next episode, or the first episode of a seed."""
        if seed is not None:
            check_seed('seed', seed)
            self.seed = seed
            self.session.policy = self._acting(self._loaded)
        self.session.reset(seed)
        self._redraw()

    @_request
    def push(self, direction: str, speed: float) -> None:
        """Pushes the character; see `Session.push`."""
        self.session.push(direction, speed)

    @_request
    def show(self, name: str, shown: bool) -> None:
        """Shows or hides an overlay, one of `shown`."""
        self.shown[name] = shown
        self._draw()

    @_request
    def follow(self, followed: bool) -> None:
        """Centres the view on the character, or leaves it to the users."""
        self._scene.follow = followed
        self._draw()
        clients = self._server.get_clients().values()
        for camera in (self._server.initial_camera, *(client.camera for client in clients)):
            self._scene.look_at_character(camera)

    @_request
    def choose_environment(self, spec: str | EnvSpec) -> None:
        """Shows another environment, with its best policy."""
        self._loading(str(spec))
        self._show(self._load(spec, 'best'))

    @_request
    def choose_terrain(self, terrain: str | Mapping[str, Any]) -> None:
        """Puts the character on another terrain, an argument of `terrain.load`."""
        spec, _, _, policy = self._loaded
        self._show(self._load(spec.with_terrain(terrain), policy))

    @_request
    def choose_policy(self, name: str) -> None:
        """Switches to another policy, and starts at the first episode of the seed.

        An .npz file is read once; `upload_policy` replaces what it held.
        """
        spec, environment, choices, _ = self._loaded
        if name not in choices:
            choices[name] = self._policy(name, environment, spec)
        self._show(Loaded(spec, environment, choices, name))

    @_request
    def upload_policy(self, name: str, content: bytes) -> None:
        """Switches to a policy from the content of an .npz file, in place of one of that name."""
        if not name.endswith('.npz'):
            raise ValueError(f'{name}: expected a policy, .npz')
        with tempfile.TemporaryDirectory(prefix='trl_suite_') as folder:
            path = pathlib.Path(folder, 'policy.npz')  # the name may be any text
            path.write_bytes(content)
            try:
                policy = policies.load(path)
            except ValueError as error:
                raise ValueError(str(error).replace(str(path), name)) from None
        spec, environment, choices, _ = self._loaded
        policy.check(environment)
        self._files[name] = policy
        choices[name] = self._policy(name, environment, spec)
        self._show(Loaded(spec, environment, choices, name))

    @_request
    def _tell(self, sentence: str) -> None:
        self._panel.tell(sentence)

    # Implementation.

    def _serve(self) -> None:
        while not self._requests.empty():
            try:
                self._requests.get()()
            except Exception as error:  # whatever is asked, the viewer goes on
                self._panel.tell(program.in_one_line(error))
                self._panel.show(self._loaded, self.session)  # what was chosen is not shown
                self._panel.report(self.session.status(), self.playing)

    def _loading(self, text: str) -> None:
        self._panel.report({'loading': text}, self.playing)

    def _load(self, spec: str | EnvSpec, policy: str) -> Loaded:
        spec = spec_of(spec)
        environment = suite.build_environment(spec, self._task_kwargs, {})
        choices = named_policies.available(environment, spec.id, self.seed)
        if policy == 'best':
            policy = next(iter(choices))
        elif policy not in choices:
            choices[policy] = self._policy(policy, environment, spec)
            choices[policy](environment.reset())  # raises here what its first action would
        return Loaded(spec, environment, choices, policy)

    def _policy(self, name: str, environment: Environment, spec: EnvSpec) -> Policy:
        if not name.endswith('.npz'):
            return named_policies.policy(name, environment, spec.id, self.seed)
        if name not in self._files:
            self._files[name] = policies.load(name)
        policy = self._files[name]
        policy.check(environment)
        return lambda time_step: policy(time_step.observation)

    def _acting(self, loaded: Loaded) -> Policy:
        """Makes the chosen policy anew, so that random actions begin again with the seed."""
        return self._policy(loaded.policy, loaded.environment, loaded.spec)

    def _show(self, loaded: Loaded) -> None:
        acting = self._acting(loaded)
        self._loaded = loaded
        self.session = Session(loaded.environment, acting, self.seed)
        before = getattr(self, '_scene', None)
        self._scene = web_scene.WebScene(self._server, loaded.environment)
        if before is not None:
            self._scene.follow = before.follow
        self._panel.show(loaded, self.session)
        self._redraw()

    def _draw(self) -> None:
        task: Any = self.session.environment.task
        drawn, samples = [], None
        if self.shown[PLAN]:
            drawn.append(overlays.markers(task))
        if self.shown[CLIP] and overlays.has_ghost(task):
            drawn.append(overlays.ghost(task))
        if self.shown[SAMPLES] and overlays.observes_terrain(task):
            samples = overlays.terrain_samples(task, self.session.environment.physics)
        for name, flag in DECORATION.items():
            self._scene.option.flags[flag] = self.shown[name]
        self._scene.update(drawn, samples, jump=self.session.time_step.first())
        self._panel.report(self.session.status(), self.playing)

    def _redraw(self) -> None:
        self._draw()
        self._panel.plot(self.session)
