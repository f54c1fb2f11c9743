"""Commands on ROS 2's wire: ``live`` and ``play``."""

from __future__ import annotations

import gc
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgloc.cli.options import Bag, ModelOption, configured, need
from fgloc.cli.terminal import UNTRUSTED, columns, exit_if_wrong, run_bar, say
from fgloc.errors import ConfigError, FglocError
from fgloc.instrumentation import repeated

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.live.wire.node import Node
    from fgloc.types import LandmarkMap

_SWITCH_S = 1e-3  # the thread that publishes waits no longer than this for the one that estimates
_STATUS_S = 0.5  # time between two changes of the status line ...
_LOGGED_S = 60.0  # ... between two lines of a log in which nothing changes ...
_AT_MOST_EVERY_S = 2.0  # ... and in which much does

DomainOption = Annotated[int, typer.Option("--domain", metavar="N", envvar="ROS_DOMAIN_ID", help="DDS domain")]
NetworkOption = Annotated[
    bool,
    typer.Option("--network", help="on the machine's networks (or as CYCLONEDDS_URI has it), not on loopback only"),
]


def live(
    map_file: Annotated[
        Path | None, typer.Option("--map", metavar="MAP.yaml", help="landmarks; without a map they are estimated")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="ROBOT.yaml", help="configuration; default: none")
    ] = None,
    model: ModelOption = None,
    domain: DomainOption = 0,
    network: NetworkOption = False,
    initial_pose: Annotated[
        str | None, typer.Option("--initial-pose", metavar="X,Y,YAW", help="first pose in m and rad; also /initialpose")
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state", metavar="FILE", help="state of the run: written every second, and resumed from at the start"
        ),
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="serve a page on loopback that shows the run")] = False,
) -> None:
    """Localize a robot on ROS 2's wire. ROS need not be installed; Ctrl-C ends with a summary."""
    with _interrupted() as stop:
        need("live", "fgloc live")
        if view:
            need("view", "fgloc live --view")
        from fgloc.live.wire.node import Node
        from fgloc.live.wire.participant import Participant
        from fgloc.sensors.maps import configured_map

        settings = _with_initial_pose(configured(None, config, model), initial_pose)
        landmarks = None if map_file is None else configured_map(map_file, settings)
        began = time.monotonic()
        sys.setswitchinterval(_SWITCH_S)
        with Participant(domain, network) as participant:
            node = Node(participant, settings, landmarks, state)
            say(f"domain {domain}, {'all networks' if network else 'loopback only'}; Ctrl-C ends")
            gc.freeze()  # collecting what was imported would hold up publishing now and then, and the end by 0.3 s
            try:
                shown = _page(node, settings, landmarks) if view else nullcontext(_tell)
                with shown as tell, _status_line(node):
                    node.run(stop, tell)
            finally:
                node.close()
            say(_summary(node, time.monotonic() - began))
            _exit_if_wrong(node)


def play(
    bag: Bag,
    rate: Annotated[float, typer.Option("--rate", metavar="R", help="multiple of the recorded speed")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="begin anew at the end, until Ctrl-C")] = False,
    wait: Annotated[
        float, typer.Option("--wait", metavar="S", min=0.0, help="seconds to wait for a subscriber before the start")
    ] = 10.0,
    domain: DomainOption = 0,
    network: NetworkOption = False,
) -> None:
    """Publish a recording on ROS 2's wire. It has its recorded timing; /clock is published too."""
    need("live", "fgloc play")
    from fgloc.live.wire.participant import Participant
    from fgloc.live.wire.play import Player

    if not 0.0 < rate <= 1000.0:
        raise ConfigError(f"--rate {rate:g}: expected a multiple of the recorded speed, more than 0 and up to 1000")
    with _interrupted() as stop, Participant(domain, network) as participant, Player(bag, participant) as player:
        for note in player.notes:
            say(f"note: {note}")
        say(f"{len(player.topics)} topics, {player.duration_s:.1f} s; domain {domain}")
        if not player.wait_for_readers(wait, stop) and not stop.is_set():
            say(f"no subscriber in {wait:g} s: playing all the same")
        again = True
        while again and not stop.is_set():
            with run_bar("play") as progress:
                player.play(rate, stop, progress)
            again = loop
        player.finish()
        damaged = f", {player.damaged} damaged ones left out" if player.damaged else ""
        say(f"{player.published} messages published{damaged}")


@contextmanager
def _interrupted() -> Iterator[threading.Event]:
    """An event that Ctrl-C or a termination signal sets, instead of raising an exception anywhere."""
    stop = threading.Event()
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(kind, lambda *_: stop.set()) for kind in kinds]
    try:
        yield stop
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)


def _tell(sentence: str) -> None:
    say(sentence)
    sys.stdout.flush()


@contextmanager
def _page(node: Node, config: Config, landmarks: LandmarkMap | None) -> Iterator[Callable[[str], None]]:
    """Open a page that shows the run; yield the function that shows a sentence there too."""
    from fgloc.recording.truth import base_pose
    from fgloc.types import Event, TruthEvent
    from fgloc.view.page import Page

    with Page() as page:
        scene = page.scene(config.truth.max_gap_s)
        if landmarks is not None:
            scene.add_map(landmarks)

        def watch(event: Event) -> None:
            if isinstance(event, TruthEvent) and config.truth.align == "none":
                scene.add_truth(event.stamp_ns, base_pose(event, config.truth))

        def tell(sentence: str) -> None:
            _tell(sentence)
            scene.note(sentence)

        node.subscribe(scene.add)
        node.watch = watch
        _tell(f"view: {page.url}")
        yield tell


@contextmanager
def _status_line(node: Node) -> Iterator[None]:
    """Show mode and pose while the block runs: on a terminal in one line, else at a change and each minute."""
    if not sys.stderr.isatty():
        with repeated(_logged(node), _STATUS_S, "fgloc-status-line"):
            yield
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    on_screen = sys.stdout.isatty()  # then what is printed goes above the line
    console = Console(stderr=True)
    with Live(Text(), console=console, auto_refresh=False, transient=True, redirect_stdout=on_screen) as line:

        def show() -> None:
            if (found := _shown(node)) is not None:
                line.update(Text(found[-1]), refresh=True)

        with repeated(show, _STATUS_S, "fgloc-status-line"):
            yield


def _logged(node: Node) -> Callable[[], None]:
    """Function that prints mode and pose: at a change of mode, staleness or alert, and each minute."""
    last: tuple[object, ...] = ()
    said_s = -math.inf

    def show() -> None:
        nonlocal last, said_s
        found, now = _shown(node), time.monotonic()
        if found is not None and now - said_s > (_LOGGED_S if found[:-1] == last else _AT_MOST_EVERY_S):
            last, said_s = found[:-1], now
            _tell(found[-1])

    return show


def _shown(node: Node) -> tuple[str, bool, bool, str] | None:
    """Mode, whether it is stale, whether it alerts, and the line with the newest pose; None: there is none yet."""
    live, pose = node.live, None
    with suppress(FglocError):  # the run has failed, and says so itself
        pose = None if live is None else live.pose_at()
    if live is None or pose is None:
        return None
    x, y, yaw = pose.pose
    sigma = float(max(pose.cov[0, 0], pose.cov[1, 1])) ** 0.5
    status, mode = live.status(), str(pose.mode)
    line = f"{status.stale or status.alert or mode}  x {x:.3f} m  y {y:.3f} m  yaw {yaw:.3f} rad  ±{sigma:.3f} m"
    return mode, bool(status.stale), bool(status.alert), line


def _with_initial_pose(config: Config, text: str | None) -> Config:
    from fgloc.live.live import begun_at

    if text is None:
        return config
    try:
        x, y, yaw = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--initial-pose {text}: expected x, y [m] and yaw [rad], such as 1.5,-0.2,3.14") from None
    return begun_at(config, (x, y, yaw), "--initial-pose")


def _exit_if_wrong(node: Node) -> None:
    """End with code 3 after errors, without a pose, or with one that is not of now, and say why."""
    from fgloc.types import Mode, Severity

    if node.live is None:
        exit_if_wrong(["no pose was found: the robot's topics were not there"], UNTRUSTED)
        return
    status = node.live.status()
    wrong = [f.text for f in status.findings if f.severity is Severity.ERROR]
    if status.mode in (None, Mode.LOST):
        lacking = f"; the run waited for {'; '.join(status.waiting_for)}" if status.waiting_for else ""
        wrong.append(f"LOST: the pose is not known{lacking}")
    if status.stale:
        wrong.append(status.stale)
    exit_if_wrong(wrong, UNTRUSTED)


def _summary(node: Node, seconds: float) -> str:
    rows = [("duration", f"{seconds:.1f} s"), ("odometry published", str(node.published["odometry"]))]
    if node.live is None:
        return columns(None, [*rows, ("received", "nothing: the robot's topics were not found")])
    status = node.live.status()
    rows += [
        ("keyframes", str(status.keyframes)),
        ("last mode", status.stale or ("no pose was found" if status.mode is None else str(status.mode))),
        ("rejected", str(sum(status.rejections.values()))),
    ]
    rows += [(f"undecodable {topic}", str(n)) for topic, n in node.intake.undecodable.items()]
    rows += [(f"dropped {role}", str(n)) for role, n in status.dropped.items()]
    rows += [
        (f"{of.role} {topic}", f"{of.count}, delay {of.delay_s * 1e3:z.0f} ms") for topic, of in status.topics.items()
    ]
    return columns(None, rows)
