#!/usr/bin/env bash
# What a release offers for download, in one folder: the program for this platform as an archive, the wheel of the Python module,
# and SHA256SUMS of both. Everything is built from the lock files, unpacked again and tried before the script ends.
#
#   tools/release.sh                        program and wheel, into target/release-files
#   tools/release.sh --out DIR              into another folder
#   tools/release.sh --no-wheel             the program alone
#   tools/release.sh --target TRIPLE        for another platform that is installed; it is not tried out
#   tools/release.sh --binary FILE          packs a program that is built already (tests use it)
#
# docs/releasing.md says what else belongs to a release.
set -euo pipefail
cd "$(dirname "$0")/.."
die() { printf 'release: %s\n' "$1" >&2; exit 2; }
say() { printf '\n== %s (%ss)\n' "$1" "$SECONDS"; }

out=target/release-files wheel=true target="" binary=""
while [ $# -gt 0 ]; do
  case $1 in
    --out) out=${2:?}; shift ;;
    --no-wheel) wheel=false ;;
    --target) target=${2:?}; shift ;;
    --binary) binary=${2:?}; shift ;;
    *) die "unknown argument $1; see the head of tools/release.sh" ;;
  esac
  shift
done
host=$(rustc -vV | sed -n 's/^host: //p')
platform=${target:-$host}
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
[ -n "$version" ] || die "Cargo.toml states no version"

if [ -z "$binary" ]; then
  # A release belongs to a commit; under its tag, that of the version, and described in the changelog.
  [ -z "$(git status --porcelain)" ] || die "the work tree has changes that are not committed"
  tag=$(git describe --tags --exact-match --match 'v[0-9]*' 2>/dev/null || true)
  if [ -z "$tag" ]; then
    echo "release: no tag v$version at this commit: files for trying out, not for publishing"
  else
    [ "$tag" = "v$version" ] || die "the tag is $tag, the version $version"
    grep -q "^## $version" CHANGELOG.md || die "CHANGELOG.md has no heading \"## $version\""
  fi
  say "program, from Cargo.lock"
  cargo build --locked --release --package vidar-cli ${target:+--target "$target"}
  binary=${CARGO_TARGET_DIR:-target}/${target:+$target/}release/vidar
  [ -f "$binary" ] || binary=$binary.exe
fi
[ -f "$binary" ] || die "$binary is missing"

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
# What fails below leaves nothing behind that could be taken for a release.
files_at=$scratch/files
mkdir "$files_at"

say "archive"
name=vidar-$version-$platform
program=vidar
[ "${platform#*windows}" = "$platform" ] || program=vidar.exe
mkdir -p "$scratch/$name/completions"
cp "$binary" "$scratch/$name/$program"
chmod 755 "$scratch/$name/$program"
strip "$scratch/$name/$program" 2>/dev/null || echo "release: not stripped: no strip for $platform"
cp README.md CHANGELOG.md LICENSE LICENSE-MIT LICENSE-APACHE NOTICE WEIGHTS.md THIRD-PARTY-LICENSES.txt "$scratch/$name/"
if [ "$platform" = "$host" ]; then
  for shell in bash zsh fish powershell elvish; do
    "$scratch/$name/$program" completions "$shell" > "$scratch/$name/completions/vidar.$shell"
  done
else
  rmdir "$scratch/$name/completions"
fi
# The same bytes for the same commit: names sorted, one owner, the commit's time.
reproducible=()
if tar --version 2>/dev/null | grep -q GNU; then
  time=$(git log -1 --format=%ct 2>/dev/null || echo 0)
  reproducible=(--sort=name --owner=0 --group=0 --numeric-owner --mtime="@$time")
fi
tar -C "$scratch" ${reproducible[@]+"${reproducible[@]}"} -cf - "$name" | gzip -9n > "$files_at/$name.tar.gz"
files=("$name.tar.gz")

if $wheel; then
  say "wheel, from Cargo.lock"
  python3 -m venv "$scratch/venv"
  "$scratch/venv/bin/pip" install --quiet --disable-pip-version-check 'maturin>=1.7,<2'
  (cd python && CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$PWD/../target}" \
    "$scratch/venv/bin/maturin" build --release --strip --locked --out "$scratch/wheel" ${target:+--target "$target"})
  cp "$scratch"/wheel/*.whl "$files_at/"
  files+=("$(basename "$scratch"/wheel/*.whl)")
fi

sum() { if command -v sha256sum >/dev/null; then sha256sum "$@"; else shasum -a 256 "$@"; fi; }
(cd "$files_at" && sum "${files[@]}" > SHA256SUMS)

say "tried out"
(cd "$files_at" && sum --check SHA256SUMS)
mkdir "$scratch/user"
tar -C "$scratch/user" -xzf "$files_at/$name.tar.gz"
if [ "$platform" = "$host" ]; then
  told=$("$scratch/user/$name/$program" --version)
  [ "${told#vidar "$version"}" != "$told" ] || die "the packed program says \"$told\", not version $version"
  "$scratch/user/$name/$program" doctor > "$scratch/doctor.txt" || { cat "$scratch/doctor.txt"; die "vidar doctor failed"; }
  "$scratch/user/$name/$program" model verify da3-nano
  if $wheel; then
    python3 -m venv "$scratch/fresh"
    "$scratch/fresh/bin/pip" install --quiet --disable-pip-version-check "$files_at/${files[1]}"
    # Away from the checkout, so that nothing of it is imported.
    (cd "$scratch/user" && "$scratch/fresh/bin/python" -c 'import vidar; print("module", vidar.__version__, len(vidar.__all__), "names")')
  fi
fi
mkdir -p "$out"
cp "$files_at"/* "$out/"
say "done: $out"
ls -l "$out"
