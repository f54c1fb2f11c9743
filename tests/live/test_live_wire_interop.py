"""Messages exchanged with Fast DDS, another implementation of ROS 2's wire."""

import pytest
from wire import DOMAIN

from benchmarks.live_interop import build_peer, exchange


@pytest.mark.slow
def test_nothing_is_lost_between_cyclone_and_fast_dds(tmp_path):
    """JointState in, Odometry out; each message's content follows from its number and is checked."""
    peer = build_peer(tmp_path)
    if isinstance(peer, str):
        pytest.skip(peer)
    assert exchange(peer, count=200, domain=DOMAIN) == (0, 0)
