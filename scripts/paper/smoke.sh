#!/usr/bin/env bash
# The tables and figures, tiny: made-up people, a few steps, one job for each processor. Says nothing about quality.
set -euo pipefail
cd "$(dirname "$0")/../.."
bin=$PWD/.venv/bin
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$bin/avatar" demo-data "$folder/someone" --frames 16 --size 64 > /dev/null 2>&1
out=$folder/paper
small=("$folder/someone" data.size=64 model.uv_size=16 trainer.iterations=4 trainer.perceptual=dssim trainer.preview_every=4
  trainer.checkpoint_every=4 --frame-offset 1 --out "$out")
paper() { # one table or figure
  local name=$1
  shift
  "$bin/python" "scripts/paper/$name.py" "$@"
}
# What trains by itself runs beside the tables.
{
  paper slicing --out "$out"
  paper conditioning --out "$out" --sizes 1 8 --gaussians 300 --repeats 3
  paper convergence "${small[@]}" --seconds 0.2 0.5 --frames 2
} > "$folder/log" 2>&1 &
beside=$!
paper table table1 "${small[@]}" --side-by-side
wait $beside || { cat "$folder/log"; exit 1; }
cat "$folder/log"
paper table ablation "${small[@]}" --side-by-side --systems "FlashAvatar, MLP 256x40" "HyperGaussians n=2"
paper uncertainty "${small[@]}" --side-by-side --frames 2 # its run and those of the next are trained already
paper cross "${small[@]}" --side-by-side --frames 2
for name in table1 ablation slicing conditioning convergence uncertainty cross; do
  for suffix in md csv png; do test -s "$out/$name.$suffix"; done
done
