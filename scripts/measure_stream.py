"""Measure `avatar view RUN --stream PORT`: latency from packet to picture (docs/bench/view_results.md).

python scripts/measure_stream.py RUN [--head PATH] [--rate 60] [--seconds 8]

Another process sends the avatar's held-out motion as lines of JSON over TCP, then blendshapes as OSC and as Live Link
Face's packets over UDP. A picture is drawn when it has been handed to the page's server; there is no browser.
"""

from __future__ import annotations

import argparse
import json
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from measure_webcam import Record
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from avatar.head.model import matrix_from_6d
from avatar.runs.motion_clip import own_clip
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import HeadParams
from avatar.view.packets import BLENDSHAPES, LIVE_LINK, LIVE_LINK_VERSION
from avatar.view.player import Player
from avatar.view.receiver import Receiver
from avatar.view.view_renderer import ViewRenderer
from avatar.view.viewer import Viewer

# Sends packets, given as JSON of hexadecimal texts, and prints when each went out, in seconds of CLOCK_MONOTONIC.
SENDER = """
import json, socket, sys, time
kind, port, rate = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
packets = [bytes.fromhex(packet) for packet in json.load(sys.stdin)]
udp = kind == "udp"
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM if udp else socket.SOCK_STREAM)
out.connect(("127.0.0.1", port))
if not udp:
    out.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
begin, sent = time.monotonic() + 0.2, []
for k, packet in enumerate(packets):
    time.sleep(max(begin + k / rate - time.monotonic(), 0))
    sent.append(time.monotonic())
    out.sendall(packet)
json.dump(sent, sys.stdout)
"""


class Arrivals(Receiver):
    """Notes when each frame came."""

    def __init__(self, trained: TrainedAvatar) -> None:
        self.arrived: list[float] = []
        super().__init__(trained, 0)

    def _take(self, params: HeadParams, is_departure: bool) -> None:
        super()._take(params, is_departure)
        self.arrived.append(self._taken)


def encode_line(params: HeadParams) -> bytes:
    """A frame as a line of JSON."""
    jaw = rotation_matrix_to_axis_angle(matrix_from_6d(params.jaw)[None])[0]
    eyes = rotation_matrix_to_axis_angle(matrix_from_6d(params.eyes.reshape(2, 6))).reshape(-1)
    arrays = {"expression": params.expression, "jaw": jaw, "eyes": eyes, "eyelids": params.eyelids}
    values = {name: [round(value, 6) for value in array.tolist()] for name, array in arrays.items()}
    return json.dumps(values, allow_nan=False).encode() + b"\n"


def live_link(values: dict[str, float]) -> bytes:
    device, subject = b"01234567-89ab-cdef-0123-456789abcdef", b"phone"
    floats = [values.get(name, 0.0) for name in LIVE_LINK]
    named = b"".join(struct.pack(">i", len(text)) + text for text in (device, subject))
    return bytes([LIVE_LINK_VERSION]) + named + struct.pack(">ifiiB61f", 7, 0.5, 60, 1, 61, *floats)


def osc(values: dict[str, float]) -> bytes:
    """The VMC protocol's bundle of one frame."""
    bundle = OscBundleBuilder(IMMEDIATELY)
    for name, value in values.items():
        message = OscMessageBuilder("/VMC/Ext/Blend/Val")
        message.add_arg(name)
        message.add_arg(value, "f")
        bundle.add_content(message.build())
    bundle.add_content(OscMessageBuilder("/VMC/Ext/Blend/Apply").build())
    return bundle.build().dgram


def shapes(frame: int) -> dict[str, float]:
    """Blendshapes that all change from frame to frame."""
    return {name: 0.25 + 0.25 * float(np.sin(0.2 * frame + k)) for k, name in enumerate(BLENDSHAPES)}


def measure(trained: TrainedAvatar, name: str, packets: list[bytes], rate: float) -> None:
    receiver = Arrivals(trained)
    player = Player(trained, {}, time.monotonic, receiver.newest)
    viewer = Viewer(ViewRenderer(trained), player, trained.rest_camera().width, "127.0.0.1", 0, "measured")
    viewer.timing = record = Record()
    try:
        words = [sys.executable, "-c", SENDER, "tcp" if name == "JSON" else "udp", str(receiver.port), str(rate)]
        content = json.dumps([packet.hex() for packet in packets])
        done = subprocess.run(words, input=content, capture_output=True, text=True, check=True)
        time.sleep(0.5)
        counts = receiver.counts
        width = 0 if viewer.picture is None else viewer.picture.shape[1]
    finally:
        viewer.close()
        receiver.close()
    sent, arrived = json.loads(done.stdout), receiver.arrived
    lost = len(sent) - len(arrived) - counts.malformed
    if lost:
        raise SystemExit(f"{name}: {lost} of {len(sent)} packets were lost on the way, measure again")
    came = np.array(arrived)  # in the order of sending
    times = [when for when, _ in record.drawn]
    late = 1000 * np.array([when - sent[np.abs(came - (when - wait)).argmin()] for when, wait in record.drawn])
    drawn = (len(times) - 1) / (times[-1] - times[0])
    print(
        f"{name}: {np.median(late):.0f} ms, 95 in 100 below {np.percentile(late, 95):.0f} ms; {drawn:.1f} a second of"
        f" {rate:g}, {width} wide; {counts.dropped} of {counts.received} dropped, {counts.malformed} malformed",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--head", type=Path)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--seconds", type=float, default=8.0)
    arguments = parser.parse_args()
    trained = open_trained(arguments.run, arguments.head)
    count = round(arguments.rate * arguments.seconds)
    motion = own_clip(trained, "test").frames
    print(f"{len(trained.avatar):,} Gaussians")
    measure(trained, "JSON", [encode_line(motion[k % len(motion)][0]) for k in range(count)], arguments.rate)
    measure(trained, "OSC", [osc(shapes(k)) for k in range(count)], arguments.rate)
    measure(trained, "Live Link Face", [live_link(shapes(k)) for k in range(count)], arguments.rate)


if __name__ == "__main__":
    main()
