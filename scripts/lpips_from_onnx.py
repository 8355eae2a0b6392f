"""Turn an ONNX export of the whole of LPIPS v0.1 into weights that the program reads.

    python scripts/lpips_from_onnx.py lpips_sq.onnx ~/.cache/avatar/lpips/lpips_squeeze.safetensors [--net squeeze]

The export must keep the parameter names of the reference implementation: `...net.slice3.6.squeeze.weight`,
`...lins.0.model.1.weight`. Needs the package `onnx`.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import onnx
import torch

from avatar.losses.lpips import from_state, save_lpips
from avatar.losses.lpips_network import NETS

FEATURE = re.compile(r".*net\.slice\d+\.(\d+\..+)$")
HEAD = re.compile(r".*lins?\.?(\d+)\.model\.1\.weight$")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("onnx", type=Path)
    parser.add_argument("out", type=Path, help="a file named lpips_NET.safetensors")
    parser.add_argument("--net", choices=NETS, default="squeeze")
    arguments = parser.parse_args()
    state = {}
    for initializer in onnx.load(arguments.onnx).graph.initializer:
        tensor = torch.from_numpy(onnx.numpy_helper.to_array(initializer).copy())
        if feature := FEATURE.match(initializer.name):
            state[f"features.{feature[1]}"] = tensor
        elif head := HEAD.match(initializer.name):
            state[f"heads.{head[1]}"] = tensor.flatten()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    save_lpips(from_state(arguments.net, state, arguments.onnx), arguments.out)


if __name__ == "__main__":
    main()
