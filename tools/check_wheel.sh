#!/usr/bin/env bash
# Builds source distribution and wheel, and uses the wheel as a newcomer would: outside the repository, in a fresh
# environment. That environment takes the dependencies of .venv by a path file, so that nothing is downloaded twice.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

"$python" -m build --outdir "$scratch/dist" . >"$scratch/build.log" 2>&1 || { cat "$scratch/build.log" >&2; exit 1; }
"$python" -m venv --without-pip "$scratch/venv"
own=$("$scratch/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
"$python" -m pip --disable-pip-version-check --quiet --python "$scratch/venv/bin/python" \
    install --no-deps --no-index "$scratch"/dist/*.whl
"$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))' >"$own/dependencies.pth"

cd "$scratch"  # no checkout, no configs/, no scenes/ here
unset PYTHONPATH
command=venv/bin/fd_mitsuba
where=$(venv/bin/python -c 'import fd_mitsuba; print(fd_mitsuba.__file__)')
case "$where" in "$own"/*) ;; *) echo "wheel: $where was imported instead of the wheel's package" >&2; exit 1 ;; esac
"$command" --version
"$command" doctor
"$command" demo -c smoke -q
test -s runs/demo/export/asset.glb && test -s runs/demo/report.html
"$command" --print-completion bash | bash -n
echo "wheel: $(basename dist/*.whl) works outside the repository"
