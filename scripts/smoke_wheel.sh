#!/usr/bin/env bash
# Build the source distribution, a wheel from that, install it into an empty environment outside the checkout, and run the
# whole program from there.
set -euo pipefail
checkout=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$checkout/.venv/bin/python" -m build --sdist --no-isolation --outdir "$work/dist" "$checkout"
mkdir "$work/source"
tar xf "$work"/dist/*.tar.gz -C "$work/source" --strip-components=1
"$checkout/.venv/bin/python" -m build --wheel --no-isolation --outdir "$work/dist" "$work/source"
"$python" -m venv "$work/env"
# shellcheck disable=SC2086
"$work/env/bin/pip" install --quiet --no-compile --disable-pip-version-check -c "$checkout/constraints.txt" ${PIP_FLAGS:-} "$work"/dist/*.whl

cd "$work"
export AVATAR_CACHE=$work/cache
avatar=$work/env/bin/avatar
set -x
"$avatar" --version
"$avatar" doctor
"$avatar" demo-data actor --frames 60 --size 96 --seed 1
"$avatar" demo-data driver --frames 20 --size 96 --seed 2 --motion turn
"$avatar" prepare actor
"$avatar" train actor --out run --size 64 --iterations 60 experiment=demo model.uv_size=24 trainer.checkpoint_every=30
"$avatar" train actor --out run --resume
"$avatar" eval run --frames
"$avatar" reenact run --driver driver --frame-offset 1 # 20 frames are too few to detect it
"$avatar" export run --with-head --out alone.safetensors
"$avatar" export run # a page: the scripts and the WebAssembly module are in the wheel
"$avatar" export run --out actor.glb
"$avatar" export run --out actor.ply
"$avatar" export run --out actor.mp4 --camera orbit
mkdir elsewhere
(cd elsewhere && "$avatar" drive-file ../driver --frame-offset 1 --out motion.npz &&
  "$avatar" reenact ../alone.safetensors --driver motion.npz)
for made in elsewhere/reenact/motion-relative.mp4 run/eval/results.json run/eval/hypergaussians/renders/00048.png run/reenact/driver-relative.mp4 actor.html actor.glb actor.ply actor.mp4; do
  test -s "$made"
done
set +x
echo "smoke: the installed wheel trains, evaluates and reenacts"
