#!/bin/sh
# Installs those of the named Debian packages that are missing; `make test-viewer` and `make test-docs` call it.
set -eu

missing=""
for package in "$@"; do
    case "$(dpkg-query -W -f='${Status}' "$package" 2>/dev/null)" in
        *"ok installed") ;;
        *) missing="$missing $package" ;;
    esac
done
[ -z "$missing" ] && exit 0

cannot() {
    echo "make test-viewer needs$missing: $1; please install them, then run it again" >&2
    exit 1
}
command -v apt-get >/dev/null || cannot "there is no apt-get here"
if [ "$(id -u)" -eq 0 ]; then
    sudo=""
elif command -v sudo >/dev/null; then
    sudo="sudo"
else
    cannot "only root may install, and there is no sudo"
fi
echo "installing$missing"
$sudo apt-get install -y --no-install-recommends $missing || {
    $sudo apt-get update && $sudo apt-get install -y --no-install-recommends $missing
} || cannot "apt-get could not install them"
