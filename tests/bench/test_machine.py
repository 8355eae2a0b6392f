from __future__ import annotations

import json
import os

import pytest
import torch

from avatar.bench.machine import available_simd, describe_machine, limited_to


def test_the_description_is_json_and_names_the_processor() -> None:
    machine = json.loads(json.dumps(describe_machine()))
    assert machine["processor"] and machine["processors"] >= 1 and machine["load"] >= 0
    assert machine["torch"] == torch.__version__
    assert machine["simd"] == available_simd() and machine["simd"][0] == "baseline"


def test_limits_are_lifted_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_THREADS", "2")
    monkeypatch.delenv("AVATAR_SIMD", raising=False)
    threads = torch.get_num_threads()
    with pytest.raises(KeyError), limited_to(threads=threads + 1, simd="baseline"):
        assert (os.environ["AVATAR_THREADS"], os.environ["AVATAR_SIMD"]) == (str(threads + 1), "baseline")
        assert torch.get_num_threads() == threads + 1
        raise KeyError
    assert (os.environ["AVATAR_THREADS"], os.environ.get("AVATAR_SIMD")) == ("2", None)
    assert torch.get_num_threads() == threads
