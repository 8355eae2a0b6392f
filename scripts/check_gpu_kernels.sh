#!/usr/bin/env bash
# Verify the GPU's kernels where there is no GPU: Triton's interpreter against the compiled core and the float64 reference,
# deliberate mistakes that the tests have to catch, launches counted on torch's meta device, and every kernel compiled for
# six GPUs, or for those in GPU_TARGETS. Installs Triton into .venv; where that cannot be had, says so and is done.
set -euo pipefail
cd "$(dirname "$0")/.."
python=.venv/bin/python
# shellcheck disable=SC2086
if ! said=$("$python" -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt ${PIP_FLAGS:-} triton 2>&1); then
  echo "gpu-check: skipped, Triton cannot be installed here: $(tail -n 1 <<<"$said")"
  exit 0
fi
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
jobs=$(nproc)
part() { echo "gpu-check: $1 ($SECONDS s)"; }

export OMP_NUM_THREADS=1 TRITON_CACHE_DIR=$work/triton # compiled anew, each time
part "the kernels in the interpreter"
TRITON_INTERPRET=1 "$python" -m pytest -q -p no:cacheprovider -n "$jobs" --dist worksteal --durations=15 -k gpu tests/gpu tests/splat
part "mistakes in the kernels"
TRITON_INTERPRET=1 "$python" scripts/mutate_kernels.py --jobs "$jobs" --changed-only
part "launches, and compiling"
"$python" scripts/count_launches.py >"$work/launches" & # beside the compilers' own rehearsal, which has one thread
launches=$!
# shellcheck disable=SC2086
"$python" scripts/compile_kernels.py --jobs "$jobs" ${GPU_TARGETS:+--targets $GPU_TARGETS}
wait "$launches"
grep launches "$work/launches"
part "done"
