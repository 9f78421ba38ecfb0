#!/usr/bin/env bash
# Creates .venv in the repository's root and installs fd_mitsuba with its development tools into it.
# Reads PYTHON, TORCH and TORCH_INDEX from the environment; the Makefile sets them.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}

fail() { echo "install: $*" >&2; exit 1; }

if [ ! -x .venv/bin/python ]; then
    command -v "$python" >/dev/null || fail "$python not found; install Python 3.11 or newer, or run make PYTHON=/path/to/python3.11"
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "$("$python" --version) is too old; fd_mitsuba needs 3.11 or newer: make PYTHON=/path/to/python3.11"
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
        fail "$python cannot make virtual environments; on Debian or Ubuntu: apt-get install python3-venv"
    "$python" -m venv .venv
fi
.venv/bin/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    fail ".venv holds a Python older than 3.11; remove .venv and run make PYTHON=/path/to/python3.11"

pip=(.venv/bin/python -m pip --disable-pip-version-check --quiet)
echo "install: torch (the largest download), then the rest, into .venv"
if [ -n "${TORCH_INDEX:-}" ]; then
    "${pip[@]}" install --index-url "$TORCH_INDEX" "${TORCH:-torch==2.13.0}"
else
    "${pip[@]}" install "${TORCH:-torch==2.13.0}"
fi
"${pip[@]}" install -e '.[dev,docs,studio,usd]'
