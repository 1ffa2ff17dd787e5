#!/usr/bin/env bash
# Makes this checkout ready to run: uv, the locked environment in .venv, and an EGL to draw with.
#
#   deploy/setup.sh           what `make demo`, `make test` and the service need
#   deploy/setup.sh --quick   what `make demo` needs: each command compiles the loops of its own job before it begins
#   deploy/setup.sh --docs    also what `make check`, `make docs` and the documents' tests need (dependency group docs)
#   deploy/setup.sh --tests   that, and the Debian packages without which some tests skip
#   deploy/setup.sh --extra NAME   an optional part, gphoto for instance, from then on too
#
# Needs bash and python3 (3.11 or newer), nothing else. As root it installs missing Debian packages; without root it
# names the one command to run. Says what it did; does nothing, in milliseconds, where nothing is to do.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

UV_LEAST=0.9
EGL_PACKAGES=(libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri)
# the proxies of deploy/, the walk with curl, cameras over GigE Vision, the trigger box's firmware in a simulator, pages in
# a browser, jobs on PostgreSQL
TEST_PACKAGES=(nginx-light caddy openssl curl gcc libc6-dev gcc-avr avr-libc simavr libsimavr-dev libelf-dev
  aravis-tools libaravis-0.8-0 gir1.2-aravis-0.8 chromium postgresql)

say() { echo "setup: $*" >&2; }
fail() { say "$*"; exit 1; }

more="" quick=""
mapfile -t extras < <(cat .venv/.extras 2>/dev/null || true)
while [ $# -gt 0 ]; do
  case "$1" in
    --quick) quick=quick ;;
    --docs) more=${more:-docs} ;;
    --tests) more=tests ;;
    --extra)
      [ $# -gt 1 ] || fail "--extra needs a name; pyproject.toml lists them"
      extras+=("$2")
      shift
      ;;
    *) fail "unknown option $1; it knows --quick, --docs, --tests and --extra NAME" ;;
  esac
  shift
done
mapfile -t extras < <(printf '%s\n' "${extras[@]}" | sed '/^$/d' | sort -u)

# A stamp holds what the environment was made from; one for each option, as they ask for more.
stamp=".venv/.ready${more:+-$more}"
wanted="$(cat uv.lock pyproject.toml deploy/setup.sh deploy/wheel_imports.py | sha256sum) $PWD${extras[*]:+ ${extras[*]}}"
for made in "$stamp" ${quick:+.venv/.ready-quick}; do
  if [ -x .venv/bin/python ] && [ "$(cat "$made" 2>/dev/null)" = "$wanted" ]; then
    exit 0
  fi
done

missing_packages() {
  local package
  for package in "$@"; do
    [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || echo "$package"
  done
}

# install_packages WHY PACKAGE...
install_packages() {
  local why=$1
  shift
  command -v apt-get >/dev/null || fail "$why: no apt-get here; install what Debian calls $*"
  if [ "$(id -u)" != 0 ]; then
    fail "$why. Run this once, then try again: sudo apt-get update && sudo apt-get install -y --no-install-recommends $*"
  fi
  say "$why: installing $* from Debian"
  local log
  log=$(mktemp)
  export DEBIAN_FRONTEND=noninteractive
  { apt-get update && apt-get install -y --no-install-recommends "$@"; } >"$log" 2>&1 </dev/null ||
    { tail -n 20 "$log" >&2; fail "apt-get failed; its words are above"; }
  rm -f "$log"
}

find_uv() {
  local found
  for found in "$(command -v uv || true)" "$cache/uv"; do
    [ -n "$found" ] && version="$("$found" --version 2>/dev/null | cut -d' ' -f2)" && [ -n "$version" ] || continue
    [ "$(printf '%s\n' "$UV_LEAST" "$version" | sort -V | head -n 1)" = "$UV_LEAST" ] && echo "$found" && return
  done
  return 1
}

command -v python3 >/dev/null || install_packages "python3 is missing" python3
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
  fail "python3 is $(python3 --version | cut -d' ' -f2), 3.11 or newer is needed (Debian 12 has it)"

cache="${XDG_CACHE_HOME:-$HOME/.cache}/eigenhead"
if ! uv="$(find_uv)"; then
  # Without certificates nothing can be fetched over https; a minimal Debian has none.
  python3 -c 'import os, ssl, sys
p = ssl.get_default_verify_paths()
sys.exit(not any(map(os.path.exists, (os.environ.get("SSL_CERT_FILE", ""), "/etc/ssl/certs/ca-certificates.crt", p.cafile or ""))))' ||
    install_packages "no certificates to fetch uv with" ca-certificates
  say "uv is missing: fetching it into $cache"
  python3 deploy/fetch_uv.py "$cache"
  uv="$(find_uv)" || fail "the uv that was fetched does not run here"
fi

say "environment: $("$uv" --version | cut -d' ' -f1-2) sync of uv.lock into .venv"
"$uv" sync --locked --quiet ${more:+--group docs} "${extras[@]/#/--extra=}"
printf '%s\n' "${extras[@]}" >.venv/.extras

# The only sure sign of a working EGL is a context.
egl_works() { .venv/bin/python -c 'import moderngl; moderngl.create_context(standalone=True, backend="egl").release()' 2>/dev/null; }
if ! egl_works; then
  install_packages "no EGL to draw with" "${EGL_PACKAGES[@]}"
  egl_works || fail "EGL still does not start: .venv/bin/python -c 'import moderngl; moderngl.create_context(standalone=True, backend=\"egl\")' says why"
fi

# Once, not at every start and in the first job. uv installs sources alone, and where PYTHONDONTWRITEBYTECODE is set each
# start would translate them again: 1.1 of the 1.4 s in which Numba is imported.
say "compiling what a start loads, once for this machine"
env -u PYTHONDONTWRITEBYTECODE .venv/bin/python -m compileall -q rig pipeline calibration server || true
env -u PYTHONDONTWRITEBYTECODE .venv/bin/python -c 'from server.cli import demo, reconstruct_local; from server.http import serve; from server.worker import worker
from scipy import linalg, ndimage, optimize, signal, sparse, spatial, special; import scipy.sparse.linalg, scipy.sparse.csgraph, moderngl
from numba.core.registry import cpu_target; from PIL import Image; cpu_target.target_context.refresh(); Image.init()' ||
  say "the service's modules cannot be imported; \`eigenhead doctor\` may say why"
if [ -n "$quick" ]; then
  echo "$wanted" >.venv/.ready-quick
  say "ready"
  exit 0
fi
env -u PYTHONDONTWRITEBYTECODE .venv/bin/eigenhead prepare >&2 || say "loops will be compiled when a job needs them"

if [ "$more" = tests ]; then
  mapfile -t missing < <(missing_packages "${TEST_PACKAGES[@]}")
  [ ${#missing[@]} = 0 ] || install_packages "some tests would skip" "${missing[@]}"
fi

echo "$wanted" | tee .venv/.ready "$stamp" >/dev/null
[ "$more" != tests ] || echo "$wanted" >.venv/.ready-docs
say "ready"
