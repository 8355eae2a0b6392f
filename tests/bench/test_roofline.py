from __future__ import annotations

import torch

from avatar.bench.roofline import measured_copy_bandwidth, measured_flops, roofline_ms


def test_the_longer_of_arithmetic_and_traffic_is_the_floor() -> None:
    flops, bandwidth = measured_flops(1), measured_copy_bandwidth(1)
    assert 1e8 < flops < 1e14 and 1e8 < bandwidth < 1e13
    assert roofline_ms(flops, 0.5 * bandwidth, 1) == 1e3
    assert roofline_ms(0.5 * flops, 2 * bandwidth, 1) == 2e3


def test_measuring_leaves_the_threads_of_torch() -> None:
    threads = torch.get_num_threads()
    measured_flops.__wrapped__(threads + 1)
    assert torch.get_num_threads() == threads
