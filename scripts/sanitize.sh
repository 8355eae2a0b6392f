#!/usr/bin/env bash
# Build the compiled core with AddressSanitizer and UndefinedBehaviorSanitizer, beside the ordinary build, and run the
# tests of all its parts on it. Arguments go to pytest instead of those. Needs GCC or Clang on Linux.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$PWD/.venv/bin/python
site=$PWD/build/sanitize/site
compiler=${CXX:-c++}

"$python" -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --upgrade --target "$site" \
  --config-settings=build-dir=build/sanitize/cmake --config-settings=cmake.define.AVATAR_SANITIZE=ON \
  --config-settings=install.strip=false .

# Python itself is not instrumented, so the sanitizers' runtime is loaded first, and libstdc++ with it, whose exceptions
# it intercepts. Python and torch keep memory until the end, so leaks are not looked for.
LD_PRELOAD="$("$compiler" -print-file-name=libasan.so) $("$compiler" -print-file-name=libstdc++.so)"
export LD_PRELOAD
export ASAN_OPTIONS=detect_leaks=0:abort_on_error=1 UBSAN_OPTIONS=print_stacktrace=1
# -S: without the environment's .pth files, one of which leads to the ordinary build.
packages=$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
export PYTHONPATH=$site:$packages
(cd / && "$python" -S -c 'import avatar._core, sys; sys.exit(not avatar._core.__file__.startswith(sys.argv[1]))' "$site/")
[ $# -gt 0 ] || set -- tests/stress tests/splat tests/gaussians tests/head tests/losses/test_dssim_cpu.py tests/fuzz/test_bindings.py
"$python" -S "$(dirname "$python")/pytest" --timeout=0 "$@"
