#!/usr/bin/env bash
# Compile the core to WebAssembly (Debian: emscripten): avatar/web/avatar.wasm, and beside it the SHA-256 of the module, of
# this script and of every source that went into it, which a test compares with the sources that are there.
set -euo pipefail
cd "$(dirname "$0")/.."
command -v em++ >/dev/null || { echo "make wasm needs emscripten (Debian: apt install emscripten)"; exit 1; }
source=avatar/csrc
out=avatar/web
build=build/wasm
mkdir -p "$build" "$out"
# Debian's emscripten runs a node that warns of its own fetch.
export NODE_OPTIONS="${NODE_OPTIONS:-} --no-experimental-fetch"
flags=(-std=c++17 -O3 -msimd128 -msse2 -fno-math-errno -fno-trapping-math -ffp-contract=off -I "$source")
kernels=(apply_offsets/kernels.cpp hyper/kernels.cpp splat/kernel_table.cpp)
plain=(apply_offsets/dispatch.cpp hyper/dispatch.cpp splat/dispatch.cpp instruction_set.cpp block_store.cpp
  splat/bin.cpp splat/project.cpp splat/splat.cpp web/one_thread.cpp web/pack.cpp web/web_avatar.cpp web/exports.cpp)
objects=()
compile() { # FILE [FLAGS]
  local object
  object=$build/$(echo "$1" | tr / _).o
  em++ "${flags[@]}" "${@:2}" -MMD -MF "${object%.o}.d" -c "$source/$1" -o "$object"
  objects+=("$object")
}
for file in "${kernels[@]}"; do compile "$file" -DAVATAR_KERNELS=kernels_baseline; done
for file in "${plain[@]}"; do compile "$file"; done
em++ "${flags[@]}" "${objects[@]}" -o "$build/avatar.wasm" --no-entry -s ALLOW_MEMORY_GROWTH=1 \
  -s INITIAL_MEMORY=64MB -s MAXIMUM_MEMORY=1GB -s TOTAL_STACK=1MB -s FILESYSTEM=0 -s ASSERTIONS=0
install -m 644 "$build/avatar.wasm" "$out/avatar.wasm"
read_sources=$(cat "${objects[@]/%.o/.d}" | tr ' \\' '\n\n' | grep "^$source/" | sort -u)
# shellcheck disable=SC2086
sha256sum "$out/avatar.wasm" scripts/build_wasm.sh $read_sources > "$out/avatar.wasm.sha256"
ls -l "$out/avatar.wasm"
