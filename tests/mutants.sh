#!/bin/bash
# Random errors of `cargo-mutants` in compositor, medium, ATC, U-BAF and metrics, which tests must notice.
#
#   cargo install cargo-mutants --locked
#   tests/mutants.sh choose SEED > tests/mutants.txt    # 200 errors of today's source
#   tests/mutants.sh DIR                                # runs them; outcomes in DIR/mutants.out
#   tests/mutants.sh DIR --iterate                      # runs those again that no test noticed
#
# Each error is built and tested alone, with the tests of its own crate. Errors that cannot be noticed stand in
# `mutants-equivalent.txt` with the reason.
set -euo pipefail
cd "$(dirname "$0")/.."

crates=(splat medium atc ubaf metrics)
places=()
for crate in "${crates[@]}"; do
  part=src
  [ "$crate" = splat ] && part=src/compose
  places+=(-p "use3d-$crate" -f "crates/$crate/$part/**")
done

if [ "${1:-}" = choose ]; then
  random() { openssl enc -aes-256-ctr -pass "pass:$1" -nosalt -md sha256 < /dev/zero 2> /dev/null; }
  cargo mutants --list "${places[@]}" | LC_ALL=C sort | shuf -n 200 --random-source=<(random "$2") | LC_ALL=C sort
  exit
fi

out=${1:?name a folder for the outcomes, such as target/mutants}
mkdir -p "$out"
names=$(sed 's/[][\\.^$*+?(){}|]/\\&/g' tests/mutants.txt | paste -sd '|')
exec cargo mutants "${places[@]}" --re "^($names)\$" --output "$out" "${@:2}" -- --lib --tests --locked
