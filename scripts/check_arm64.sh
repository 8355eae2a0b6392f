#!/usr/bin/env bash
# Compile the core for 64-bit ARM with a cross compiler: all but the Python bindings, with the instruction set that ARM
# gets (baseline, which there is NEON). Nothing is run. CXX names another compiler.
set -euo pipefail
cd "$(dirname "$0")/.."
compiler=${CXX:-aarch64-linux-gnu-g++}
command -v "$compiler" >/dev/null \
  || { echo "no $compiler: install it (Debian: apt install g++-aarch64-linux-gnu) or name another one with CXX=..."; exit 1; }
[[ $("$compiler" -dumpmachine) =~ ^(aarch64|arm64)- ]] || { echo "$compiler does not compile for 64-bit ARM"; exit 1; }

objects=build/arm64
mkdir -p "$objects"
while read -r source; do
  "$compiler" -std=c++17 -O3 -fPIC -fvisibility=hidden -Wall -Wextra -Werror -Wno-psabi -fno-math-errno \
    -fno-trapping-math -ffp-contract=off -DAVATAR_KERNELS=kernels_baseline -Iavatar/csrc \
    -c "$source" -o "$objects/$(echo "${source#avatar/csrc/}" | tr / _).o"
  echo "compiled $source"
done < <(find avatar/csrc -name '*.cpp' ! -name 'bind*.cpp' ! -path '*/python/*' | sort)
