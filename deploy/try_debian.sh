#!/usr/bin/env bash
# Tries the last commit as a stranger has it: a bare Debian in a folder of its own (debootstrap; git, make, python3 and
# ca-certificates, nothing else), a clone, and there what the README says to type.
#
#   deploy/try_debian.sh              all steps
#   deploy/try_debian.sh demo wheel   these
#
# Steps: demo (`make demo`), test (`make test`), wheel (built there, installed by `uv tool install`, `eigenhead demo` from
# /tmp). Needs root and debootstrap, and says `skipped` where one is missing. The new Debian gets this machine's way to the
# net: its resolver, certificates, apt sources and package index, as they are when this runs. Everything is removed at the
# end; TMPDIR says where it lies until then (about 6 GB).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { echo "try_debian: $*" >&2; }
skip() { say "skipped: $*"; exit 0; }

steps=("$@")
[ $# -gt 0 ] || steps=(demo test wheel)
for step in "${steps[@]}"; do
  case "$step" in
    demo | test | wheel) ;;
    *) say "unknown step $step; it knows demo, test and wheel"; exit 2 ;;
  esac
done
[ "$(id -u)" = 0 ] || skip "a chroot needs root"
command -v debootstrap >/dev/null || skip "no debootstrap (apt-get install debootstrap)"
[ -z "$(git status --porcelain)" ] || say "what is not committed is not tried"

suite="$(. /etc/os-release && echo "$VERSION_CODENAME")"
mirror="$(apt-get indextargets --format '$(REPO_URI) $(RELEASE)' 'Created-By: Packages' | awk -v suite="$suite" '$2 == suite { print $1; exit }')"
[ -n "$mirror" ] || skip "apt knows no $suite to install from"

root="$(mktemp -d "${TMPDIR:-/tmp}/eigenhead-debian.XXXXXX")"
mounted=()
leave() {
  local place
  for place in "${mounted[@]}"; do umount --recursive --lazy "$place" || true; done
  # With something still mounted below it, rm would empty this machine's own folders.
  if grep -q " $root/" /proc/mounts; then say "$root is still in use: not removed"; else rm -rf "$root"; fi
}
trap leave EXIT

say "a bare $suite in $root"
timeout 1800 debootstrap --variant=minbase --include=git,make,python3,ca-certificates "$suite" "$root" "$mirror" >"$root.log" 2>&1 || bootstrapped=no
[ "${bootstrapped:-yes}" = yes ] || tail -n 20 "$root.log" >&2
rm -f "$root.log"
[ "${bootstrapped:-yes}" = yes ] || skip "no Debian could be fetched; debootstrap's words are above"

# This machine's way to the net.
cp -L /etc/resolv.conf /etc/hosts "$root/etc/"
rm -rf "$root"/etc/apt/sources.list*
cp -a /etc/apt/sources.list* "$root/etc/apt/"
apt-config dump --format '%F "%v";%n' Acquire >"$root/etc/apt/apt.conf.d/90this-machine"
[ ! -f /etc/pip.conf ] || cp /etc/pip.conf "$root/etc/"
cp -a /usr/local/share/ca-certificates/. "$root/usr/local/share/ca-certificates/" 2>/dev/null || true
chroot "$root" update-ca-certificates >/dev/null 2>&1

for place in dev dev/shm dev/pts; do
  if [ -d "/$place" ]; then mount --bind "/$place" "$root/$place" && mounted=("$root/$place" "${mounted[@]}"); fi
done
mount -t proc proc "$root/proc" && mounted=("$root/proc" "${mounted[@]}")
git clone --quiet --no-hardlinks . "$root/srv/eigenhead"

# inside SECONDS COMMAND: in the clone, with no variable of ours but those that lead to the net
inside() {
  local kept
  mapfile -t kept < <(env | grep -iE '^(https?_proxy|no_proxy|UV_[A-Z_]*INDEX[A-Z_]*|PIP_INDEX_URL|SSL_CERT_FILE)=' || true)
  say "$2"
  timeout --kill-after=30 "$1" chroot "$root" env -i HOME=/root LANG=C.UTF-8 \
    PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin "${kept[@]}" bash -euc "cd /srv/eigenhead; $2" </dev/null
}

for step in "${steps[@]}"; do
  case "$step" in
    demo) inside 2700 'make demo && test -s out/demo/head.ply' ;;
    test) inside 3600 'make test' ;;
    wheel)
      inside 1800 'deploy/setup.sh'
      inside 1800 'PATH="$PATH:$HOME/.cache/eigenhead:$HOME/.local/bin"; uv build --quiet; uv tool install --quiet dist/*.whl
        cd /tmp; eigenhead --version; eigenhead demo --out /tmp/wheel-demo; test -s /tmp/wheel-demo/head.ply'
      ;;
  esac
  say "$step: done"
done
