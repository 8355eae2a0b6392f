#!/usr/bin/env bash
# The first session on a machine with a GPU: everything that cannot be checked without one, into OUT (default gpu-session).
#   scripts/first_gpu_session.sh [OUT]
# Needs `make setup-dev`, a torch build for the GPU and `.venv/bin/pip install triton` where torch did not bring it. About half
# an hour; each part goes on where another failed, and the last lines say which did.
set -uo pipefail
cd "$(dirname "$0")/.."
out=${1:-gpu-session}
python=.venv/bin/python
mkdir -p "$out"
unset TRITON_INTERPRET
failed=()
part() { # NAME COMMAND...: its output goes to OUT/NAME.log
  local name=$1
  shift
  echo "== $name"
  if "$@" >"$out/$name.log" 2>&1; then
    tail -n 3 "$out/$name.log"
  else
    failed+=("$name")
    tail -n 20 "$out/$name.log"
  fi
}

if command -v nvidia-smi >/dev/null; then part device nvidia-smi; else part device rocminfo; fi
part doctor .venv/bin/avatar doctor
part self-test "$python" -c 'from avatar.compute.choose import choose_device; choose_device("cuda", print)'
part tests "$python" -m pytest -q tests/gpu tests/splat tests/train tests/data
if command -v compute-sanitizer >/dev/null; then
  # Without torch's caching allocator, so that a write beside a buffer is not one into the next.
  export PYTORCH_NO_CUDA_MEMORY_CACHING=1
  for tool in memcheck racecheck initcheck; do
    part "$tool" compute-sanitizer --tool "$tool" --error-exitcode 9 "$python" -c \
      'import torch; from avatar.compute.self_test import self_test; print(max(self_test(torch.device("cuda", 0)).values()))'
  done
  unset PYTORCH_NO_CUDA_MEMORY_CACHING
else
  echo "== compute-sanitizer is not installed (it comes with the CUDA toolkit)"
fi
part measure "$python" scripts/measure_gpu.py --out "$out"
part bench-splat .venv/bin/avatar bench splat --out "$out/bench"
# The same little subject on both devices: seconds a step, and figures that must agree to rounding.
part demo-data .venv/bin/avatar demo-data "$out/actor" --frames 120 --size 512
for device in cuda cpu; do
  part "train-$device" .venv/bin/avatar train "$out/actor" --out "$out/run-$device" --device "$device" --iterations 300
  part "eval-$device" .venv/bin/avatar eval "$out/run-$device" --device "$device"
  part "refine-$device" .venv/bin/avatar refine "$out/run-$device" --out "$out/refined-$device" --device "$device"
  part "bench-render-$device" .venv/bin/avatar bench render "$out/run-$device" --out "$out/bench-$device" --device "$device"
  part "bench-train-$device" .venv/bin/avatar bench train "$out/actor" --out "$out/bench-$device" --device "$device"
done
# Two jobs; where there are several GPUs, each on one of its own (OUT/sweep/jobs/*/log.txt).
printf 'subjects: [actor]\nseeds: [0, 1]\noverrides: [trainer.iterations=100]\nprotocols: [strict]\n' >"$out/sweep.yaml"
part sweep .venv/bin/avatar sweep "$out/sweep.yaml" --out "$out/sweep"
if [ ${#failed[@]} -gt 0 ]; then
  echo "failed: ${failed[*]}; see $out/NAME.log"
  exit 1
fi
echo "all of it holds; $out/gpu.md, $out/bench and the logs have the figures"
