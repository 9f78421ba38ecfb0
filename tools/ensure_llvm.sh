#!/usr/bin/env bash
# Makes sure that a libLLVM of version 16 or newer is there for Dr.Jit; installs Debian's where it may.
# Exit 0: found or installed. Exit 1, and one line that says what to do: neither.
set -u

found() {
    [ -n "${DRJIT_LIBLLVM_PATH:-}" ] && return 0  # the user's choice; fd_mitsuba checks it when it starts
    local file version
    for file in /usr/lib/libLLVM* /usr/lib64/libLLVM* /usr/lib/*-linux-gnu/libLLVM* /usr/local/lib/libLLVM* \
                /usr/lib/llvm-*/lib/libLLVM* /opt/homebrew/opt/llvm/lib/libLLVM*; do
        [ -e "$file" ] || continue
        # libLLVM-19.so, libLLVM.so.19.1 and llvm-19/lib/libLLVM.so.1 all name their version somewhere.
        for version in $(printf '%s\n' "$file" | grep -oE '(llvm-|libLLVM-|libLLVM\.so\.)[0-9]+' | grep -oE '[0-9]+$'); do
            [ "$version" -ge 16 ] && return 0
        done
    done
    [ -x .venv/bin/python ] && .venv/bin/python - <<'PYTHON' 2>/dev/null
from fd_mitsuba.backend.startup import find_llvm
find_llvm()
PYTHON
}

found && exit 0
as_root=()
if [ "$(id -u)" -ne 0 ]; then
    sudo -n true 2>/dev/null && as_root=(sudo -n) || as_root=(false)
fi
if command -v apt-get >/dev/null && [ "${as_root[*]-}" != false ]; then
    echo "llvm: no libLLVM >= 16 found; installing libllvm19 with apt-get" >&2
    export DEBIAN_FRONTEND=noninteractive
    { "${as_root[@]}" apt-get update -qq && "${as_root[@]}" apt-get install -y -qq --no-install-recommends libllvm19; } \
        </dev/null >/dev/null 2>&1 && found && exit 0
fi
echo "llvm: no libLLVM >= 16 found; as root run 'apt-get install libllvm19', or set DRJIT_LIBLLVM_PATH to a libLLVM.so" >&2
exit 1
