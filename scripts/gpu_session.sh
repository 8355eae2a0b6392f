#!/usr/bin/env bash
# What only a machine with a GPU can say, in parts of under ten minutes each.
#   scripts/gpu_session.sh OUT PART...
#     checks              doctor, self-test, all tests of the kernels on the GPU, compute-sanitizer
#     times               steps, frames and splatting; gsplat beside ours where it is installed
#     recipes FOLDER...   the default recipe on tracked folders, three seeds each, four at a time
#     paper FOLDER...     the paper's tables at their size, with SqueezeNet's LPIPS, four at a time
# A part that ended well is not done again; sweeps go on where they stopped. Each log and figure is in OUT.
# HEAD names the folder of the head model for recipes and paper, EXTRA overrides of the configuration.
set -uo pipefail
cd "$(dirname "$0")/.."
PATH=$PWD/.venv/bin:$PATH
out=$1
part=$2
shift 2
mkdir -p "$out"
unset TRITON_INTERPRET
run() { # NAME COMMAND...: its output goes to OUT/NAME.log
  local name=$1 begin=$SECONDS
  shift
  [ -e "$out/$name.done" ] && return
  echo "== $name"
  if "$@" >"$out/$name.log" 2>&1; then
    touch "$out/$name.done"
    tail -n 3 "$out/$name.log"
  else
    tail -n 20 "$out/$name.log"
  fi
  echo "-- $name: $((SECONDS - begin)) s"
}
self_test='import torch; from avatar.pipeline.self_test import self_test; print(max(self_test(torch.device("cuda", 0)).values()))'

# Jobs side by side: their kernels run at the same time where NVIDIA's MPS is installed.
case $part in recipes | paper) command -v nvidia-cuda-mps-control >/dev/null && nvidia-cuda-mps-control -d ;; esac

case $part in
checks)
  run device nvidia-smi
  run doctor avatar doctor
  run self-test python3 -c 'from avatar.pipeline.choose_device import choose_device; choose_device("cuda", print)'
  # Without torch's caching allocator, so that a write beside a buffer is not one into the next.
  for tool in memcheck racecheck initcheck; do
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 run "$tool" timeout 240 compute-sanitizer --tool "$tool" --error-exitcode 9 \
      python3 -c "$self_test" &
  done
  run tests timeout 400 python3 -m pytest -q -n 10 --timeout 240 -p no:cacheprovider --durations 15 \
    tests/gpu tests/splat tests/train tests/data
  wait
  ;;
times)
  run measure timeout 240 python3 scripts/measure_gpu.py --out "$out" --quick
  python3 -c 'import gsplat' 2>/dev/null && run gsplat timeout 240 python3 scripts/compare_gsplat.py --out "$out"
  run demo-data avatar demo-data "$out/actor" --frames 60 --size 512
  run train avatar train "$out/actor" --out "$out/run" --device cuda --iterations 300
  run bench-render avatar bench render "$out/run" --out "$out" --device cuda
  run bench-train avatar bench train "$out/actor" --out "$out" --device cuda
  ;;
recipes)
  {
    echo "subjects:"
    for folder in "$@"; do echo "  - {folder: $(realpath "$folder")${HEAD:+, head: $(realpath "${HEAD:-.}")}}"; done
    printf 'seeds: [0, 1, 2]\noverrides: [%s]\nprotocols: [strict]\nthreads: 3\ngpus: 0.25\n' "${EXTRA:-}"
  } >"$out/recipes.yaml"
  run recipes avatar sweep "$out/recipes.yaml" --out "$out/recipes"
  ;;
paper)
  for table in table1 ablation; do
    run "$table" python3 scripts/paper/table.py "$table" "$@" ${HEAD:+--head "$HEAD"} --out "$out/paper" --gpus 0.25 \
      trainer.perceptual=lpips-squeeze ${EXTRA:-}
  done
  ;;
*) sed -n '2,9p' "$0"; exit 2 ;;
esac
status=0
for log in "$out"/*.log; do
  [ -e "${log%.log}.done" ] || { echo "failed: $log"; status=1; }
done
exit $status
