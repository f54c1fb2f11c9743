"""The lifecycle node: parameters when it is configured, a live run while it is active, services."""

from __future__ import annotations

import signal
import threading
import time
from array import array
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.task import Future
from std_srvs.srv import Trigger

from fgloc.config import role_names
from fgloc.errors import EstimatorError, FglocError
from fgloc.live import Live
from fgloc.live.process import EstimationProcess
from fgloc.live.wire.node import Node
from fgloc.sensors.maps import configured_map
from fgloc_ros.settings import PARAMETERS, Settings, settings
from fgloc_ros.transport import RosTransport

_AGAIN_S, _LONGEST_S = 1.0, 30.0  # pause after a run that failed; doubled each time up to this
_LASTED_S = 60.0  # a run that lasted so long starts the pauses anew
_SAVED = "state.json"
_POSE = "initial_pose"


_Transition: TypeAlias = Callable[["FglocNode", LifecycleState], TransitionCallbackReturn]


def _logged(transition: _Transition) -> _Transition:
    """The transition, and the reason in the log if it fails: rclpy does not tell it."""

    @wraps(transition)
    def run(node: FglocNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:
            node.get_logger().error(f"{transition.__name__}: {type(error).__name__}: {error}")
            raise

    return run


class FglocNode(LifecycleNode):
    """Localizes a robot while it is active.

    Services, all of std_srvs/Trigger: ``~/global_search``, ``~/save_state``, ``~/load_state``, ``~/reload_map``,
    ``~/reset``. A pose is given on ``initialpose``.
    """

    def __init__(self, **options: Any) -> None:
        """Declare parameters and services; ``options`` are those of `rclpy.node.Node`."""
        super().__init__("fgloc", **options)
        for name, (default, description) in PARAMETERS.items():
            is_pose = name == _POSE  # its numbers may be whole
            descriptor = ParameterDescriptor(description=description, dynamic_typing=is_pose)
            if is_pose:  # rclpy takes an empty list for one of bytes; without a value the others could not be asked for
                if self.declare_parameter(name, None, descriptor).value is None:
                    self.set_parameters([rclpy.Parameter(name, rclpy.Parameter.Type.DOUBLE_ARRAY, [])])
            else:
                self.declare_parameter(name, default, descriptor)
        for role in role_names():
            described = ParameterDescriptor(description=f"topic of the role {role}, or none; empty: found by its type")
            self.declare_parameter(f"topics.{role}", "", described)
        self._settings: Settings | None = None
        self._transport: RosTransport | None = None
        self._process: EstimationProcess | None = None
        self._run: _Run | None = None
        self._folder: TemporaryDirectory[str] | None = None
        self._pool = ThreadPoolExecutor(1, "fgloc-service")
        aside = ReentrantCallbackGroup()  # a service that waits would hold up all of the node's default group
        for name, work in (
            ("global_search", lambda live: live.search()),
            ("save_state", self._save),
            ("load_state", lambda live: live.load(self._saved())),
            ("reload_map", self._reload_map),
            ("reset", lambda live: live.reset()),
        ):
            self.create_service(Trigger, f"~/{name}", self._service(work), callback_group=aside)
        self._answer_invalid_transitions()

    # --- transitions ---

    @_logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read parameters, files and map; announce the outputs."""
        try:
            self._settings = self._read_parameters()
        except FglocError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        topics = self._settings.config.recording.topics
        named = {given for role in role_names() if (given := topics.given(role)) is not None}
        self._transport = RosTransport(self, self._settings.publishing.map_frame, named)
        self._process = EstimationProcess()  # it starts up while the node is inactive
        self._folder = TemporaryDirectory(prefix="fgloc-")
        return super().on_configure(state)

    @_logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin a run, or go on with the one before."""
        done = super().on_activate(state)  # publishers publish from now on
        assert self._settings is not None
        assert self._transport is not None
        process, self._process = self._process, None
        self._run = _Run(self, self._settings, self._transport, self._state(), process)
        return done

    @_logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the run; its state is kept."""
        self._end_run()
        self._process = EstimationProcess()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self.release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the run, if there is one."""
        self.release()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything, so that the node can be configured again."""
        self.get_logger().error("a transition failed; the node is unconfigured")
        self.release()
        return TransitionCallbackReturn.SUCCESS

    def release(self) -> None:
        """End the run, processes and publishers."""
        self._end_run()
        if self._process is not None:
            self._process.close()
        if self._transport is not None:
            self._transport.close()
        if self._folder is not None:
            self._folder.cleanup()
        self._process = self._transport = self._folder = self._settings = None

    def destroy_node(self) -> None:
        """End everything."""
        self.release()
        self._pool.shutdown()
        super().destroy_node()

    def _end_run(self) -> None:
        if self._run is not None:
            self._run.close()
            self._run = None
        if self._transport is not None:
            self._transport.stop()

    def _answer_invalid_transitions(self) -> None:
        """Refuse transitions that the present state does not have; rclpy ends the process by an exception instead."""
        service = self._service_change_state
        change = service.callback

        def guarded(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except Exception as error:
                self.get_logger().warning(f"transition refused: {error}")
                response.success = False
                return response

        service.callback = guarded

    # --- parameters ---

    def _read_parameters(self) -> Settings:
        names = [*PARAMETERS, *(f"topics.{role}" for role in role_names())]
        values = {name: self.get_parameter_or(name).value for name in names}
        if isinstance(values[_POSE], array):  # as rclpy has numbers
            values[_POSE] = values[_POSE].tolist()
        space = self.get_namespace().rstrip("/")

        def remapped(role: str) -> str | None:
            resolved = self.resolve_topic_name(role)
            return None if resolved == f"{space}/{role}" else resolved

        return settings(values, self.resolve_topic_name, remapped, self.get_fully_qualified_name())

    def _state(self) -> Path:
        assert self._settings is not None
        assert self._folder is not None
        return self._settings.state or Path(self._folder.name) / _SAVED

    def _saved(self) -> Path:
        """File of ~/save_state: the run goes on writing its own."""
        state = self._state()
        return state.with_name(f"{state.stem}.saved{state.suffix}")

    # --- services: done in a thread of their own, so that the executor goes on ---

    def _service(self, work: Callable[[Live], str | None]) -> Callable[[Any, Any], Any]:
        async def serve(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            done: Future = Future(executor=self.executor)
            done.add_done_callback(lambda _: None)  # wakes the executor, which else waits for the next message

            def call() -> None:
                try:
                    if self._run is None:
                        raise EstimatorError("the node is not active; activate it")
                    done.set_result((True, self._run.do(work)))
                except FglocError as error:
                    done.set_result((False, str(error)))
                except Exception as error:
                    done.set_result((False, f"{type(error).__name__}: {error}"))

            self._pool.submit(call)
            response.success, response.message = await done
            return response

        return serve

    def _save(self, live: Live) -> str:
        path = self._saved()
        if not live.save(path):
            raise EstimatorError("no pose is known yet; there is nothing to save")
        return f"saved to {path}"

    def _reload_map(self, live: Live) -> str:
        settings, run = self._settings, self._run
        assert settings is not None
        assert run is not None
        if settings.map_file is None:
            raise EstimatorError("there is no map to be read again: set the parameter map and configure the node")
        landmarks = configured_map(settings.map_file, settings.config)
        run.use_map(landmarks)
        return f"{settings.map_file}: {len(landmarks.landmarks)} landmarks"


class _Run:
    """One time of being active: a live run in a thread, and another one from the saved state if it fails."""

    def __init__(
        self,
        node: FglocNode,
        configured: Settings,
        transport: RosTransport,
        state: Path,
        process: EstimationProcess | None,
    ) -> None:
        self._log = node.get_logger()
        self._settings, self._transport, self._state = configured, transport, state
        self._landmarks = configured.landmarks
        self._stop = threading.Event()
        self._node = self._made(process)
        self._thread = threading.Thread(target=self._work, name="fgloc-run", daemon=True)
        self._thread.start()

    def do(self, work: Callable[[Live], str | None]) -> str:
        """Do something with the live run; returns what is to be said.

        Raises:
            EstimatorError: there is none yet.
        """
        live = self._node.live
        if live is None:
            raise EstimatorError(f"no run yet: {self._node.intake.find() or 'it is about to start'}")
        return work(live) or "done"

    def use_map(self, landmarks: Any) -> None:
        """Go on with another map."""
        self._node.use_map(landmarks)
        self._landmarks = landmarks

    def close(self) -> None:
        """End it and save its state."""
        self._stop.set()
        self._thread.join()

    def _made(self, process: EstimationProcess | None = None) -> Node:
        s = self._settings
        return Node(self._transport, s.config, self._landmarks, self._state, s.publishing, process)

    def _work(self) -> None:
        pause_s = _AGAIN_S
        while True:
            began = time.monotonic()
            try:
                self._node.run(self._stop, self._log.info)
            except FglocError as error:
                self._log.error(str(error))
            except Exception as error:  # a fault of fgloc; the robot still needs its pose
                self._log.error(f"{type(error).__name__}: {error}")
            try:
                self._node.close()
            except FglocError as error:
                self._log.error(str(error))
            pause_s = _AGAIN_S if time.monotonic() - began > _LASTED_S else min(2.0 * pause_s, _LONGEST_S)
            if self._stop.wait(0.0 if self._stop.is_set() else pause_s):
                return
            self._log.warning("begins again, from the state before")
            self._transport.forget()
            self._node = self._made()


def main(args: list[str] | None = None) -> None:
    """Run the node until it is told to end."""
    rclpy.init(args=args)
    node = FglocNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal and ros2 launch both send it: the state is saved now
        node.destroy_node()
        rclpy.try_shutdown()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # rclpy has put back the handler that was there before
