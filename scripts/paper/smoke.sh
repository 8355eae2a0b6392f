#!/usr/bin/env bash
# Both tables, tiny: a made-up subject, a few steps, one job for each processor. Says nothing about quality.
set -euo pipefail
cd "$(dirname "$0")/../.."
bin=$PWD/.venv/bin
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$bin/avatar" demo-data "$folder/someone" --frames 16 --size 64 > /dev/null 2>&1
tiny=("$folder/someone" data.size=64 model.uv_size=16 trainer.iterations=4 trainer.perceptual=dssim trainer.preview_every=4
  trainer.checkpoint_every=4 --frame-offset 1 --side-by-side --out "$folder/paper")
"$bin/python" scripts/paper/table.py table1 "${tiny[@]}"
"$bin/python" scripts/paper/table.py ablation "${tiny[@]}" --systems "FlashAvatar, MLP 256x40" "HyperGaussians n=2"
for table in table1 ablation; do
  for suffix in md csv png; do test -s "$folder/paper/$table.$suffix"; done
done
