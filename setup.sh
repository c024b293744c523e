#!/usr/bin/env bash
# Sets up everything the pipeline needs: system libraries, .venv with the locked dependencies, compiled kernels.
#   setup.sh run    what `make map` needs
#   setup.sh dev    the same and what `make check` and `make test` need
# Each step leaves a stamp named after what it depends on, so that an unchanged checkout skips it in milliseconds.
set -euo pipefail
cd "$(dirname "$0")"
kind=${1:-run}
venv=.venv
packages="libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1"

say() { echo "setup: $*" >&2; }

find_python() {
    for candidate in "${PYTHON:-}" python3 python3.13 python3.12 python3.11; do
        [ -n "$candidate" ] && command -v "$candidate" >/dev/null 2>&1 || continue
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    say "needs Python 3.11, 3.12 or 3.13 and found none; install one (for instance: apt-get install python3 python3-venv) or name it: make setup PYTHON=/path/to/python3.12"
    exit 1
}

have_libraries() {
    local cache
    cache=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p)
    for library in libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libX11.so.6 libgomp.so.1; do
        case "$cache" in *"$library"*) ;; *) return 1 ;; esac
    done
}

apt_install() {
    local sudo=
    if [ "$(id -u)" -ne 0 ]; then
        if sudo -n true 2>/dev/null; then sudo="sudo -n"; else
            say "system libraries are missing and this account may not install them; run once:"
            echo "    sudo apt-get update && sudo apt-get install -y $*" >&2
            exit 1
        fi
    fi
    command -v apt-get >/dev/null || { say "needs the libraries of the Debian packages: $*; install them with this system's package manager"; exit 1; }
    say "installing system packages: $*"
    $sudo apt-get update -qq
    DEBIAN_FRONTEND=noninteractive $sudo apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

venv_is_sound() {
    # A virtual environment that was moved with its checkout, or cut off while being made, is made anew.
    [ "$(cat $venv/home 2>/dev/null)" = "$PWD" ] && $venv/bin/python -m pip --version >/dev/null 2>&1
}

make_venv() {
    local python
    python=$(find_python)
    rm -rf $venv
    "$python" -c 'import ensurepip, venv' 2>/dev/null || apt_install python3-venv
    "$python" -m venv $venv
    echo "$PWD" >$venv/home
}

stamp_of() { echo "$venv/stamp-$1-$(cat "$2" pyproject.toml | sha256sum | cut -c1-16)"; }

install_locked() {
    local lock=$2 stamp
    stamp=$(stamp_of "$1" "$2")
    [ -e "$stamp" ] && return
    rm -f $venv/stamp-*
    say "installing the dependencies of $lock"
    $venv/bin/python -m pip install -q --disable-pip-version-check --require-hashes -r "$lock"
    $venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
    touch "$stamp"
}

have_browser() {
    for name in chromium chromium-browser google-chrome google-chrome-stable chrome; do
        command -v "$name" >/dev/null && return
    done
    return 1
}

have_libraries || apt_install $packages
venv_is_sound || make_venv
case $kind in
    run) [ -e "$(stamp_of dev requirements-dev.lock)" ] || install_locked run requirements.lock ;;
    dev)
        install_locked dev requirements-dev.lock
        # Without a browser the tests of the viewer's page are skipped; everything else runs.
        have_browser || (apt_install chromium) || say "no Chromium: the tests of the viewer's page will be skipped"
        ;;
    *) say "unknown kind $kind: run or dev"; exit 2 ;;
esac
$venv/bin/scanloom warm
