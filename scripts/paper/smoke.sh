#!/usr/bin/env bash
# The tables and figures, tiny: a made-up person, a few steps, one job for each processor. Says nothing about quality.
set -euo pipefail
cd "$(dirname "$0")/../.."
bin=$PWD/.venv/bin
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$bin/avatar" demo-data "$folder/someone" --frames 16 --size 64 > /dev/null 2>&1
# One process for all: each script would spend seconds on its imports.
PYTHONPATH=scripts/paper "$bin/python" - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import conditioning, convergence, cross_reenactment, slicing, table, uncertainty

folder = Path(sys.argv[1])
out = ["--out", str(folder / "paper")]
small = [str(folder / "someone"), "data.size=64", "model.uv_size=16", "trainer.iterations=4", "trainer.perceptual=dssim"]
small += ["trainer.checkpoint_every=4", "--frame-offset", "1", *out]
together = [*small, "--side-by-side"]
statuses = [
    table.main(["table1", *together]),
    table.main(["ablation", *together, "--systems", "HyperGaussians n=2"]),
    uncertainty.main([*together, "--frames", "2"]),
    cross_reenactment.main([*together, "--frames", "2"]),
    convergence.main([*small, "--seconds", "0.2", "0.5", "--frames", "2"]),
    conditioning.main([*out, "--sizes", "1", "8", "--gaussians", "300", "--repeats", "3"]),
    slicing.main(out),
]
sys.exit(max(statuses))
PYTHON
for name in table1 ablation slicing conditioning convergence uncertainty cross_reenactment; do
  for suffix in md csv png; do test -s "$folder/paper/$name.$suffix"; done
done
